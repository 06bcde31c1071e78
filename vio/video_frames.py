"""Frames of a film, decoded one after the other: constant memory, and no trust in the container's frame rate."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vio.calibration import short_name
from vio.errors import RecordingError
from vio.image_files import quiet_decoder

Image = NDArray[np.uint8]


def presentation_times_s(path: Path) -> NDArray[np.float64]:
    """When a player shows each frame that decodes (N,) [s]. These are not capture times unless somebody knows so.

    Raises:
        RecordingError: the film cannot be opened or no frame of it decodes.
    """
    capture = _open(path)
    times = []
    while capture.grab():
        times.append(_position_s(capture))
    capture.release()
    if not times:
        raise RecordingError(f"{short_name(path)}: no frame of this film can be decoded; restore the file, or convert "
                             "it to images")
    return np.array(times)


def listed_frames(path: Path) -> int:
    """How many frames the container says it holds; 0 where it says nothing. An estimate in some containers.

    Raises:
        RecordingError: the film cannot be opened.
    """
    import cv2

    capture = _open(path)
    count = capture.get(cv2.CAP_PROP_FRAME_COUNT)
    capture.release()
    return max(int(count), 0)


class VideoFrames:
    """Decodes frame k of a film; quick when frames are asked for in order, right in any order.

    Args:
        path: the film.
        count: how many of its frames belong to the recording.
    """

    def __init__(self, path: Path, count: int) -> None:
        self.path, self.count = path, count
        self._capture: Any = None
        self._next = 0
        self._last: Image | None = None

    def __len__(self) -> int:
        return self.count

    def __reduce__(self) -> tuple[type[VideoFrames], tuple[Path, int]]:
        return VideoFrames, (self.path, self.count)  # an open decoder does not travel to another process

    def read(self, k: int) -> Image:
        """Frame k as (H, W, 3) in R, G, B order, rotation marks of the container ignored.

        Raises:
            RecordingError: the film cannot be opened, or ends before the frame; names the part that is usable.
        """
        if self._last is not None and k == self._next - 1:
            return self._last.copy()
        if self._capture is None or k < self._next:
            self._capture, self._next = _open(self.path), 0
        while self._next <= k:
            if not self._capture.grab():
                raise self._ended(self._next)
            self._next += 1
        decoded, image = self._capture.retrieve()
        if not decoded:
            raise self._ended(k)
        self._last = np.ascontiguousarray(image[..., ::-1])
        return self._last.copy()

    def _ended(self, at: int) -> RecordingError:
        usable = f"frames 0 to {at - 1} are usable: shorten the table of times to {at} rows" if at else "none is usable"
        problem = f"cannot be decoded from here on; {usable}"
        return RecordingError(f"frame {at}: {short_name(self.path)} {problem}", f"frame {at}: the film {problem}")


def _open(path: Path) -> Any:
    # The decoder would write to stderr what is reported as an error here; it reads this when it is first used.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    import cv2

    with quiet_decoder():
        capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    if not capture.isOpened():
        raise RecordingError(f"{short_name(path)}: not a film that can be decoded; restore the file, or convert it to "
                             "images")
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    return capture


def _position_s(capture: Any) -> float:
    import cv2

    return float(capture.get(cv2.CAP_PROP_POS_MSEC)) * 1e-3
