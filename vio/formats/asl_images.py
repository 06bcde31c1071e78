"""The image folders of an ASL recording: `cam0/data` and `depth0/data`, copied or encoded one file at a time."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vio.depth import LARGEST_COUNT, LinearDepth, RelativeInverseDepth, to_counts
from vio.errors import CalibrationError, RecordingError
from vio.image_files import decode_image
from vio.recording import Recording

Progress = Callable[[int, int], None]

CAMERA_HEADER = "#timestamp [ns],filename"
ENCODING_KEY, RELATIVE = "depth_encoding", "relative-inverse"


def write_frames(sensor: Path, recording: Recording, check: bool, progress: Progress | None) -> None:
    """Write `data.csv` and `data/`: files are copied byte for byte, frames of a film become PNG.

    Args:
        sensor: the folder `cam0`.
        recording: whose frames.
        check: decode every frame that exists before it is copied, and compare their sizes.
        progress: called with (frames done, frames in all).

    Raises:
        RecordingError: with `check`, a frame that is damaged or has another size than the first; always, a film that
            ends too early.
    """
    (sensor / "data").mkdir(parents=True)
    size: tuple[int, ...] | None = None
    rows = [CAMERA_HEADER]
    for k, (t, file) in enumerate(zip(recording.frame_t_ns.tolist(), recording.frame_paths, strict=True)):
        name = f"{t}{'.png' if file is None else file.suffix.lower()}"
        if recording.video is not None or (check and file is not None and file.is_file()):
            image = recording.frame(k)
            size = _same_size(image, size, k)
            if recording.video is not None:
                write_png(sensor / "data" / name, image[..., ::-1])
        if file is not None and file.is_file():
            shutil.copyfile(file, sensor / "data" / name)
        rows.append(f"{t},{name}")
        if progress is not None:
            progress(k + 1, len(recording))
    (sensor / "data.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")


def write_depth(sensor: Path, recording: Recording) -> dict[str, Any]:
    """Write `data.csv` and `data/`; returns the content of `sensor.yaml`.

    Plain 16-bit z-depth and relative depth are copied byte for byte; every other encoding becomes 16-bit PNG.

    Raises:
        RecordingError: a depth image that has to be converted is damaged.
    """
    (sensor / "data").mkdir(parents=True)
    encoding, rows = recording.stored_depth, [CAMERA_HEADER]
    for k, (t, file) in enumerate(zip(recording.frame_t_ns.tolist(), recording.depth_paths, strict=True)):
        if file is None:
            continue
        target = sensor / "data" / f"{t}.png"
        counts = _counts(recording, k, file)
        if counts is None and file.is_file():
            target = target.with_suffix(file.suffix.lower())
            shutil.copyfile(file, target)
        elif counts is not None:
            write_png(target, counts)
        rows.append(f"{t},{target.name}")
    (sensor / "data.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    meaning = {"depth_unit_m": float(encoding.unit_m)} if encoding.metric else {ENCODING_KEY: RELATIVE}
    return {"sensor_type": "depth"} | meaning


def depth_encoding_from_asl(data: dict[str, Any], name: str) -> RelativeInverseDepth | None:
    """What `depth0/sensor.yaml` says beside plain 16-bit z-depth.

    Raises:
        CalibrationError: an encoding that this version does not know.
    """
    if data.get(ENCODING_KEY) is None:
        return None
    if data[ENCODING_KEY] != RELATIVE:
        raise CalibrationError(f"{name}: {ENCODING_KEY} {data[ENCODING_KEY]!r} is unknown; this version knows "
                               f"{RELATIVE!r}")
    return RelativeInverseDepth()


def write_png(path: Path, image: NDArray[Any]) -> None:
    """Write a PNG without loss; colours in B, G, R order.

    Raises:
        OSError: the file cannot be written.
    """
    import cv2

    encoded, content = cv2.imencode(".png", np.ascontiguousarray(image))  # OpenCV's defaults are its fastest
    if not encoded:
        raise RecordingError(f"{path.name}: an image of {image.dtype} {image.shape} cannot be stored as PNG")
    path.write_bytes(content.tobytes())


def _counts(recording: Recording, k: int, file: Path) -> NDArray[np.uint16] | None:
    """Depth of frame k as 16-bit counts where the file cannot be copied as it is; None where it can."""
    encoding, what = recording.stored_depth, f"depth of frame {k}"
    if not encoding.metric or recording.depth_encoding is None:
        return None
    image = decode_image(file, what, depth=True)
    if not isinstance(encoding, LinearDepth):
        return to_counts(encoding.depth_m(image, what), encoding.unit_m)
    plain = file.suffix.lower() == ".png" and image.max(initial=0) <= min(encoding.largest, LARGEST_COUNT)
    return None if plain and image.dtype == np.uint16 else encoding.counts(image, what)


def _same_size(image: NDArray[Any], size: tuple[int, ...] | None, k: int) -> tuple[int, ...]:
    if size is not None and image.shape[:2] != size:
        raise RecordingError(f"frame {k}: {image.shape[1]} x {image.shape[0]} pixels after frames of {size[1]} x "
                             f"{size[0]}; all frames of a recording must have one size")
    return image.shape[:2]
