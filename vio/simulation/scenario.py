"""A simulated examination: from organ, vibration and seed to a `Recording` with exact truth.

Motion level: frame times, IMU and truth, no images.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray

from vio import se3
from vio.calibration import Calibration
from vio.camera import Camera
from vio.errors import SimulationError
from vio.imu import ImuNoise
from vio.recording import Recording, TruthState
from vio.simulation.anatomy import Anatomy, make_anatomy
from vio.simulation.cameras import MIROCAM
from vio.simulation.contact import find_contacts
from vio.simulation.halts import Clock, HaltingPath, HaltingVibration, Halts
from vio.simulation.imu_synthesis import SIMULATED_IMU, ImuBiases, corrupt, draw_biases, ideal_imu
from vio.simulation.motion import CapsuleMotion
from vio.simulation.organs import ORGANS
from vio.simulation.path import DRIVING, moving_path, resting_path
from vio.simulation.vibration import KINDS, MAX_LEVEL, make_vibration
from vio.trajectory import Trajectory

Array = NDArray[np.float64]

SIMULATOR_VERSION = 3
START_T_NS = 10_000_000_000  # stamp of the first frame; the IMU starts a little before
IMU_MARGIN_S = 0.25
MIN_IMU_RATE_HZ = 5.0  # slower samples would reach beyond the span of the motion
MODES = ("moving", "rest")

CAMERA_AHEAD_M = 0.010
T_BODY_CAMERA = se3.transform([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [CAMERA_AHEAD_M, 0, 0])
"""Camera 10 mm ahead of the IMU on the capsule's axis: camera z = body x, camera x = -body y, camera y = -body z."""

@dataclass(frozen=True)
class Simulation:
    """A recording with all that produced it."""

    recording: Recording
    anatomy: Anatomy
    """The organ that the capsule moves in: what a camera sees."""
    motion: CapsuleMotion
    """Continuous truth: evaluate it at any time from 2 s before the first to 2 s after the last frame."""
    biases: ImuBiases
    """True biases at the IMU stamps."""


class SimulationOptions(TypedDict, total=False):
    """Keyword arguments of `simulate`, explained there."""

    frame_rate_hz: float
    noise: ImuNoise
    driving: str
    mode: str
    start: float | None
    wall_motion: float
    halts: Halts
    camera: Camera
    accel_bias_sd_m_s2: float
    gyro_bias_sd_rad_s: float
    name: str | None


def simulate_recording(organ: str, vibration: str, level: int, duration_s: float, seed: int,
                       **options: Unpack[SimulationOptions]) -> Recording:
    """The recording of `simulate`, which documents all arguments, options and errors."""
    return simulate(organ, vibration, level, duration_s, seed, **options).recording


