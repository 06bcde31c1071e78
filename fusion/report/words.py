"""The report's sentences: what happened, in words that need no knowledge of the code. Plain text, not HTML."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.result import Refinement
from fusion.summary import loops_in_words, rest_in_words

Array = NDArray[np.float64]

MODES = {"none": "no alignment", "origin": "first poses laid together", "yaw4": "yaw and translation",
         "se3": "SE(3): rotation and translation", "sim3": "Sim(3): rotation, translation and scale"}
SHORT_MODES = {"none": "without alignment", "origin": "with the first poses laid together",
               "yaw4": "after yaw and translation alignment", "se3": "after SE(3) alignment",
               "sim3": "after Sim(3) alignment"}
ESTIMATORS = {"graph": "factor graph over motions and IMU", "ekf": "error-state Kalman filter",
              "motions": "motions alone, chained"}
POLICIES = {
    "free": "estimated from the IMU",
    "prior": "carried by its prior",
    "fixed": "held at its prior",
}
NBSP = "\u00a0"
TIE = 0.02
"""Differences of less than this share are called a tie."""


class Verdict(NamedTuple):
    """The headline."""

    tone: str
    """`good`, `bad` or `plain`."""
    text: str


def length(metres: float) -> str:
    """A length with three significant digits, in mm below one metre."""
    return f"{_digits(metres)}{NBSP}m" if abs(metres) >= 1 else f"{_digits(metres * 1e3)}{NBSP}mm"


def angle(radians: float) -> str:
    """An angle in degrees with three significant digits."""
    return f"{_digits(math.degrees(radians))}°"


def percent(share: float) -> str:
    """A signed share with two significant digits, in percent."""
    figure = f"{100 * share:+.2g}" if abs(share) < 0.995 else f"{100 * share:+,.0f}"
    return figure.replace("-", "−") + f"{NBSP}%"


def spread(log_sd: float) -> str:
    """A standard deviation in log as a relative one."""
    return f"±{NBSP}{100 * math.expm1(log_sd):.2g}{NBSP}%"


def duration(seconds: float) -> str:
    """A time span as people say it."""
    if seconds < 120:
        return f"{_digits(seconds)} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"


def _digits(value: float) -> str:
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    decimals = max(0, 2 - math.floor(math.log10(abs(float(f"{value:.3g}")))))
    return f"{value:,.{min(decimals, 9)}f}"


def number(value: object) -> str:
    """Any figure with four significant digits; a dash when there is none."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return "–" if value is None else str(value)
    return f"{value:,}" if isinstance(value, int) else f"{value:.4g}"


def row(accuracy: Mapping[str, Any], source: str, mode: str) -> Mapping[str, Any] | None:
    """Figures of `refined` or `motions` under one alignment; None where it could not be determined."""
    entry = accuracy.get(source, {}).get(mode)
    return entry if isinstance(entry, Mapping) and "ate_rmse_m" in entry else None


def headline_mode(accuracy: Mapping[str, Any]) -> str | None:
    """The alignment the headline speaks of: the first that both estimates have."""
    for mode in ("se3", "yaw4", "origin", "none"):
        if row(accuracy, "refined", mode) and row(accuracy, "motions", mode):
            return mode
    return None


def verdict(refinement: Refinement, summary: Mapping[str, Any]) -> Verdict:
    """Whether fusion helped, plainly."""
    accuracy = summary.get("accuracy") or {}
    mode = headline_mode(accuracy)
    refined, only = (row(accuracy, source, mode or "") for source in ("refined", "motions"))
    if mode is None or refined is None or only is None:
        return Verdict("plain", "This recording has no truth to compare with: the report shows what was concluded and "
                                "how certain the estimator claims to be, not how right it is.")
    before, after = only["ate_rmse_m"], refined["ate_rmse_m"]
    figures = f"{length(after)} against {length(before)}, RMS {SHORT_MODES[mode]}"
    if refinement.estimator == "motions":
        return Verdict("plain", f"Nothing was fused: the result is the motions alone, {length(after)} from truth "
                                f"(RMS {SHORT_MODES[mode]}).")
    if before > 0 and abs(after / before - 1) < TIE:
        return Verdict("plain", f"Fusion makes no difference here: {figures}.")
    if after > before:
        return Verdict("bad", f"Fusion loses on this recording. The refined trajectory is further from truth than the "
                              f"motions alone: {figures}.")
    return Verdict("good", f"Fusion brings the trajectory {_times(before, after)} closer to truth than the motions "
                           f"alone: {figures}.")


def _times(before: float, after: float) -> str:
    ratio = before / after if after > 0 else math.inf
    return f"{ratio:.1f} times" if ratio >= 1.5 else f"{100 * (1 - after / before):.0f} %"


