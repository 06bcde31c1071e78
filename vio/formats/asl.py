"""The ASL layout of EuRoC (Burri et al. 2016), in and out: `mav0/{cam0,imu0,...}/data.csv` and `sensor.yaml`.

Stamps are int64 nanoseconds and stay so. `T_BS` maps sensor to body, body = IMU. Truth is the pose of the body in a
world with z up; its quaternions are w, x, y, z. Ours beside the original: `depth0` with 16-bit z-depth (or with
inverse depth up to a factor, marked in its `sensor.yaml`), and `recording.yaml` with provenance. A recording without
`imu0` has no inertial samples, one whose `cam0/sensor.yaml` describes no camera has an unknown camera.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from vio.atomic import atomic_folder
from vio.calibration import (
    Calibration,
    T_body_sensor_from_asl,
    camera_from_asl,
    camera_to_asl,
    imu_from_asl,
    imu_to_asl,
    load_yaml,
    number,
    short_name,
)
from vio.depth import DepthEncoding
from vio.errors import CalibrationError, FormatError, ImuError, RecordingError
from vio.formats.asl_images import CAMERA_HEADER, Progress, depth_encoding_from_asl, write_depth, write_frames
from vio.formats.asl_truth import TRUTH, write_asl_truth
from vio.formats.asl_truth import read_asl_truth as read_asl_truth
from vio.formats.table import TextTable, parse_floats, parse_stamps, read_table, write_stamped_rows
from vio.imu import ImuSamples
from vio.recording import Recording

SCHEMA = 1
MARKER = "recording.yaml"
LAYOUT = "ASL/EuRoC: mav0/cam0/data.csv and mav0/imu0/data.csv"
CAMERA_KEYS = {"camera_model", "intrinsics", "distortion_model", "distortion_coefficients", "resolution"}
IMU_HEADER = "#timestamp [ns],w_x [rad/s],w_y [rad/s],w_z [rad/s],a_x [m/s^2],a_y [m/s^2],a_z [m/s^2]"


def matches(path: str | Path) -> bool:
    """Whether `path` is a folder in ASL layout (the recording, or its `mav0`)."""
    mav0 = _folders(Path(path))[1]
    return (mav0 / "cam0").is_dir() or (mav0 / "imu0").is_dir()


def read_asl(path: str | Path) -> Recording:
    """Read a recording; images stay on disk until they are asked for, and may be absent.

    Raises:
        RecordingError: a part is missing, no frames are listed, or `recording.yaml` has an unknown schema.
        FormatError, ImuError: a row of a table is unusable, naming file and line.
        CalibrationError: a calibration key is missing or impossible, naming file and key.
    """
    root, mav0 = _folders(Path(path))
    has_imu = (mav0 / "imu0").is_dir()
    _check_tables(root.name, mav0, ("cam0", "imu0") if has_imu else ("cam0",))
    frame_t_ns, frame_paths = _read_listing(mav0 / "cam0")
    calibration = _read_calibration(mav0, any(file.is_file() for file in frame_paths))
    depth_paths, depth_unit_m, depth_encoding = _read_depth(mav0 / "depth0", frame_t_ns)
    truth_file = mav0 / TRUTH / "data.csv"
    truth = read_asl_truth(truth_file, int(frame_t_ns[0])) if truth_file.is_file() else None
    return Recording(
        name=root.name,
        frame_t_ns=frame_t_ns,
        imu=read_asl_imu(mav0 / "imu0" / "data.csv") if has_imu else ImuSamples.none(),
        calibration=calibration,
        truth=None if truth is None else truth.trajectory,
        frame_paths=frame_paths,
        depth_paths=depth_paths,
        provenance=_read_provenance(root / MARKER),
        depth_unit_m=depth_unit_m,
        truth_state=None if truth is None else truth.state,
        depth_encoding=depth_encoding,
    )


def _check_tables(name: str, mav0: Path, parts: tuple[str, ...]) -> None:
    why = {"cam0": "frame times are needed even without images", "imu0": "inertial samples are needed"}
    for part in parts:
        if not (mav0 / part / "data.csv").is_file():
            raise RecordingError(f"{name}: no {part}/data.csv; {why[part]}")


def read_asl_imu(path: str | Path) -> ImuSamples:
    """Read `imu0/data.csv`: stamp, gyro xyz [rad/s], accelerometer xyz [m/s²].

    Raises:
        ImuError: an unusable row (naming its line), or a header that declares other units.
    """
    table = read_table(Path(path), ImuError)
    for unit, remedy in (("deg", "convert the gyro to rad/s"), ("[g]", "convert the accelerometer to m/s²")):
        if unit in table.header:
            raise ImuError(f"{table.name}: the header declares {unit!r}; {remedy} and correct the header")
    t_ns = parse_stamps(table, ImuError)
    values = parse_floats(table, range(1, 7), ",", ImuError)
    return ImuSamples(t_ns, values[:, :3].copy(), values[:, 3:].copy())


def write_asl(
    recording: Recording, out: str | Path, *, check: bool = False, progress: Progress | None = None
) -> None:
    """Write a recording as a whole folder, or nothing. Image files that exist are copied, the others only listed.

    An existing folder is replaced only if it holds `recording.yaml`. Truth without a `TruthState` has 8 columns;
    without inertial samples there is no `imu0`.

    Args:
        recording: what to write.
        out: the folder.
        check: decode every frame on the way, so that a damaged one refuses the whole.
        progress: called with (frames done, frames in all).

    Raises:
        RecordingError: a film ends too early, depth that must be converted is damaged, or (with `check`) a frame is.
        OutputError: `out` exists and is not ours, or cannot be written.
    """
    with atomic_folder(out, MARKER) as folder:
        write_asl_files(recording, folder, check, progress)


def write_asl_files(recording: Recording, folder: Path, check: bool = False, progress: Progress | None = None) -> None:
    """Write the files of `write_asl` into an existing folder, for a caller that adds more before it is whole."""
    mav0 = folder / "mav0"
    t_ns = recording.frame_t_ns
    rate_hz = 1e9 / float(np.median(np.diff(t_ns))) if len(t_ns) > 1 else None
    _write_sensor(mav0 / "cam0", camera_to_asl(recording.calibration, rate_hz))
    write_frames(mav0 / "cam0", recording, check, progress)
    if len(recording.imu):
        _write_sensor(mav0 / "imu0", imu_to_asl(recording.calibration))
        inertial = np.hstack([recording.imu.gyro_rad_s, recording.imu.accel_m_s2])
        write_stamped_rows(mav0 / "imu0" / "data.csv", IMU_HEADER, recording.imu.t_ns, inertial)
    if recording.truth is not None:
        write_asl_truth(mav0 / TRUTH / "data.csv", recording.truth, recording.truth_state, int(t_ns[0]))
    if recording.has_depth_images:
        _write_sensor(mav0 / "depth0", write_depth(mav0 / "depth0", recording))
    (folder / MARKER).write_text(_provenance_text(recording), encoding="utf-8")


def _folders(path: Path) -> tuple[Path, Path]:
    """The recording's folder and the one that holds the sensors: `mav0`, or itself where that level is left out."""
    if path.resolve().name == "mav0":
        return path.parent if path.name == "mav0" else path / "..", path
    return path, path / "mav0" if (path / "mav0").is_dir() else path