def simulate(
    organ: str,
    vibration: str,
    level: int,
    duration_s: float,
    seed: int,
    *,
    frame_rate_hz: float = 3.0,
    noise: ImuNoise = SIMULATED_IMU,
    driving: str = "natural",
    mode: str = "moving",
    start: float | None = None,
    wall_motion: float = 1.0,
    halts: Halts = (),
    camera: Camera = MIROCAM,
    accel_bias_sd_m_s2: float = 0.2,
    gyro_bias_sd_rad_s: float = float(np.deg2rad(0.5)),
    name: str | None = None,
) -> Simulation:
    """Simulate one examination in memory; the same arguments give the same bytes.

    Organ, driving, mode and seed alone determine the nominal motion, so that the levels of a vibration shake
    the same route.

    Args:
        organ: "colon", "small-bowel" or "stomach".
        vibration: "none", "gaussian", "peristalsis" or "collision".
        level: 0 (still) to 5.
        duration_s: frames are taken at k / frame_rate_hz below this time.
        seed: integer ≥ 0.
        frame_rate_hz: frames per second.
        noise: IMU noise, rate and full scales.
        driving: "natural", "operated", "brisk", "one-way", "withdrawn" or "transit", see `vio.simulation.path`.
        mode: "moving", or "rest" for a capsule that lies still (the vibration still shakes it).
        start: where in the organ it starts, 0 its entrance, 1 its exit; None = drawn from the first 60 %.
        wall_motion: scale of the wall's contractions, 1 as in life, 0 none.
        halts: (begin, end) [s] between which course and vibration of the capsule stand still, in order.
        camera: what renders the images.
        accel_bias_sd_m_s2: standard deviation of the first accelerometer bias, per axis.
        gyro_bias_sd_rad_s: standard deviation of the first gyro bias, per axis.
        name: of the recording; made from the arguments when None.

    Raises:
        SimulationError: an unknown organ, vibration, driving or mode, a level outside 0 to 5, a seed that is no
            integer ≥ 0, a duration or rate that is not positive, an IMU below 5 Hz, a negative bias, halts that
            overlap, or fewer than 2 frames.
    """
    level, seed = _check_scenario(organ, vibration, level, seed, driving, mode)
    _check_place(start, wall_motion)
    frame_count = _check_timing(duration_s, frame_rate_hz)
    _check_imu(noise, accel_bias_sd_m_s2, gyro_bias_sd_rad_s)
    frame_t_ns = START_T_NS + np.round(np.arange(frame_count) * (1e9 / frame_rate_hz)).astype(np.int64)
    frame_t_s = _seconds(frame_t_ns)
    end_s = float(frame_t_s[-1])

    rng = np.random.default_rng([seed, 1])
    anatomy = make_anatomy(organ, seed, wall_motion)
    nominal = (resting_path(anatomy, end_s, rng) if mode == "rest"
               else moving_path(anatomy, driving, end_s, rng, start))
    contacts = find_contacts(anatomy, nominal, end_s) if vibration == "collision" and level > 0 else None
    shaking = make_vibration(vibration, level, end_s, seed, contacts)
    if len(halts):
        clock = Clock(halts)
        nominal, shaking = HaltingPath(nominal, clock), HaltingVibration(shaking, clock)
    motion = CapsuleMotion(nominal, shaking)
    state = motion.evaluate(frame_t_s)

    rng = np.random.default_rng([seed, 3])
    imu_t_ns = _imu_stamps(end_s, noise.rate_hz, rng)
    centre_s = _seconds(imu_t_ns)
    gyro, force = ideal_imu(motion, centre_s, noise.rate_hz)
    biases = draw_biases(len(imu_t_ns), noise, rng, accel_bias_sd_m_s2=accel_bias_sd_m_s2,
                         gyro_bias_sd_rad_s=gyro_bias_sd_rad_s)
    samples = corrupt(imu_t_ns, gyro, force, biases, noise, rng)

    provenance = {
        "schema": 1, "source": "capsule-vio simulation", "simulator_version": SIMULATOR_VERSION, "seed": seed,
        "organ": organ, "vibration": vibration, "vibration_level": level, "duration_s": float(duration_s),
        "frame_rate_hz": float(frame_rate_hz), "driving": driving, "mode": mode, "start": start,
        "wall_motion": float(wall_motion),
        "accel_bias_sd_m_s2": float(accel_bias_sd_m_s2), "gyro_bias_sd_rad_s": float(gyro_bias_sd_rad_s),
    }
    if len(halts):
        provenance["halts"] = [[float(begin), float(end)] for begin, end in halts]
    recording = Recording(
        name=name or f"{organ}-{vibration}{level}-seed{seed}", frame_t_ns=frame_t_ns, imu=samples,
        calibration=Calibration(camera, T_BODY_CAMERA, noise), truth=Trajectory(frame_t_s, state.T_world_body),
        provenance=provenance,
        truth_state=TruthState(state.velocity_m_s, *_biases_at(frame_t_ns, imu_t_ns, biases)),
    )
    return Simulation(recording, anatomy, motion, biases)


def _seconds(t_ns: NDArray[np.int64]) -> Array:
    """Seconds after the first frame."""
    return (t_ns - START_T_NS).astype(float) * 1e-9


