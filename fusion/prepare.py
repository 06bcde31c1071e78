"""From a recording and its motions to a checked problem: contradictions are refused, small errors corrected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fusion.camera_imu import CameraImu, check_clock, compared_pairs, measure_camera_imu
from fusion.motion_checks import check_against_gyro
from fusion.motion_noise import bounded, is_right, measured_once, with_noise
from fusion.problem import Problem, build_problem
from vio import se3
from vio.calibration import Calibration
from vio.motions import RelativeMotions
from vio.recording import Recording


def prepare(recording: Recording, motions: RelativeMotions) -> tuple[Recording, Problem, CameraImu]:
    """Check both against each other, and correct calibration and claimed noise where the data are sure.

    Returns:
        The recording with the calibration that is used, the problem, and what was measured between camera and IMU.

    Raises:
        VioError: any input that cannot be used, in one line.
    """
    problem = build_problem(recording, motions)
    if motions.meta.get("rotation") == "gyro":
        reason = "the motions' rotations come from the gyro, so that nothing can be compared"
        return recording, problem, replace(measure_camera_imu(problem, compared_pairs(problem, 0)), reason=reason)
    check_clock(problem)
    pairs = compared_pairs(problem)
    check_against_gyro(pairs, problem.motions.T_body_camera)
    measured = measure_camera_imu(problem, pairs)
    corrected, reasons = _corrected(recording.calibration, measured)
    if reasons:
        recording = replace(recording, calibration=corrected)
        problem = build_problem(recording, motions)
        measured = replace(measured, applied=True, reason="corrected: " + " and ".join(reasons))
    if not is_right(measured.rotation_noise) and measured_once(problem.motions):
        factor = bounded(measured.rotation_noise)  # likeliest one wrong figure; the graph checks translations
        problem = replace(problem, motions=with_noise(problem.motions, factor, factor), motion_noise=(factor, factor))
    return recording, problem, measured


def _corrected(calibration: Calibration, measured: CameraImu) -> tuple[Calibration, list[str]]:
    reasons = []
    if measured.rotation_significant:
        T = calibration.T_body_camera @ se3.transform(se3.so3_exp(measured.rotation_rad), np.zeros(3))
        calibration = replace(calibration, T_body_camera=T)
        angle = float(np.rad2deg(np.linalg.norm(measured.rotation_rad)))
        sd = float(np.rad2deg(measured.rotation_sd_rad.max()))
        reasons.append(f"the camera is turned by {angle:.2f} ± {sd:.2f} degrees against the calibration")
    if measured.offset_significant:
        offset = calibration.time_offset_s + measured.time_offset_s
        calibration = replace(calibration, time_offset_s=offset)
        shift = f"{1e3 * measured.time_offset_s:+.1f} ± {1e3 * measured.time_offset_sd_s:.1f} ms"
        reasons.append(f"the IMU's clock is {shift} off the calibration")
    return calibration, reasons
