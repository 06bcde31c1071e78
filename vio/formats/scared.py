"""SCARED (Allan et al. 2021), frames and points unpacked: a da Vinci endoscope with structured light.

    KEYFRAME/data/left/frame_data%06d.png              or left_finalpass; the left camera is read
    KEYFRAME/data/frame_data/frame_data%06d.json       camera-pose (4 x 4), camera-calibration (KL, DL)
    KEYFRAME/data/scene_points/scene_points%06d.tiff   optional: points x, y, z as floats, mm, left above right

Clock: none; declare a rate.

Depth: z of the left camera's points; 0, NaN and points behind the camera are unknown. Points were moved from the
keyframe by the robot's kinematics: they get worse with distance from it.

Truth: `camera-pose` takes keyframe coordinates (world) to camera coordinates, millimetres, right-handed, camera x
right, y down, z forward; three independent users of the data invert it to get camera to world, as is done here. It
comes from robot kinematics. Where gravity points is unknown. Camera: KL and DL (k1, k2, p1, p2, k3), which every
frame must repeat. No IMU.

`read_scared_curve` reads the relative poses that EndoDAC publishes (`gt_poses_sequence*.npz`): pose(k+1) pose(k)⁻¹,
mm.
"""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vio import se3
from vio.calibration import Calibration, short_name
from vio.camera import Camera
from vio.depth import PointMapDepth
from vio.errors import CameraError, FormatError, RecordingError
from vio.formats.camera_truth import body_truth, rigid
from vio.formats.declared import Declared
from vio.formats.files import has_numbered, numbered, stamps_at_rate
from vio.formats.table import read_text
from vio.image_files import size_of
from vio.imu import ImuSamples
from vio.recording import Recording

Array = NDArray[np.float64]

LAYOUT = "SCARED: data/left/frame_data000000.png with data/frame_data/*.json"
ACCEPTS = frozenset({"calibration", "rate_hz"})
FRAME, JSON, POINTS = r"frame_data(\d{6})\.png", r"frame_data(\d{6})\.json", r"scene_points(\d{6})\.tiff"
FRAME_FOLDERS = ("left", "left_finalpass")
DEPTH_ENCODING = PointMapDepth(stored_unit_m=1e-3, stacked=True)
MM = 1e-3


def matches(path: str | Path) -> bool:
    """Whether `path` is a keyframe folder, or its `data`, with the JSON of its frames."""
    return has_numbered(_data(Path(path)) / "frame_data", JSON)


def read_scared(path: str | Path, declared: Declared | None = None) -> Recording:
    """Read the left camera of one keyframe's sequence.

    Raises:
        RecordingError: no frames, or no declared rate.
        FormatError: a JSON file that is missing, unreadable or without its keys, or cameras that differ.
    """
    declared, root = declared or Declared(), Path(path)
    data = _data(root)
    folder = next((data / name for name in FRAME_FOLDERS if (data / name).is_dir()), data / FRAME_FOLDERS[0])
    frames, points = numbered(folder, FRAME), numbered(data / "scene_points", POINTS)
    if not frames:
        raise RecordingError(f"{root.name}: no data/left/frame_data000000.png; unpack the films and archives first")
    t_ns = stamps_at_rate(list(frames), declared.rate_hz, "scared")
    files = [data / "frame_data" / f"frame_data{k:06d}.json" for k in frames]
    notes = [_read_json(file) for file in files]
    calibration = declared.calibration or Calibration(_camera(notes, files, next(iter(frames.values()))))
    T_camera_world = np.array([_matrix(note, "camera-pose", file, 16) for note, file in zip(notes, files, strict=True)])
    T_camera_world = T_camera_world.reshape(-1, 4, 4)
    T_camera_world[:, :3, 3] *= MM
    T_world_camera = se3.inverse(rigid(T_camera_world, lambda k: short_name(files[k])))
    return Recording(
        root.name, t_ns, ImuSamples.none(), calibration, truth=body_truth(T_world_camera, t_ns, 0, calibration),
        frame_paths=tuple(frames.values()), depth_paths=tuple(points.get(k) for k in frames),
        depth_encoding=DEPTH_ENCODING,
        provenance={"format": "scared", "clock": "constant rate, declared", "truth": "robot kinematics"},
    )


def read_scared_curve(path: str | Path) -> Array:
    """Motions `T_i_j` (N, 4, 4), metres: pose of the camera at frame k + 1 in the camera at frame k.

    Raises:
        FormatError: no npz with `data` of shape (N, 4, 4), or a pose that is not rigid.
    """
    path = Path(path)
    try:
        with np.load(path) as file:
            stored = np.array(file["data"], float)
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile):
        raise FormatError(f"{short_name(path)}: not an npz file with numbers under `data`") from None
    if stored.ndim != 3 or stored.shape[1:] != (4, 4):
        raise FormatError(f"{short_name(path)}: data has shape {stored.shape}, expected (N, 4, 4)")
    stored[:, :3, 3] *= MM
    return se3.inverse(rigid(stored, lambda k: f"{short_name(path)} pose {k}"))


def _data(root: Path) -> Path:
    return root / "data" if (root / "data").is_dir() else root


def _read_json(file: Path) -> dict[str, Any]:
    try:
        note = json.loads(read_text(file))
    except (ValueError, RecursionError):
        raise FormatError(f"{short_name(file)}: not valid JSON; restore the file") from None
    if not isinstance(note, dict):
        raise FormatError(f"{short_name(file)}: expected keys and values, found {type(note).__name__}")
    return note


def _matrix(note: dict[str, Any], key: str, file: Path, count: int) -> Array:
    try:
        values = np.array(note[key], float).ravel()
    except (KeyError, TypeError, ValueError):
        raise FormatError(f"{short_name(file)}: {key!r} is missing or not numbers") from None
    if len(values) != count or not np.isfinite(values).all():
        raise FormatError(f"{short_name(file)}: {key!r} holds {len(values)} numbers, expected {count} finite ones")
    return values


def _camera(notes: list[dict[str, Any]], files: list[Path], image: Path) -> Camera:
    lenses = []
    for note, file in zip(notes, files, strict=True):
        entry = note.get("camera-calibration")
        if not isinstance(entry, dict):
            raise FormatError(f"{short_name(file)}: 'camera-calibration' is missing; declare the camera")
        lenses.append(np.concatenate([_matrix(entry, "KL", file, 9), _matrix(entry, "DL", file, 5)]))
        if (lenses[-1] != lenses[0]).any():
            raise FormatError(f"{short_name(file)}: KL or DL differs from the first frame's; one recording, one camera")
    K, distortion = lenses[0][:9], lenses[0][9:]
    width, height = size_of(image, "first frame")
    try:
        return Camera("pinhole", width, height, K[0], K[4], K[2], K[5], tuple(distortion.tolist()))
    except CameraError as error:
        raise FormatError(f"{short_name(files[0])}: {error}") from None
