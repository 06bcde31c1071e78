"""VR-Caps exports (İncetan et al. 2021): what the simulator's recorder and `RecordMotion.cs` write into one folder.

    SEQ/image_%04d.png, SEQ/aov_image_%04d.png, SEQ/position_rotation.csv

Clock: row i of the pose file belongs to frame i; its `time(s)` is the simulated time.

Depth: device depth of Unity with reversed z, 8 bit. The clip planes depend on the scene (Record_scene: 0.01 and 2
Unity units) and are not stored, so depth is relative until near, far and the metres per unit are declared.

Truth: the poses are the CAPSULE's, left-handed, in Unity units of unknown size. They become truth when the user
declares the unit and a calibration whose `T_body_camera` says where the camera sits in the capsule (in Record_scene,
unsteered: position (-0.5, -0.4, -0.4) times the capsule's scale 0.1, rotation x, y, z, w = -0.553, 0.104, -0.330,
0.758, in Unity's axes). A camera that was steered has no fixed place, and nothing in the files shows it. The world is
Unity's with y turned down: gravity points along +y, so levelled alignments do not apply.

No IMU: the simulator writes none. Camera: unknown unless declared (the scene's physical camera is not exported).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vio.errors import RecordingError
from vio.formats.declared import OPTIONS, Declared
from vio.formats.files import has_numbered, numbered
from vio.formats.unity import UnityPoses, read_unity_poses, unity_depth
from vio.imu import ImuSamples
from vio.recording import Recording
from vio.trajectory import Trajectory

LAYOUT = "VR-Caps: image_0000.png and position_rotation.csv in one folder"
ACCEPTS = frozenset({"calibration", "unit_m", "depth_planes"})
FRAME = r"image_(\d{1,9})\.png"
DEPTH = r"aov_image_(\d{1,9})\.png"
POSES = "position_rotation.csv"


def matches(path: str | Path) -> bool:
    """Whether `path` holds a pose file and frames."""
    return (Path(path) / POSES).is_file() and has_numbered(Path(path), FRAME)


def read_vrcaps(path: str | Path, declared: Declared | None = None) -> Recording:
    """Read one export.

    Raises:
        RecordingError: no frames, or a frame without its row in the pose file.
        FormatError: an unusable row of the pose file.
    """
    declared, root = declared or Declared(), Path(path)
    frames, depths = numbered(root, FRAME), numbered(root, DEPTH)
    if not frames:
        raise RecordingError(f"{root.name}: no image_0000.png; give the folder of one export")
    poses = read_unity_poses(root / POSES)
    numbers = np.array(list(frames))
    if numbers[-1] >= len(poses.t_ns):
        raise RecordingError(f"{root.name}: frame {numbers[numbers >= len(poses.t_ns)][0]} has no row in {POSES} "
                             f"({len(poses.t_ns)} rows): its time is unknown; take the frames after it away")
    t_ns = np.asarray(poses.t_ns[numbers])
    truth = _truth(poses, int(t_ns[0]), declared)
    return Recording(
        root.name, t_ns, ImuSamples.none(), declared.calibration_or(None), truth=truth,
        frame_paths=tuple(frames.values()), depth_paths=tuple(depths.get(k) for k in frames),
        depth_encoding=unity_depth(declared),
        provenance={"format": "vrcaps", "truth": "poses of the capsule at the declared unit" if truth else
                    f"none: needs {OPTIONS['unit_m']}, and {OPTIONS['calibration']} that places the camera"},
    )


def _truth(poses: UnityPoses, first_ns: int, declared: Declared) -> Trajectory | None:
    if declared.unit_m is None or declared.calibration is None:
        return None
    T_world_body = poses.T_world_object.copy()
    T_world_body[:, :3, 3] *= declared.unit_m
    return Trajectory(np.asarray((poses.t_ns - first_ns) * 1e-9), T_world_body)
