"""One's own film with the times at which its frames were taken.

    REC/<one film>      .mp4 .avi .mpg .mpeg .mkv .mov .wmv .webm
    REC/frames.csv      title line and one column of time (t_ns, t_us, t_ms or t_s); row k is the film's frame k
    REC/imu.csv, camchain.yaml, imu.yaml    optional: `vio.formats.sidecar`

or the film itself, with `<its name>.csv` beside it instead of frames.csv (and no IMU).

Clock: the table's. A film's own presentation times say when a player shows a frame, not when the capsule took it
(28.6 frames a second for a capsule that took 2 to 6 is common), so they are used only when the user declares that
they are the capture times. Every frame that decodes must have its row: a film that is cut off or damaged is refused,
and the part that can be used is named. Rotation marks are ignored. Other conventions as in
`vio.formats.image_folder`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vio.errors import FormatError, RecordingError
from vio.formats.declared import OPTIONS, Declared
from vio.formats.files import entries
from vio.formats.named_table import read_named_table
from vio.formats.sidecar import read_sidecar
from vio.imu import ImuSamples
from vio.recording import Recording
from vio.video_frames import VideoFrames, listed_frames, presentation_times_s

LAYOUT = "a film with a table of times (frames.csv, or <film>.csv beside the film)"
ACCEPTS = frozenset({"calibration", "presentation_times"})
ENDINGS = {".mp4", ".avi", ".mpg", ".mpeg", ".mkv", ".mov", ".wmv", ".webm"}
TABLE = "frames.csv"
SHARE = 0.99
"""Of the frames that a container lists must decode: some list a frame or two more than there are."""
HOLE = 1.5
"""A step between presentation times above this many medians counts as missing frames."""


def matches(path: str | Path) -> bool:
    """Whether `path` is a film or a folder with one."""
    path = Path(path)
    return path.suffix.lower() in ENDINGS if path.is_file() else len(_films(path)) > 0


def read_video(path: str | Path, declared: Declared | None = None) -> Recording:
    """Read a film with its times; the whole film is decoded once to see that every frame is there.

    Raises:
        RecordingError: no film or several, no times, or a film that decodes only partly.
        FormatError, ImuError, CalibrationError: an unusable table or calibration, as `vio.formats.image_folder`.
    """
    declared, path = declared or Declared(), Path(path)
    film = path if path.is_file() else _only_film(path)
    table = film.with_suffix(".csv") if path.is_file() else path / TABLE
    shown_s = presentation_times_s(film)
    if declared.presentation_times:
        if table.is_file():
            raise RecordingError(f"{table.name} lists the times of the frames; leave out "
                                 f"{OPTIONS['presentation_times']}, or take the table away")
        _check_whole(film, shown_s)
        t_ns, clock = _as_capture_times(shown_s), "presentation times, declared to be the capture times"
    else:
        t_ns, clock = _listed_times(table, film, shown_s), "times as listed"
    imu, calibration = (ImuSamples.none(), declared.calibration_or(None)) if path.is_file() else read_sidecar(
        path, declared)
    return Recording(film.stem if path.is_file() else path.name, t_ns, imu, calibration,
                     video=VideoFrames(film, len(t_ns)), provenance={"format": "video", "clock": clock})


def _films(folder: Path) -> list[Path]:
    return sorted(file for file in entries(folder) if file.suffix.lower() in ENDINGS and file.is_file())


def _only_film(folder: Path) -> Path:
    films = _films(folder)
    if len(films) != 1:
        raise RecordingError(f"{folder.name}: {len(films)} films; give a folder with one, or the film itself")
    return films[0]


def _listed_times(table: Path, film: Path, shown_s: NDArray[np.float64]) -> NDArray[np.int64]:
    if not table.is_file():
        raise RecordingError(f"{film.name}: a film's presentation times are not the times at which a capsule took its "
                             f"frames; add {table.name} with one time per frame, or declare that they are with "
                             f"{OPTIONS['presentation_times']}")
    t_ns = read_named_table(table).times_ns()
    if len(t_ns) != len(shown_s):
        before_hole = _before_hole(shown_s)
        usable = min(before_hole, len(t_ns))
        sure = "a hole follows" if before_hole < len(shown_s) else "if only the end is missing; no hole shows"
        last_s = 1e-9 * float(t_ns[usable - 1] - t_ns[0]) if usable else 0.0
        raise RecordingError(f"{film.name}: {len(shown_s)} frames decode, but {table.name} lists {len(t_ns)} times; "
                             f"frames 0 to {usable - 1} (0 to {last_s:.3f} s) can be used ({sure}): cut the film and "
                             f"the table to {usable}, or restore the film")
    return t_ns


def _check_whole(film: Path, shown_s: NDArray[np.float64]) -> None:
    """Refuse a film whose container lists more frames than decode: without a table nothing else tells."""
    promised = listed_frames(film)
    if len(shown_s) < SHARE * promised:
        usable = _before_hole(shown_s)
        raise RecordingError(f"{film.name}: {len(shown_s)} of {promised} frames decode; frames 0 to {usable - 1} "
                             f"(0 to {shown_s[usable - 1] - shown_s[0]:.3f} s) can be used: cut the film to {usable}, "
                             "or restore it")


def _before_hole(shown_s: NDArray[np.float64]) -> int:
    """How many frames come before the first hole in the presentation times; all where there is none."""
    step = np.diff(shown_s)
    wide = step > HOLE * np.median(step) if len(step) else np.zeros(0, bool)
    return int(np.argmax(wide)) + 1 if wide.any() else len(shown_s)


def _as_capture_times(shown_s: NDArray[np.float64]) -> NDArray[np.int64]:
    bad = np.flatnonzero(np.diff(shown_s) <= 0)
    if len(bad):
        raise FormatError(f"frame {bad[0] + 1}: presentation time {shown_s[bad[0] + 1]:.6f} s does not follow "
                          f"{shown_s[bad[0]]:.6f} s; list the times in {TABLE}")
    return np.round(shown_s * 1e9).astype(np.int64)