def _read_listing(sensor: Path) -> tuple[NDArray[np.int64], tuple[Path, ...]]:
    """Stamps and image files of `data.csv`."""
    table = read_table(sensor / "data.csv")
    t_ns = parse_stamps(table, FormatError)
    if len(t_ns) == 0:
        raise RecordingError(f"{table.name}: lists no frames; at least one time is needed")
    return t_ns, tuple(sensor / "data" / _file_name(table, k) for k in range(len(t_ns)))


def _file_name(table: TextTable, row: int) -> str:
    """The second column, which must stay inside the `data` folder; `<stamp>.png` when it is left out."""
    fields = [field.strip() for field in table.rows[row].split(",")]
    name = fields[1] if len(fields) > 1 and fields[1] else f"{fields[0]}.png"
    if Path(name).name != name or "\\" in name or name == "..":
        raise FormatError(f"{table.at(row)}: {name!r} is not a plain file name; images lie in the `data` folder")
    return name


def _read_calibration(mav0: Path, images: bool) -> Calibration:
    camera_file, imu_file = mav0 / "cam0" / "sensor.yaml", mav0 / "imu0" / "sensor.yaml"
    data, name = load_yaml(camera_file), short_name(camera_file)
    described = "intrinsics" in data or (images and not CAMERA_KEYS.isdisjoint(data))
    camera = camera_from_asl(data, name) if described else None
    T_body_camera = T_body_sensor_from_asl(data, name)
    if not imu_file.parent.is_dir():
        return Calibration(camera, T_body_camera)
    noise, offset_s = imu_from_asl(load_yaml(imu_file), short_name(imu_file))
    return Calibration(camera, T_body_camera, noise, offset_s)


