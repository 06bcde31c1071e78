"""SimCol3D (Rau et al. 2022): rendered colonoscopy with depth and poses.

    COLON/Frames_XK/FrameBuffer_%04d.png, Depth_%04d.png      give this folder
    COLON/SavedPosition_XK.txt, SavedRotationQuaternion_XK.txt, cam.txt     optional

Clock: none; declare a rate.

Depth: 16 bit, z in cm = counts / 256 / 255 * 20, of which 8 bit carry information (steps of 0.8 mm); the highest step
(20 cm) means "there or beyond" and is taken as unknown. Images are 16 bit of 8 with alpha, read as 8-bit colour.

Truth: row i of the pose files belongs to frame number i; position x, y, z in cm, quaternion x, y, z, w, left-handed;
P' = S P S with S = diag(1, -1, 1, 1) is camera to world, camera x right, y down, z forward. Where gravity points is
unknown. Camera: `cam.txt` (3 x 3, row by row), else unknown unless declared; copies of it in circulation differ in
which of 227.6 and 237.5 pixels are focal lengths, so none is built in. No IMU.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vio import se3
from vio.calibration import Calibration
from vio.camera import Camera
from vio.depth import LinearDepth
from vio.errors import CameraError, FormatError, RecordingError
from vio.formats.declared import Declared
from vio.formats.files import has_numbered, numbered, stamps_at_rate
from vio.formats.table import TextTable, check_quaternions, parse_floats, read_table
from vio.formats.unity import right_handed
from vio.image_files import size_of
from vio.imu import ImuSamples
from vio.recording import Recording
from vio.trajectory import Trajectory

Array = NDArray[np.float64]

LAYOUT = "SimCol3D: FrameBuffer_0000.png beside Depth_0000.png"
ACCEPTS = frozenset({"calibration", "rate_hz"})
FRAME, DEPTH = r"FrameBuffer_(\d{1,9})\.png", r"Depth_(\d{1,9})\.png"
DEPTH_ENCODING = LinearDepth(unit_m=0.2 / (256 * 255), largest=256 * 255 - 1)
CM = 1e-2


def matches(path: str | Path) -> bool:
    """Whether `path` holds frames in this naming."""
    return has_numbered(Path(path), FRAME)


def read_simcol3d(path: str | Path, declared: Declared | None = None) -> Recording:
    """Read one folder of frames.

    Raises:
        RecordingError: no frames, no declared rate, only one of the two pose files, or a frame without a row.
        FormatError: an unusable row.
    """
    declared, root = declared or Declared(), Path(path)
    frames, depths = numbered(root, FRAME), numbered(root, DEPTH)
    if not frames:
        raise RecordingError(f"{root.name}: no FrameBuffer_0000.png; give a folder Frames_…")
    numbers = np.array(list(frames))
    t_ns = stamps_at_rate(numbers, declared.rate_hz, "simcol3d")
    first = next(iter(frames.values()))
    calibration = declared.calibration or Calibration(_camera(root.resolve().parent / "cam.txt", first))
    return Recording(
        root.name, t_ns, ImuSamples.none(), calibration,
        truth=_truth(root.resolve(), numbers, t_ns, calibration),
        frame_paths=tuple(frames.values()), depth_paths=tuple(depths.get(k) for k in frames),
        depth_encoding=DEPTH_ENCODING,
        provenance={"format": "simcol3d", "clock": "constant rate, declared"},
    )


def _camera(file: Path, image: Path) -> Camera | None:
    if not file.is_file():
        return None
    table = read_table(file)
    try:
        K = np.array(" ".join(table.rows).replace(",", " ").split(), float)
    except ValueError:
        raise FormatError(f"{table.name}: not numbers; expected 9, row by row") from None
    if len(K) != 9:
        raise FormatError(f"{table.name}: {len(K)} numbers, expected 9, row by row")
    width, height = size_of(image, "first frame")
    try:
        return Camera("pinhole", width, height, K[0], K[4], K[2], K[5])
    except CameraError as error:
        raise FormatError(f"{table.name}: {error}") from None


def _truth(
    root: Path, numbers: NDArray[np.int64], t_ns: NDArray[np.int64], calibration: Calibration
) -> Trajectory | None:
    name = root.name.removeprefix("Frames_")
    positions, rotations = (root.parent / f"{kind}_{name}.txt" for kind in ("SavedPosition", "SavedRotationQuaternion"))
    if not positions.is_file() and not rotations.is_file():
        return None
    place, turn = read_table(positions), read_table(rotations)
    xyz_cm = parse_floats(place, range(3), None, FormatError)
    quat_xyzw = check_quaternions(parse_floats(turn, range(4), None, FormatError), turn, FormatError)
    _check_rows(place, turn, numbers)
    T_world_camera = right_handed(se3.transform(se3.matrix_from_quat_xyzw(quat_xyzw), xyz_cm * CM))[numbers]
    return Trajectory(np.asarray(t_ns * 1e-9), T_world_camera @ se3.inverse(calibration.T_body_camera))


def _check_rows(place: TextTable, turn: TextTable, numbers: NDArray[np.int64]) -> None:
    if len(place.rows) != len(turn.rows):
        raise FormatError(f"{place.name} has {len(place.rows)} rows, {turn.name} {len(turn.rows)}; restore the shorter")
    if numbers[-1] >= len(place.rows):
        raise RecordingError(f"{place.name}: {len(place.rows)} rows, but there is a frame {numbers[-1]}; restore the "
                             "missing rows")
