"""Predicted depth maps on disk, in the layout of a recording's own `mav0/depth0`.

    DIR/data.csv             #timestamp [ns],filename
    DIR/data/<stamp>.png     16-bit z-depth, 0 = unknown
    DIR/sensor.yaml          depth_unit_m: metres per count
    DIR/sd/<stamp>.png       16-bit sd of ln depth in 1e-4, 0 = unknown; only from weights that can say
    DIR/prediction.json      where they come from; marks the folder as ours
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from vio.atomic import atomic_folder
from vio.errors import ConfigError

MARKER = "prediction.json"
SD_FOLDER = "sd"
LARGEST_COUNT = 65535
LOG_SD_UNIT = 1e-4
"""Standard deviation of ln depth per count of the sd maps."""


@dataclass
class DepthMaps:
    """Writes one map after the other into a folder that `depth_folder` has opened."""

    folder: Path
    """Where the files are written now."""
    target: Path
    """Where they will lie once all are written."""
    unit_m: float
    """Metres per count; 65535 counts are the farthest depth that can be stored."""
    metres_per_unit: float
    """Metres per motion unit, the predictor's prior."""
    with_sd: bool = False
    """Whether a map of standard deviations lies beside every depth map."""
    names: list[str] = field(default_factory=list)

    def write(self, t_ns: int, depth: NDArray[np.float64], shape: tuple[int, int],
              log_sd: NDArray[np.float64] | None = None) -> None:
        """Write the map of the frame at `t_ns`.

        Args:
            t_ns: stamp of the frame.
            depth: (h, w) z-depth in motion units; not finite or not positive where unknown.
            shape: (H, W) of the frame; a smaller or larger map is brought to it by nearest neighbour.
            log_sd: (h, w) standard deviation of ln depth; None = unknown everywhere. Written when `with_sd`.
        """
        counts = np.where(np.isfinite(depth), depth, 0.0) * (self.metres_per_unit / self.unit_m)
        known = (counts >= 0.5) & (counts <= LARGEST_COUNT)
        name = f"{t_ns}.png"
        _write_counts(self.images / name, np.where(known, counts, 0), shape)
        if self.with_sd:
            sd = np.zeros(depth.shape) if log_sd is None else np.clip(log_sd / LOG_SD_UNIT, 1, LARGEST_COUNT)
            (self.folder / SD_FOLDER).mkdir(exist_ok=True)
            _write_counts(self.folder / SD_FOLDER / name, np.where(known, sd, 0), shape)
        self.names.append(name)

    @property
    def images(self) -> Path:
        """Where the maps are written now."""
        return self.folder / "data"

    @property
    def folders(self) -> tuple[Path, ...]:
        """Every folder that gets one file per map now."""
        return (self.images, self.folder / SD_FOLDER) if self.with_sd else (self.images,)

    @property
    def files(self) -> tuple[Path, ...]:
        """The maps, in the order of their frames."""
        return tuple(self.target / "data" / name for name in sorted(self.names, key=_stamp))

    @property
    def sd_files(self) -> tuple[Path, ...] | None:
        """The maps of standard deviations, in the order of their frames; None when none are written."""
        if not self.with_sd:
            return None
        return tuple(self.target / SD_FOLDER / name for name in sorted(self.names, key=_stamp))


def _write_counts(path: Path, counts: NDArray[np.float64], shape: tuple[int, int]) -> None:
    image = np.rint(counts).astype(np.uint16)
    if image.shape != shape:
        image = cv2.resize(image, (shape[1], shape[0]), interpolation=cv2.INTER_NEAREST).astype(np.uint16)
    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())


@contextmanager
def depth_folder(
    target: str | Path, unit_m: float, metres_per_unit: float, meta: Mapping[str, Any]
) -> Iterator[DepthMaps]:
    """Open a folder of depth maps that appears as a whole when the block succeeds, or not at all.

    Raises:
        ConfigError: a unit that is not a positive length.
        OutputError: `target` exists and is not ours, cannot be written, or the disk is full.
    """
    if not (np.isfinite(unit_m) and unit_m > 0):
        raise ConfigError(f"depth_unit_m is {unit_m}, must be positive metres per count, such as 1e-5")
    with atomic_folder(target, MARKER) as folder:
        (folder / "data").mkdir()
        maps = DepthMaps(folder, Path(target), unit_m, metres_per_unit)
        yield maps
        rows = ["#timestamp [ns],filename", *(f"{_stamp(name)},{name}" for name in sorted(maps.names, key=_stamp))]
        (folder / "data.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
        sensor = {"sensor_type": "depth", "depth_unit_m": float(unit_m)}
        if maps.with_sd:
            sensor["log_depth_sd_unit"] = LOG_SD_UNIT
        (folder / "sensor.yaml").write_text(yaml.safe_dump(sensor, sort_keys=False), encoding="utf-8")
        (folder / MARKER).write_text(json.dumps(dict(meta), indent=2, sort_keys=True) + "\n", encoding="utf-8")


def _stamp(name: str) -> int:
    return int(Path(name).stem)
