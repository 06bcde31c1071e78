"""How well gravity tells the gyro's bias in 20 s, and whether it is as sure as it claims: all organs and vibrations.

    python benchmarks/bench_gyro_bias.py
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from bench_unseen_motion import DIRECTION, MOTIONS, sway
from results import record, table

from vio import se3
from vio.gyro_bias import estimate_gyro_bias, gyro_noise_var
from vio.imu import preintegrate_rotation, split_at_frames
from vio.simulation import ORGANS, simulate

SEEDS, SECONDS = range(8300, 8312), 20.0
SHAKEN = {"none": 0, "gaussian": 4, "peristalsis": 4, "collision": 4}
UNSEEN = ("uneven breathing, 5 mm at 0.25 Hz", "uneven walking, 20 mm at 1.7 Hz")


@dataclass(frozen=True)
class Found:
    """One recording."""

    left_in_deg: float
    """Mean rotation error between frames, the bias left in."""
    freed_deg: float
    perfect_deg: float
    """With the true bias removed."""
    bias_deg_s: float
    """Length of the estimate's error."""
    sd_deg_s: float
    """Claimed, root mean square over the axes."""
    nees: float
    """Of the bias, per degree of freedom."""
    noise_nees: float
    """Of the rotations once the true bias is removed."""


def run(vibration: str, level: int, unseen: str | None, seed: int) -> Found:
    """One recording, perhaps with motion of the body that adds to the specific force."""
    organ = tuple(ORGANS)[seed % len(ORGANS)]
    simulation = simulate(organ, vibration, level, SECONDS, seed, driving="operated")
    recording, samples = simulation.recording, simulation.recording.imu
    if unseen is not None:
        amplitude_m, hz = MOTIONS[unseen]
        R = simulation.motion.evaluate(recording.imu_t_s).T_world_body[:, :3, :3]
        felt = amplitude_m * sway(recording.imu_t_s, hz, True, np.random.default_rng(seed)) * DIRECTION
        samples = replace(samples, accel_m_s2=samples.accel_m_s2 + (np.swapaxes(R, 1, 2) @ felt[..., None])[..., 0])
    noise, dt = recording.calibration.imu_noise, np.diff(recording.frame_t_s)
    pieces = split_at_frames(samples, recording.imu_t_s, recording.frame_t_s)
    found = estimate_gyro_bias(pieces, dt, np.ones(len(dt), bool), noise)
    true, R = recording.truth_state.gyro_bias_rad_s.mean(axis=0), recording.truth_at_frames().rotations

    def errors(bias: np.ndarray) -> np.ndarray:
        return se3.so3_log(np.swapaxes(preintegrate_rotation(pieces, bias), 1, 2) @ np.swapaxes(R[:-1], 1, 2) @ R[1:])
    angles = [float(np.degrees(np.linalg.norm(errors(b), axis=1).mean()))
              for b in (np.zeros(3), found.bias_rad_s, true)]
    off, var = found.bias_rad_s - true, gyro_noise_var(samples, recording.imu_t_s, recording.frame_t_s, noise)
    return Found(*angles, float(np.degrees(np.linalg.norm(off))), float(np.degrees(np.sqrt(np.trace(found.cov) / 3))),
                 float(off @ np.linalg.solve(found.cov, off) / 3),
                 float(((errors(true) ** 2).mean(axis=1) / var).mean()))


def row(name: str, runs: list[Found]) -> list[str]:
    """Means over recordings."""
    def mean(key: str) -> float:
        return float(np.mean([getattr(r, key) for r in runs]))
    return [name, f"{mean('left_in_deg'):.3f}°", f"{mean('freed_deg'):.3f}°", f"{mean('perfect_deg'):.3f}°",
            f"{np.median([r.bias_deg_s for r in runs]):.3f}", f"{max(r.bias_deg_s for r in runs):.3f}",
            f"{mean('sd_deg_s'):.3f}", f"{mean('nees'):.2f}", f"{mean('noise_nees'):.2f}"]


def main() -> None:
    """Measure all cases and record one page."""
    cases = {f"{kind}, level {level}" if level else "no vibration": (kind, level, None)
             for kind, level in SHAKEN.items()}
    cases |= {f"gaussian, level 4, and {name}": ("gaussian", 4, name) for name in UNSEEN}
    rows = [row(name, [run(*case, seed) for seed in SEEDS]) for name, case in cases.items()]
    record("gyro_bias", "The gyro's bias from gravity", "\n\n".join([
        f"{len(SEEDS)} simulated recordings a row, {SECONDS:g} s at 3 frames/s, all organs, bias of 0.5°/s (sd); "
        "no images, no network, gravity alone (`vio.gyro_bias`). Rotation: mean error of the integrated gyro between "
        "neighbouring frames, the bias left in, freed of the estimate, and freed of the true bias. Bias: length of the "
        "estimate's error, median and worst, and the sd that is claimed per axis [°/s]. NEES per degree of freedom: 1 "
        "where what is claimed is true; of the bias, and of what noise and cut samples do to the rotations.",
        table(["vibration", "left in", "freed", "true bias", "bias off", "worst", "claimed sd", "NEES, bias",
               "NEES, noise"], rows),
        "`predict --rotation gyro` joins this with the network's rotations, which alone left 0.14° per step on the "
        "calibration recordings of the bundled weights, NEES 0.70."]))


if __name__ == "__main__":
    main()