def _read_depth(
    sensor: Path, frame_t_ns: NDArray[np.int64]
) -> tuple[tuple[Path | None, ...], float, DepthEncoding | None]:
    """Depth file of every frame (matched by equal stamps), metres per count, and how they are stored if not plainly."""
    if not (sensor / "data.csv").is_file():
        return (), 1e-3, None
    t_ns, files, unit_m, encoding = read_depth_listing(sensor)
    stray = ~np.isin(t_ns, frame_t_ns)
    if stray.any():
        raise FormatError(f"{short_name(sensor / 'data.csv')}: stamp {t_ns[np.argmax(stray)]} is no frame of cam0; "
                          "depth images carry the stamp of their frame")
    by_stamp = dict(zip(t_ns.tolist(), files, strict=True))
    return tuple(by_stamp.get(t) for t in frame_t_ns.tolist()), unit_m, encoding


def read_depth_listing(
    sensor: Path,
) -> tuple[NDArray[np.int64], tuple[Path, ...], float, DepthEncoding | None]:
    """Stamps (N,) and files of a folder laid out as `mav0/depth0`, metres per count, and the encoding if not plain.

    Raises:
        VioError: `data.csv` or `sensor.yaml` is missing or unusable, naming file and line.
    """
    name, data = short_name(sensor / "sensor.yaml"), load_yaml(sensor / "sensor.yaml")
    encoding = depth_encoding_from_asl(data, name)
    unit_m = number(data, "depth_unit_m", name) if encoding is None else 1e-3
    if unit_m <= 0:
        raise CalibrationError(f"{name}: depth_unit_m is {unit_m:g}, must be positive metres")
    return *_read_listing(sensor), unit_m, encoding


def _read_provenance(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    data = load_yaml(path)
    if data.get("schema") != SCHEMA:
        raise RecordingError(f"{path.name}: schema {data.get('schema')!r} is unknown; this version reads {SCHEMA}")
    provenance = data.get("provenance") or {}
    if not isinstance(provenance, dict):
        raise RecordingError(f"{path.name}: provenance must be `key: value` lines")
    return provenance


def _provenance_text(recording: Recording) -> str:
    content = {"schema": SCHEMA, "name": recording.name, "provenance": recording.provenance}
    try:
        return yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
    except yaml.YAMLError:
        raise RecordingError(f"recording {recording.name}: provenance must be plain text, numbers, lists and mappings; "
                             "convert arrays and numpy numbers") from None


def _write_sensor(sensor: Path, data: dict[str, Any]) -> None:
    sensor.mkdir(parents=True, exist_ok=True)
    lines = [yaml.safe_dump({key: value}, default_flow_style=None if isinstance(value, dict | list) else False)
             for key, value in data.items()]  # one key a line, lists in brackets
    (sensor / "sensor.yaml").write_text("".join(lines), encoding="utf-8")



def write_image_stream(sensor: Path, t_ns: NDArray[np.int64], description: dict[str, Any],
                       suffix: str = ".png") -> Path:
    """Start a stream of one file per stamp beside cam0: `sensor.yaml`, `data.csv`, and the empty `data`, returned."""
    (sensor / "data").mkdir(parents=True)
    _write_sensor(sensor, description)
    rows = [CAMERA_HEADER, *(f"{t},{t}{suffix}" for t in t_ns.tolist())]
    (sensor / "data.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    return sensor / "data"
