"""Depth maps on disk beside a recording: a folder laid out as `mav0/depth0`, such as `predict --depth` writes."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vio.calibration import load_yaml, number
from vio.depth import DepthEncoding, LinearDepth
from vio.errors import CalibrationError, FormatError
from vio.formats.asl import read_depth_listing
from vio.image_files import decode_image
from vio.recording import Recording

PREDICTION = "prediction.json"
"""Marks maps that a network predicted, one for every frame, metric at the prior scale."""
SD_FOLDER, SD_UNIT_KEY = "sd", "log_depth_sd_unit"
LARGEST_IMAGE_LOG_SD = 5.0
NS = 1e-9


@dataclass(frozen=True)
class DepthFolder:
    """N depth maps, read when asked for."""

    name: str
    t_ns: NDArray[np.int64]
    """(N,) stamps."""
    files: tuple[Path, ...]
    encoding: DepthEncoding
    """What the pixels mean."""
    predicted: bool
    """Metric at the prior scale of the predictor, not measured."""
    start_ns: int
    """Stamp of the recording's first frame."""
    log_sd_unit: float | None = None
    """Sd of ln depth per count of the maps in `sd/` beside; None where there are none."""
    image_log_sd: float | None = None
    """Sd of the ln scale that all pixels of one image are off by, once the scale of the motions is right; None where
    nothing says."""

    def depth_m(self, t_s: float) -> NDArray[np.float32] | None:
        """z-depth (H, W) [m] of the frame at a time after the first frame, 0 where unknown; None when not mapped.

        Raises:
            RecordingError: the map is absent, cut off, undecodable, not of its declared kind, or of unknown scale.
        """
        file = self._file(t_s)
        if file is None:
            return None
        what = f"{self.name}: depth at {t_s:.3f} s"
        return self.encoding.depth_m(decode_image(file, what, depth=True), what)

    def log_sd(self, t_s: float) -> NDArray[np.float32] | None:
        """Sd (H, W) of ln depth of the frame at a time, 0 where depth is unknown; None where nothing says.

        Raises:
            RecordingError: the map is absent, cut off or undecodable.
        """
        file = self._file(t_s)
        if file is None or self.log_sd_unit is None:
            return None
        counts = decode_image(file.parent.parent / SD_FOLDER / file.name, f"{self.name}: sd of depth at {t_s:.3f} s",
                              depth=True)
        return np.asarray(counts, np.float32) * np.float32(self.log_sd_unit)

    def _file(self, t_s: float) -> Path | None:
        off = np.abs((self.t_ns - self.start_ns) * NS - t_s)
        k = int(np.argmin(off))
        return self.files[k] if off[k] <= 1e-3 else None


def read_depth_folder(folder: str | Path, recording: Recording | None = None) -> DepthFolder:
    """Open a folder of depth maps.

    Args:
        folder: with `data.csv`, `sensor.yaml` and `data/`.
        recording: the recording they belong to. Without it the first map is taken for the first frame's, which holds
            for predicted maps only.

    Raises:
        FormatError: no depth folder, or without a recording no predicted one.
        VioError: a file of it is unusable, naming file and line.
    """
    folder = Path(folder)
    if not (folder / "data.csv").is_file():
        raise FormatError(f"{folder.name}: no data.csv; give a folder of depth maps as `predict --depth` writes it")
    t_ns, files, unit_m, encoding = read_depth_listing(folder)
    predicted = (folder / PREDICTION).is_file()
    if recording is None and not predicted:
        raise FormatError(f"{folder.name}: no {PREDICTION}, so the first map need not be the first frame's; name the "
                          "recording too")
    start_ns = int(t_ns[0]) if recording is None else int(recording.frame_t_ns[0])
    return DepthFolder(folder.resolve().name, t_ns, files, encoding or LinearDepth(unit_m), predicted, start_ns,
                       _log_sd_unit(folder), _image_log_sd(folder / PREDICTION) if predicted else None)


def _log_sd_unit(folder: Path) -> float | None:
    sensor = load_yaml(folder / "sensor.yaml")
    if SD_UNIT_KEY not in sensor or not (folder / SD_FOLDER).is_dir():
        return None
    unit = number(sensor, SD_UNIT_KEY, "sensor.yaml")
    if not 0 < unit < 1:
        raise CalibrationError(f"sensor.yaml: {SD_UNIT_KEY} is {unit:g}; must be between 0 and 1, such as 1e-4")
    return unit


def _image_log_sd(path: Path) -> float | None:
    """Weights that were not calibrated for it say how far images are off at the prior scale, which is more."""
    remedy = "predict the depth again"
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise FormatError(f"{path.name}: not valid JSON; {remedy}") from None
    said = content.get("depth_uncertainty") if isinstance(content, dict) else None
    value = said.get("image_log_sd", said.get("common_log_sd")) if isinstance(said, dict) else None
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < LARGEST_IMAGE_LOG_SD:
        raise FormatError(f"{path.name}: the sd of an image's ln scale is {value!r}; must be a number between 0 and "
                          f"{LARGEST_IMAGE_LOG_SD:g}; {remedy}")
    return float(value)