def _biases_at(t_ns: NDArray[np.int64], imu_t_ns: NDArray[np.int64], biases: ImuBiases) -> tuple[Array, Array]:
    """Gyro and accelerometer biases (N, 3) between the samples' stamps."""
    t, imu_t = _seconds(t_ns), _seconds(imu_t_ns)
    gyro, accel = (np.column_stack([np.interp(t, imu_t, values[:, axis]) for axis in range(3)])
                   for values in (biases.gyro_rad_s, biases.accel_m_s2))
    return gyro, accel


def _imu_stamps(end_s: float, rate_hz: float, rng: np.random.Generator) -> NDArray[np.int64]:
    """Cell centres [ns] from before the first frame to after the last, with a random phase to the frames."""
    margin = max(IMU_MARGIN_S, 2 / rate_hz)
    count = int(np.ceil((end_s + 2 * margin) * rate_hz)) + 1
    first = -margin + (rng.random() - 0.5) / rate_hz
    return START_T_NS + np.round((first + np.arange(count) / rate_hz) * 1e9).astype(np.int64)


def _check_scenario(organ: str, vibration: str, level: int, seed: int, driving: str, mode: str) -> tuple[int, int]:
    for what, value, known in (("organ", organ, tuple(ORGANS)), ("vibration", vibration, KINDS),
                               ("driving", driving, DRIVING), ("mode", mode, MODES)):
        if value not in known:
            raise SimulationError(f"simulate: unknown {what} {value!r}; choose one of {', '.join(known)}")
    level = _whole("level", level, f"0 to {MAX_LEVEL}")
    if not 0 <= level <= MAX_LEVEL:
        raise SimulationError(f"simulate: level is {level}; give a whole number from 0 to {MAX_LEVEL}")
    seed = _whole("seed", seed, "0 upward")
    if seed < 0:
        raise SimulationError(f"simulate: seed is {seed}; give a whole number ≥ 0")
    return level, seed


def _check_place(start: float | None, wall_motion: float) -> None:
    if start is not None and not 0 <= start <= 1:
        raise SimulationError(f"simulate: start is {start}; give a share of the organ from 0 (entrance) to 1 (exit)")
    if not 0 <= wall_motion <= 3:
        raise SimulationError(f"simulate: wall_motion is {wall_motion}; give a scale from 0 (still) to 3")


def _whole(what: str, value: Any, span: str) -> int:
    try:
        if isinstance(value, bool):
            raise TypeError
        return operator.index(value)
    except TypeError:
        raise SimulationError(f"simulate: {what} is {value!r}; give a whole number from {span}") from None


def _check_timing(duration_s: float, frame_rate_hz: float) -> int:
    for what, value in (("duration_s", duration_s), ("frame_rate_hz", frame_rate_hz)):
        if not (np.isfinite(value) and value > 0):
            raise SimulationError(f"simulate: {what} is {value}; give a number above 0")
    count = int(np.ceil(duration_s * frame_rate_hz - 1e-6))
    if count < 2:
        raise SimulationError(f"simulate: {duration_s} s at {frame_rate_hz} frames/s hold {count} frame; "
                              f"give more than {1 / frame_rate_hz:.3g} s, for at least 2 frames")
    return count


def _check_imu(noise: ImuNoise, accel_bias_sd_m_s2: float, gyro_bias_sd_rad_s: float) -> None:
    if noise.rate_hz < MIN_IMU_RATE_HZ:
        raise SimulationError(f"simulate: IMU rate is {noise.rate_hz} Hz; give at least {MIN_IMU_RATE_HZ:g} Hz")
    for what, value in (("accel_bias_sd_m_s2", accel_bias_sd_m_s2), ("gyro_bias_sd_rad_s", gyro_bias_sd_rad_s)):
        if not (np.isfinite(value) and value >= 0):
            raise SimulationError(f"simulate: {what} is {value}; give a number ≥ 0")
