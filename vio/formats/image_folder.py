"""One's own frames: a folder of images with a table that says when each was taken.

    REC/frames.csv      title line; one column of time (t_ns, t_us, t_ms or t_s) and `filename`; comma, semicolon or tab
    REC/<filename>      PNG or JPEG, anywhere below REC
    REC/imu.csv, camchain.yaml, imu.yaml    optional: `vio.formats.sidecar`

Clock: whatever the table says, kept exact to the nanosecond. Frames: camera x right, y down, z forward; body = IMU,
or the camera where there is no IMU. No truth, no depth. Refused: names that leave the folder, times that do not
increase, an IMU without a calibration. Without an IMU the recording can be predicted on, not refined; without a
calibration the camera is unknown.
"""

from __future__ import annotations

from pathlib import Path

from vio.errors import FormatError
from vio.formats.declared import Declared
from vio.formats.files import inside
from vio.formats.named_table import read_named_table
from vio.formats.sidecar import read_sidecar
from vio.recording import Recording

LAYOUT = "frames.csv (time, filename) beside images"
ACCEPTS = frozenset({"calibration"})
TABLE = "frames.csv"


def matches(path: str | Path) -> bool:
    """Whether `path` is a folder with `frames.csv`."""
    return (Path(path) / TABLE).is_file()


def read_image_folder(path: str | Path, declared: Declared | None = None) -> Recording:
    """Read a folder of images with `frames.csv`.

    Raises:
        FormatError: an unusable row, a missing column, or a file that is absent or outside the folder, naming the
            line.
        ImuError, CalibrationError: as `vio.formats.sidecar`.
    """
    root = Path(path)
    table = read_named_table(root / TABLE)
    t_ns = table.times_ns()
    files = tuple(inside(root, name, table.table.at(k)) for k, name in enumerate(table.texts("filename")))
    missing = next((k for k, file in enumerate(files) if not file.is_file()), None)
    if missing is not None:
        raise FormatError(f"{table.table.at(missing)}: there is no file {files[missing].name!r} below the recording's "
                          "folder; restore it or drop the row")
    imu, calibration = read_sidecar(root, declared or Declared())
    return Recording(root.name, t_ns, imu, calibration, frame_paths=files,
                     provenance={"format": "images", "clock": "times as listed in frames.csv"})
