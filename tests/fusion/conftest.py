"""Simulated examinations that the tests of fusion share; each is simulated and refined once."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.browser import Browser, browser, find_chromium
from benchmarks.simulated_lesions import (
    SimulatedLesion,
    draw_lesions,
    network_depths,
    sightings_of,
    true_lumen,
    write_depth,
)
from fusion import RefineConfig, Refinement, Sighting, locate, refine
from vio.imu import ImuNoise, ImuSamples
from vio.motions import RelativeMotions
from vio.recording import Recording
from vio.simulation import T_BODY_CAMERA, NetworkMotions, Simulation, network_like_motions, simulate

DEPTH_SD = 0.10
NOISELESS = {"noise": ImuNoise(1e-12, 1e-12, 1e-12, 1e-12), "accel_bias_sd_m_s2": 0.0, "gyro_bias_sd_rad_s": 0.0}


@dataclass(frozen=True, repr=False)
class Examination:
    """A simulated recording with the motions a network would report for it."""

    simulation: Simulation
    network: NetworkMotions

    @property
    def recording(self) -> Recording:
        return self.simulation.recording

    @property
    def motions(self) -> RelativeMotions:
        return self.network.motions

    def with_samples(self, keep: np.ndarray) -> Recording:
        """The recording with only some of its inertial samples, in the order given."""
        imu = self.recording.imu
        return replace(self.recording, imu=ImuSamples(imu.t_ns[keep], imu.gyro_rad_s[keep], imu.accel_m_s2[keep]))

    def with_imu(self, **changes: np.ndarray) -> Recording:
        return replace(self.recording, imu=replace(self.recording.imu, **changes))

    def shaken_unseen(self, amplitude_m: float, frequency_hz: float) -> Recording:
        """The IMU feels the whole body sway in a way that moves neither the camera's world nor the truth."""
        t, omega = self.recording.imu_t_s, 2 * np.pi * frequency_hz
        direction = [np.sin(omega * t + phase) for phase in (0.0, 1.0, 2.0)] * np.array([[0.7], [0.5], [0.5]])
        acceleration_world = -amplitude_m * omega**2 * direction.T
        R = self.simulation.motion.evaluate(t).T_world_body[:, :3, :3]
        accel = self.recording.imu.accel_m_s2 + np.einsum("nji,nj->ni", R, acceleration_world)
        return self.with_imu(accel_m_s2=accel)


def _examine(organ: str, vibration: str, level: int, duration_s: float, seed: int, network: dict | None = None,
             **options: object) -> Examination:
    simulation = simulate(organ, vibration, level, duration_s, seed, **options)
    return Examination(simulation, network_like_motions(simulation.recording.truth, T_BODY_CAMERA, seed + 1000,
                                                        **(network or {})))


@pytest.fixture(scope="session")
def examine() -> Callable[..., Examination]:
    """Simulate: organ, vibration, level, duration [s], seed, network={...} and the simulator's own options."""
    return _examine


@pytest.fixture(scope="session")
def noiseless() -> dict:
    """Options of a simulation whose IMU is perfect up to its sampling."""
    return NOISELESS


@pytest.fixture(scope="session")
def examination() -> Examination:
    """300 frames of the small bowel."""
    return _examine("small-bowel", "gaussian", 2, 100.0, 201)


@pytest.fixture(scope="session")
def refined(examination: Examination) -> Refinement:
    return refine(examination.recording, examination.motions)


@pytest.fixture(scope="session")
def short() -> Examination:
    """36 frames: for whatever is dense or slow."""
    return _examine("small-bowel", "gaussian", 2, 12.0, 203)


@pytest.fixture(scope="session")
def configured() -> Callable[..., RefineConfig]:
    """A configuration with some of its top-level fields replaced."""
    return lambda **changes: replace(RefineConfig(), **changes)


@dataclass(frozen=True)
class LesionCase:
    """A simulated recording whose lesions are known, with the depth a network would report at them."""

    recording: Recording
    refined: Refinement
    lesions: list[SimulatedLesion]
    groups: list[list[SimulatedLesion]]
    depth: Path

    def rows(self, merged: bool = True, labels: dict[int, str] | None = None) -> list[Sighting]:
        """Sightings of all lesions; those with a label of their own are landmarks."""
        named = labels or {}
        found = []
        for k, group in enumerate(self.groups):
            for seen in group if merged else [s for s in group if s.frame == self.lesions[k].frame]:
                found.append(Sighting(named.get(k, f"lesion {k}"), "landmark" if k in named else "finding", seen.frame,
                                      None, seen.pixel, "list", id=str(k)))
        return found

    def locate(self, **options: object) -> dict[str, object]:
        rows = self.rows(options.pop("merged", True), options.pop("labels", None))
        table = locate(self.refined, rows, depth=self.depth, recording=self.recording, **options)
        return {lesion.id: lesion for lesion in table.lesions}


@pytest.fixture(scope="session")
def case(examine: Callable, tmp_path_factory: pytest.TempPathFactory) -> LesionCase:
    """Small bowel, 10 lesions, each seen by up to five frames."""
    made = examine("small-bowel", "peristalsis", 2, 150.0, 41, driving="operated")
    rng = np.random.default_rng(41)
    lesions = draw_lesions(made.simulation, true_lumen(made.simulation), 10, rng)
    groups = [sightings_of(made.simulation, lesion, 2) for lesion in lesions]
    folder = tmp_path_factory.mktemp("lesions") / "depth"
    write_depth(folder, made.simulation, network_depths(made.simulation, made.network, groups, DEPTH_SD, rng))
    return LesionCase(made.recording, refine(made.recording, made.motions), lesions, groups, folder)


@pytest.fixture(scope="session")
def tab() -> Iterator[Browser]:
    """One tab of a headless Chromium."""
    if find_chromium() is None:
        pytest.skip("needs chromium (Debian: apt-get install chromium)")
    with browser() as one:
        yield one