def sentences(
    refinement: Refinement, summary: Mapping[str, Any], within_3_sigma: float | None,
    mean_biases: tuple[Array, Array] | None = None,
) -> list[tuple[str, str]]:
    """(heading, sentence) pairs on what was concluded and why.

    Args:
        refinement: the conclusions.
        summary: as in `summary.json`.
        within_3_sigma: share of positions inside their claim; None when unknown.
        mean_biases: (3,) of gyro [rad/s] and accelerometer [m/s²]; None = those of the refinement's own frames.
    """
    out = [("Estimator", f"{_begun(ESTIMATORS[refinement.estimator])}.")]
    if refinement.fallback_reason:
        much = "everywhere" if refinement.estimator == "graph" else "at all"
        out.append(("Fallback", f"The first choice was not used {much}: {_ended(refinement.fallback_reason)}"))
    scale = refinement.scale
    out.append(("Scale", f"{_begun(POLICIES[scale.policy])}: one motion unit is "
                         f"{length(math.exp(scale.log_mean))} {spread(scale.log_sd)} (1 sd). "
                         f"Why: {_ended(scale.reason)}"))
    own = (refinement.gyro_bias_rad_s.mean(axis=0), refinement.accel_bias_m_s2.mean(axis=0))
    out.append(("IMU", _imu(refinement, *(mean_biases or own))))
    out.append(("Camera and IMU", _camera_imu(refinement)))
    out.append(("Motions", _motions(refinement)))
    if (summary.get("rest") or {}).get("stretches"):
        out.append(("Rest", _begun(rest_in_words(summary["rest"], summary["duration_s"]))))
    if (summary.get("loops") or {}).get("proposed"):
        out.append(("Loops", _begun(loops_in_words(summary["loops"]))))
    if within_3_sigma is not None:
        out.append(("Certainty", f"{100 * within_3_sigma:.1f} % of the positions lie inside their claimed 3-sigma "
                               "ellipsoid, first poses laid together; an honest claim holds for 99.7 %."))
    if losses := _losses(summary.get("accuracy") or {}):
        out.append(("Where fusion loses", losses))
    return out


def _imu(refinement: Refinement, gyro_bias_rad_s: Array, accel_bias_m_s2: Array) -> str:
    imu = refinement.imu
    if refinement.estimator == "motions":
        return "Not used, except to find out which way is up."
    parts = []
    if imu.chi2_per_dof is not None:
        parts.append(f"The inertial data agree with the motions at χ² = {imu.chi2_per_dof:.2f} per degree of freedom, "
                     "scale held (about 0.5 when all is well).")
    if imu.inflation != 1:
        parts.append(f"Their accelerometer noise was inflated {imu.inflation:g}-fold.")
    biases = (f"{1e3 * math.hypot(*accel_bias_m_s2):.0f} mm/s² and "
              f"{angle(math.hypot(*gyro_bias_rad_s))} per second")
    parts.append(f"Mean biases of accelerometer and gyro: {biases}.")
    if imu.gaps:
        parts.append(f"{_count(len(imu.gaps), 'hole')} of more than 0.5 s, where only the motions hold the frames.")
    parts += [_begun(f"{step.in_words()}: it was let go there.") for step in imu.bias_steps]
    parts += [_begun(f"{wander.in_words()}: it may do so there.") for wander in imu.bias_wanders]
    if refinement.time_offset_s:
        parts.append(f"Camera-IMU time offset applied: {1e3 * refinement.time_offset_s:.3g} ms.")
    return " ".join(parts)


def _camera_imu(refinement: Refinement) -> str:
    found = refinement.camera_imu
    if not found.pairs:
        return f"Their calibration was not checked: {_ended(found.reason)}"
    turn, sd = math.hypot(*found.rotation_rad), max(found.rotation_sd_rad)
    clock_ms = f"{1e3 * found.time_offset_s:+.1f}".replace("-", "−")
    return (f"The gyro's turns against the motions' put the camera {angle(turn)} (sd {angle(sd)} per axis) off the "
            f"calibration and the IMU's clock {clock_ms} ms (sd "
            f"{1e3 * found.time_offset_sd_s:.1f} ms): {_ended(found.reason)}")


def _motions(refinement: Refinement) -> str:
    rejected = len(refinement.rejected)
    total = refinement.motions_used + rejected
    text = f"{total:,} given, {refinement.motions_used:,} used, {rejected:,} rejected as outliers"
    if rejected and total:
        text += f" ({100 * rejected / total:.1f} %)"
    if refinement.bridged:
        text += (f". {_count(refinement.bridged, 'frame pair')} measured by no motion: "
                 "there, “motions alone” stands still")
    factors = [f"{what} {factor:.2g}-fold" for what, factor in
               zip(("rotation", "translation"), refinement.motion_noise, strict=True) if factor != 1]
    if factors:
        text += f". Their claimed noise contradicts the data and was corrected: {' and '.join(factors)}"
    return text + "."


def _losses(accuracy: Mapping[str, Any]) -> str:
    lost = []
    for mode, name in SHORT_MODES.items():
        refined, only = row(accuracy, "refined", mode), row(accuracy, "motions", mode)
        if refined and only and refined["ate_rmse_m"] > only["ate_rmse_m"] * (1 + TIE):
            lost.append(f"{name} ({length(refined['ate_rmse_m'])} against {length(only['ate_rmse_m'])})")
    return f"The motions alone are nearer to truth {', '.join(lost)}." if lost else ""


def _count(n: int, what: str) -> str:
    return f"{n:,} {what}" + ("" if n == 1 else "s")


def _begun(text: str) -> str:
    return text[0].upper() + text[1:]


def _ended(text: str) -> str:
    return text if text.endswith((".", "!", "?")) else text + "."
