"""Image files: read whole or refused, because decoders fill a cut-off file with whatever lay in memory."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vio.calibration import short_name
from vio.errors import RecordingError

ENDS = {b"\x89PNG": b"IEND\xaeB`\x82", b"\xff\xd8": b"\xff\xd9"}
"""How a whole PNG and JPEG start and end."""
MAX_PIXELS = 2**26
"""8192 x 8192: above any endoscope, below what exhausts memory when a damaged header asks for it."""
NO_SIZE_MARKERS = {0xC4, 0xC8, 0xCC}
"""JPEG markers between 0xC0 and 0xCF that do not open a frame."""


def decode_image(path: Path, what: str, depth: bool = False) -> NDArray[Any]:
    """Decode an image file: grey (H, W) or colour (H, W, 3) in B, G, R order and 8 bit; as stored when `depth`.

    Args:
        path: the file.
        what: what the image is, at the start of every message.
        depth: keep the stored type and channels instead of making 8-bit pixels.

    Raises:
        RecordingError: the file is absent, cut off, undecodable, or larger than 2^26 pixels.
    """
    import cv2  # heavy, and needed only once somebody looks at an image

    content = _read_whole(path, what)
    size = image_size(content)
    if size is not None and size[0] * size[1] > MAX_PIXELS:
        raise _refused(what, path, f"has {size[0]} x {size[1]} pixels (limit {MAX_PIXELS}); scale the images down, or "
                                   "restore the file if it is damaged")
    flags = cv2.IMREAD_UNCHANGED if depth else cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        with quiet_decoder():
            image = cv2.imdecode(np.frombuffer(content, np.uint8), flags) if content else None
    except cv2.error:
        image = None
    if image is None:
        raise _refused(what, path, "is not an image that can be decoded; restore the file")
    return np.asarray(image)


def rgb(image: NDArray[Any]) -> NDArray[Any]:
    """Grey (H, W) as it is, B, G, R (H, W, 3) as R, G, B."""
    import cv2

    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB)) if image.ndim == 3 else image


@contextmanager
def quiet_decoder() -> Iterator[None]:
    """Keep OpenCV from writing to stderr what is raised as an error here."""
    import cv2

    logging = cv2.utils.logging
    level = logging.getLogLevel()
    logging.setLogLevel(logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        logging.setLogLevel(level)


def is_cut_off(path: Path) -> bool:
    """Whether a PNG or JPEG lacks its end, from its first and last bytes alone; False for files that cannot be read."""
    try:
        with path.open("rb") as file:
            start = file.read(4)
            file.seek(max(path.stat().st_size - 64, 0))
            last = file.read()
    except OSError:
        return False
    return not start or any(start.startswith(magic) and end not in last for magic, end in ENDS.items())


def size_of(path: Path, what: str) -> tuple[int, int]:
    """Width and height of an image file, from its header where the header is a known one.

    Raises:
        RecordingError: as `decode_image`.
    """
    size = image_size(_read_whole(path, what))
    if size is None:
        height, width = decode_image(path, what).shape[:2]
        size = (width, height)
    return size


def image_size(content: bytes) -> tuple[int, int] | None:
    """Width and height that the header of a PNG, JPEG or BMP declares; None for other or broken headers."""
    if content.startswith(b"\x89PNG") and len(content) >= 24:
        return int.from_bytes(content[16:20], "big"), int.from_bytes(content[20:24], "big")
    if content.startswith(b"BM") and len(content) >= 26:
        width, height = (int.from_bytes(content[at : at + 4], "little", signed=True) for at in (18, 22))
        return abs(width), abs(height)
    return _jpeg_size(content) if content.startswith(b"\xff\xd8") else None


def _jpeg_size(content: bytes) -> tuple[int, int] | None:
    """The size in the first start-of-frame segment (ITU T.81, B.2.2)."""
    at = 2
    while at + 9 <= len(content) and content[at] == 0xFF:
        marker = content[at + 1]
        if 0xC0 <= marker <= 0xCF and marker not in NO_SIZE_MARKERS:
            height, width = (int.from_bytes(content[at + k : at + k + 2], "big") for k in (5, 7))
            return width, height
        padding = marker == 0xFF
        at += 1 if padding else 2 + int.from_bytes(content[at + 2 : at + 4], "big")
    return None


def _read_whole(path: Path, what: str) -> bytes:
    try:
        content = path.read_bytes()
    except OSError as error:
        reason = error.strerror or "input error"
        raise _refused(what, path, f"cannot be read ({reason}); restore the file") from None
    for start, end in ENDS.items():
        if content.startswith(start) and end not in content[-64:]:
            raise _refused(what, path, "is cut off; copy the file again")
    return content


def _refused(what: str, path: Path, problem: str) -> RecordingError:
    return RecordingError(f"{what}: {short_name(path)} {problem}", f"{what}: its file {problem}")
