"""Verdicts on sensors, each with what to do: holes in the IMU, vibration, camera against gyro."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from vio.imu import GAP_LIMIT_S, find_gaps
from vio.recording import Recording
from vio.spectrum import Spectrum
from vio.visual_sync import FEWEST_INTERVALS, SyncQuality

Level = Literal["ok", "warning", "error"]

NOISE_LIMIT = 5.0
"""Amplitude near the Nyquist frequency over the calibrated noise that is worth a word."""
STILL_RAD = np.deg2rad(0.2)
"""Turns per frame below which nothing can be said about clocks."""
AGREE, DISAGREE = 0.6, 0.3
"""Correlation of camera and gyro: above the one they agree, below the other they do not."""
SMALL_OFFSET_S, OFFSET_FRAMES = 0.01, 0.25


@dataclass(frozen=True)
class Check:
    """One verdict."""

    name: str
    level: Level
    text: str
    remedy: str = ""
    """What to do; empty where nothing needs to be done, or where `text` says so already."""
    judged: bool = True
    """False where nothing could be said; `text` says why, and `level` is then "ok"."""


def _unjudged(name: str, why: str) -> Check:
    return Check(name, "ok", f"not judged: {why}", judged=False)


def gap_check(recording: Recording) -> Check:
    """Holes in the inertial stream within the frames."""
    gaps = [gap for gap in find_gaps(recording.imu_t_s) if gap.end_s > 0 and gap.start_s < recording.duration_s]
    if not gaps:
        return Check("imu gaps", "ok", f"no hole over {GAP_LIMIT_S:g} s")
    longest = max(gaps, key=lambda gap: gap.end_s - gap.start_s)
    lost = sum(gap.end_s - gap.start_s for gap in gaps)
    share = 100 * lost / max(recording.duration_s, 1e-9)
    return Check("imu gaps", "warning", f"{len(gaps)} holes over {GAP_LIMIT_S:g} s, {lost:.1f} s together ({share:.1f} "
                 f"%); the longest, {longest.end_s - longest.start_s:.1f} s, begins at {longest.start_s:.1f} s",
                 "only the motions hold the frames there; look for lost packets or a paused log")


def vibration_checks(spectrum: Spectrum | None) -> list[Check]:
    """Whether noise near the Nyquist frequency is what the calibration says."""
    if spectrum is None:
        return [_unjudged("vibration", "no stretch of 64 samples without a hole")]
    top_hz = float(spectrum.frequency_hz[-1])
    text = (f"near {top_hz:.0f} Hz the accelerometer shows {spectrum.accel_over_noise:.1f} times, the gyro "
            f"{spectrum.gyro_over_noise:.1f} times the calibrated noise")
    if max(spectrum.accel_over_noise, spectrum.gyro_over_noise) <= NOISE_LIMIT:
        return [Check("vibration", "ok", text)]
    return [Check("vibration", "warning", text, "vibration reaches the end of the band, and part of it is folded down: "
                  "log the IMU faster or filter before sampling; if nothing shakes it, correct imu0/sensor.yaml "
                  "(examples/08). refine inflates the noise by itself")]


def sync_check(sync: SyncQuality | None, declared_offset_s: float) -> Check:
    """Whether camera and gyro tell of the same turns at the same times."""
    if sync is None:
        return _unjudged("sync", f"it takes {FEWEST_INTERVALS} frame intervals with texture in the images, a "
                                 "calibrated camera and an IMU over them")
    text = (f"camera and gyro agree over {len(sync.t_s)} frame intervals with correlation "
            f"{sync.best_correlation:.2f}")
    if sync.turn_rms_rad < STILL_RAD:
        return _unjudged("sync", f"it turns only {np.rad2deg(sync.turn_rms_rad):.2f}° per frame")
    if sync.swapped is not None:
        return Check("sync", "warning", f"{text}, but clearly better if the body's axes were {sync.swapped} of those "
                     "declared", "correct the rotation of T_BS in cam0/sensor.yaml; axes are swapped or mirrored")
    if sync.best_correlation < DISAGREE:
        return Check("sync", "warning", f"camera and gyro do not agree (correlation {sync.best_correlation:.2f})",
                     "check that images and IMU are of one recording, both clocks, and T_BS in cam0/sensor.yaml")
    interval_s = float(np.median(np.diff(sync.t_s))) if len(sync.t_s) > 1 else 0.0
    limit_s = max(SMALL_OFFSET_S, min(OFFSET_FRAMES * interval_s, 0.05))
    if sync.offset_is_seen and abs(sync.best_offset_s) > limit_s:
        total = declared_offset_s + sync.best_offset_s
        return Check("sync", "warning", f"{text}, best with the IMU's stamps {1e3 * sync.best_offset_s:+.0f} ms off",
                     f"set time_offset_s: {total:.3f} in imu0/sensor.yaml, unless the clocks are known to be one")
    if sync.best_correlation < AGREE:
        return Check("sync", "warning", f"{text}, which is little", "few corners, blur or fast turns do that; "
                     "if the images are good, check T_BS in cam0/sensor.yaml")
    return Check("sync", "ok", f"{text}, no time offset beyond {1e3 * limit_s:.0f} ms")
