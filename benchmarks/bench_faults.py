"""What becomes of an examination whose sensors, clock, calibration or motions are broken: refused by name, or told.

    python benchmarks/bench_faults.py --frames 3000
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from dataclasses import replace

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from results import record, table

from fusion import refine
from vio import se3
from vio.errors import VioError
from vio.metrics import ate, nees
from vio.motions import RelativeMotions
from vio.recording import Recording
from vio.sensor_faults import (
    outside_gap,
    with_bias_drift,
    with_bias_step,
    with_clock_jump,
    with_dead_axis,
    with_gap,
    with_swapped_axes,
    with_time_shift,
    without_frames,
)
from vio.simulation import network_like_motions, simulate_recording

FRAME_RATE_HZ = 3.0
SEED = 631
"""Nothing was tuned on it."""
Case = tuple[Recording, RelativeMotions]
GYRO_STEP, ACCEL_STEP = (0.02, -0.01, 0.01), (0.2, -0.1, 0.1)


def imu(change: Callable[..., object], *arguments: object, **options: object) -> Callable[[Case], Case]:
    """A fault of the inertial samples."""
    return lambda case: (replace(case[0], imu=change(case[0].imu, *arguments, **options)), case[1])


def turned(degrees: tuple[float, float, float]) -> Callable[[Case], Case]:
    """A calibration whose camera is turned."""
    def spoil(case: Case) -> Case:
        calibration = case[0].calibration
        T = calibration.T_body_camera @ se3.transform(se3.so3_exp(np.deg2rad(degrees)), np.zeros(3))
        return replace(case[0], calibration=replace(calibration, T_body_camera=T)), case[1]
    return spoil


def upside_down(case: Case) -> Case:
    """The IMU turned about its x axis, the calibration as before."""
    flip, samples = np.diag([1.0, -1.0, -1.0]), case[0].imu
    return replace(case[0], imu=replace(samples, gyro_rad_s=samples.gyro_rad_s @ flip,
                                        accel_m_s2=samples.accel_m_s2 @ flip)), case[1]


def frames_missing(case: Case, start_s: float, duration_s: float) -> Case:
    """Frames that were never recorded, with the motions that touch them."""
    recording, motions = case
    kept = outside_gap(recording.frame_t_s, start_s, duration_s)
    use = np.flatnonzero(kept[:-1] & kept[1:])
    return without_frames(recording, kept), _some(motions, use)


def _some(motions: RelativeMotions, use: np.ndarray) -> RelativeMotions:
    return replace(motions, t_i_s=motions.t_i_s[use], t_j_s=motions.t_j_s[use], T_i_j=motions.T_i_j[use],
                   cov=motions.cov[use])


def standing(case: Case) -> Case:
    """Motions that are all the identity."""
    return case[0], replace(case[1], T_i_j=np.broadcast_to(np.eye(4), case[1].T_i_j.shape).copy())


def shuffled(case: Case) -> Case:
    """Motions in random order."""
    order = np.random.default_rng(0).permutation(len(case[1]))
    return case[0], replace(case[1], T_i_j=case[1].T_i_j[order])


def faults(duration_s: float) -> dict[str, Callable[[Case], Case]]:
    """Every fault by name."""
    half = 0.5 * duration_s
    missing_s = min(600.0, half)
    out: dict[str, Callable[[Case], Case]] = {
        "none": lambda case: case,
        "IMU silent for 60 s": imu(with_gap, half, 60.0),
        f"{missing_s:g} s of frames missing": lambda case: frames_missing(case, 0.3 * duration_s, missing_s),
        "IMU clock jumps by 0.3 s": imu(with_clock_jump, half, 0.3),
        "IMU clock 50 ms off": imu(with_time_shift, 0.05),
        "gyro bias steps by 1.4 deg/s": imu(with_bias_step, half, gyro_rad_s=GYRO_STEP),
        "accelerometer bias steps by 0.24 m/s²": imu(with_bias_step, half, accel_m_s2=ACCEL_STEP),
        "both warm up": imu(with_bias_drift, GYRO_STEP, (0.3, -0.2, 0.2), 300.0),
        "IMU upside down": upside_down,
        "extrinsics 180 degrees wrong": turned((0.0, 0.0, 180.0)),
        "extrinsics 5 degrees wrong": turned((3.0, -4.0, 0.0)),
        "motions all identity": standing,
        "motions in random order": shuffled,
    }
    for sensor, name in (("gyro", "gyro"), ("accel", "accelerometer")):
        out[f"{name} y dead"] = imu(with_dead_axis, sensor, 1)
        out[f"{name} x and z swapped"] = imu(with_swapped_axes, sensor, 0, 2)
    return out


def outcome(case: Case) -> list[str]:
    """Errors in mm, consistency and what was said; or the refusal."""
    try:
        refined = refine(*case)
    except VioError as error:
        return ["–", "–", "–", f"refused, exit code {error.exit_code}: {error}"]
    truth = case[0].truth_at_frames()
    errors = [1e3 * ate(estimate, truth).rmse_m for estimate in (refined.motions_only, refined.trajectory)]
    said = [refined.fallback_reason, f"scale {refined.scale.policy}: {refined.scale.reason}",
            refined.camera_imu.reason if refined.camera_imu.applied else None,
            f"{len(refined.imu.gaps)} hole in the IMU" if refined.imu.gaps else None]
    consistency = float(np.nanmean(nees(refined.trajectory, truth)))
    return [*(f"{error:.1f}" for error in errors), f"{consistency:.2f}", "; ".join(text for text in said if text)]


def main() -> None:
    """Break one examination in every way and record one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=3000)
    parser.add_argument("--name", default="faults")
    arguments = parser.parse_args()
    recording = simulate_recording("small-bowel", "gaussian", 3, arguments.frames / FRAME_RATE_HZ, SEED)
    network = network_like_motions(recording.truth_at_frames(), recording.calibration.T_body_camera, SEED)
    rows = [[name, *outcome(spoil((recording, network.motions)))]
            for name, spoil in faults(arguments.frames / FRAME_RATE_HZ).items()]
    body = (f"One examination of {arguments.frames} frames, gaussian vibration level 3, seed {SEED}, 2 % outliers. ATE "
            "after SE3 alignment.\n\n"
            + table(["fault", "motions mm", "refined mm", "pose NEES/dof", "what was said"], rows))
    record(arguments.name, "Broken examinations", body)


if __name__ == "__main__":
    main()
