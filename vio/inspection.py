"""What a recording holds, and whether it can be refined: facts, verdicts, and what to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vio.errors import RecordingError, VioError
from vio.image_files import is_cut_off, size_of
from vio.imu import find_gaps
from vio.imu_checks import ImuReport, check_imu
from vio.recording import Recording, check_refinable
from vio.sensor_verdicts import Check, gap_check, sync_check, vibration_checks
from vio.spectrum import Spectrum, imu_spectrum
from vio.visual_sync import SyncQuality, sync_quality

GAP_FACTOR = 8.0
"""Frame intervals over the median from which one counts as a hole; adaptive capsules vary from 2 to 6 per second."""
JITTER_LIMIT = 0.2
"""Spread of the frame intervals over their median above which the frame rate counts as irregular."""


@dataclass(frozen=True)
class Inspection:
    """Facts about a recording and one verdict per check."""

    facts: dict[str, Any]
    checks: tuple[Check, ...]
    spectrum: Spectrum | None = None
    """Of the inertial samples; None where they are too few."""
    sync: SyncQuality | None = None
    """Camera against gyro; None where nobody asked or it cannot be compared."""

    @property
    def usable(self) -> bool:
        """Whether no check ended in an error."""
        return all(check.level != "error" for check in self.checks)

    def to_dict(self) -> dict[str, Any]:
        """Plain values for `--json`."""
        checks = [{"name": c.name, "level": c.level, "text": c.text, "remedy": c.remedy, "judged": c.judged}
                  for c in self.checks]
        return {"usable": self.usable, "facts": self.facts, "checks": checks}


def inspect_recording(recording: Recording, pixels: bool = False) -> Inspection:
    """Look at a recording; never raises for what it finds, it says so.

    Args:
        recording: what to look at.
        pixels: also look at the images of the liveliest stretch, whether camera and gyro agree.
    """
    checks = [_frames(recording), _images(recording), *_imu(recording), _refinable(recording), _truth(recording)]
    spectrum = None
    if checks_imu_passed(checks):
        spectrum = imu_spectrum(recording.imu, recording.imu_t_s, recording.calibration.imu_noise)
        checks += [gap_check(recording), *vibration_checks(spectrum)]
    sync = None
    if pixels and checks_imu_passed(checks):
        sync, check = _sync(recording)
        checks.append(check)
    return Inspection(_facts(recording), tuple(checks), spectrum, sync)


def checks_imu_passed(checks: Sequence[Check]) -> bool:
    """Whether the inertial samples can be believed."""
    return all(check.level != "error" for check in checks if check.name == "imu")


def _sync(recording: Recording) -> tuple[SyncQuality | None, Check]:
    try:
        sync = sync_quality(recording)
    except VioError as error:
        return None, Check("sync", "warning", error.nameless)
    return sync, sync_check(sync, recording.calibration.time_offset_s)


def _facts(recording: Recording) -> dict[str, Any]:
    imu, camera = recording.imu, recording.calibration.camera
    frame_dt = np.diff(recording.frame_t_s)
    imu_dt = np.diff(imu.t_ns) * 1e-9
    positive = imu_dt[imu_dt > 0]
    return {
        "name": recording.name,
        "frames": len(recording),
        "duration_s": recording.duration_s,
        "frame_rate_hz": float(1 / np.median(frame_dt)) if len(frame_dt) else None,
        "longest_frame_interval_s": float(frame_dt.max()) if len(frame_dt) else None,
        "camera": None if camera is None else {"model": camera.model, "width": camera.width, "height": camera.height},
        "lever_arm_m": float(np.linalg.norm(recording.calibration.T_body_camera[:3, 3])),
        "time_offset_s": recording.calibration.time_offset_s,
        "imu_samples": len(imu),
        "imu_rate_hz": float(1 / np.median(positive)) if len(positive) else None,
        "imu_gaps": [{"start_s": g.start_s, "end_s": g.end_s} for g in find_gaps(recording.imu_t_s)],
        "has_images": recording.has_images,
        "has_depth": recording.has_depth,
        "has_truth": recording.truth is not None,
        "provenance": recording.provenance,
    }


def _frames(recording: Recording) -> Check:
    if len(recording) < 3:
        return Check("frames", "warning", f"{len(recording)} frames; a trajectory needs more")
    dt = np.diff(recording.frame_t_s)
    longest = int(np.argmax(dt))
    if dt[longest] > GAP_FACTOR * np.median(dt):
        holes = int((dt > GAP_FACTOR * np.median(dt)).sum())
        return Check("frames", "warning", f"{len(recording)} frames over {recording.duration_s:.1f} s, median interval "
                     f"{1e3 * np.median(dt):.1f} ms, {holes} holes; the longest, {dt[longest]:.1f} s, begins at "
                     f"{recording.frame_t_s[longest]:.1f} s", "motions across holes are unreliable: refine gates them; "
                     "cut the recording there if they are long")
    spread = float(np.percentile(dt, 95) - np.percentile(dt, 5)) / float(np.median(dt))
    text = f"{len(recording)} frames over {recording.duration_s:.1f} s, median interval {1e3 * np.median(dt):.1f} ms"
    if spread > JITTER_LIMIT:
        return Check("frames", "ok", f"{text}, irregular (5-95 % spread {100 * spread:.0f} %), used as stamped")
    return Check("frames", "ok", text)


def _images(recording: Recording) -> Check:
    if recording.video is not None:
        return Check("images", "ok", f"a film of {len(recording.video)} frames")
    listed = [path for path in recording.frame_paths if path is not None]
    there = sum(path.is_file() for path in listed)
    if there == len(recording):
        return _whole_images(recording)
    if there == 0:
        return Check("images", "warning", "no image files: refinement with given motions works, prediction does not",
                     "to predict, put the files that cam0/data.csv lists into cam0/data")
    return Check("images", "warning", f"{there} of {len(recording)} image files exist; prediction needs all",
                 "copy the missing ones, or cut cam0/data.csv to frames that exist")


def _whole_images(recording: Recording) -> Check:
    """Whether image files that all exist are whole, and of the size that the camera was calibrated for."""
    count, camera = len(recording), recording.calibration.camera
    cut = [k for k, path in enumerate(recording.frame_paths) if path is not None and is_cut_off(path)]
    if cut:
        return Check("images", "warning", f"{len(cut)} of {count} image files are cut off, the first is that of frame "
                     f"{cut[0]}", "copy them again; until then predict leaves these frames' motions out")
    first = recording.frame_paths[0]
    try:
        size = None if first is None else size_of(first, "frame 0")
    except RecordingError as error:
        return Check("images", "warning", error.nameless, "restore the files; until then they cannot be predicted on")
    if camera is not None and size is not None and size != (camera.width, camera.height):
        return Check("images", "warning", f"the images have {size[0]} x {size[1]} pixels but the calibration is for "
                     f"{camera.width} x {camera.height}", "give the calibration of this resolution: prediction and "
                     "lesions' pixels need it")
    return Check("images", "ok", f"all {count} image files exist")


def _imu(recording: Recording) -> list[Check]:
    try:
        report = check_imu(recording.imu, recording.calibration.imu_noise)
    except VioError as error:
        return [Check("imu", "error", error.nameless)]
    checks = [Check("imu", "ok", _imu_text(report))]
    return checks + [Check("imu", "warning", text) for text in report.warnings]


def _imu_text(report: ImuReport) -> str:
    force = f"median |specific force| {report.gravity_m_s2:.2f} m/s²"
    return f"{report.rate_hz:.1f} Hz, {force}, {len(report.gaps)} gaps over 0.5 s"


def _refinable(recording: Recording) -> Check:
    try:
        check_refinable(recording)
    except VioError as error:
        return Check("coverage", "error", error.nameless)
    return Check("coverage", "ok", "the IMU covers all frames")


def _truth(recording: Recording) -> Check:
    if recording.truth is None:
        return Check("truth", "ok", "none: accuracy will not be reported")
    span = f"{recording.truth.t_s[0]:.1f} to {recording.truth.t_s[-1]:.1f} s"
    return Check("truth", "ok", f"{len(recording.truth)} poses from {span}, path {recording.truth.path_length_m:.3f} m")


def describe(recording: Recording) -> dict[str, str]:
    """What a recording holds and what it lacks, one sentence each, for whoever brought data of another format."""
    camera, unknown = recording.calibration.camera, "unknown; declare it before anything geometric"
    missing = 0 if recording.has_images else sum(path is None or not path.is_file() for path in recording.frame_paths)
    images = f"{len(recording)} over {recording.duration_s:.3f} s"
    return {
        "format": str(recording.provenance.get("format", "asl")),
        "frames": f"{images}, {missing} without an image file" if missing else images,
        "camera": unknown if camera is None else f"{camera.model}, {camera.width} x {camera.height} pixels",
        "depth": _depth_text(recording),
        "truth": _truth(recording).text if recording.truth else str(recording.provenance.get("truth", "none")),
        "imu": f"{len(recording.imu)} samples" if len(recording.imu) else "none: prediction works, refinement does not",
    }


def _depth_text(recording: Recording) -> str:
    if not recording.has_depth_images:
        return "none"
    count = sum(path is not None for path in recording.depth_paths)
    kind = "in metres" if recording.has_depth else "up to an unknown factor; declare --depth-planes and --unit-m"
    return f"{count} images, {kind}"


def format_inspection(inspection: Inspection) -> str:
    """The inspection as lines for a terminal, every verdict with what to do."""
    marks = {"ok": "ok     ", "warning": "WARNING", "error": "ERROR  "}
    width = max(len(check.name) for check in inspection.checks)
    lines = []
    for check in inspection.checks:
        mark = marks[check.level] if check.judged else "-      "
        lines.append(f"{mark}  {check.name.ljust(width)}  {check.text}")
        lines += [f"{' ' * (width + 11)}to do: {check.remedy}"] if check.remedy else []
    verdict = "usable" if inspection.usable else "cannot be refined as it is"
    return "\n".join([f"recording {inspection.facts['name']}: {verdict}", *lines])
