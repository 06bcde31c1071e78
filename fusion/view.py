"""A run as a recording of the rerun viewer: poses with covariance, frames, depth cloud and lesions on one timeline.

The viewer is an optional companion (extra `view`); nothing else needs it. What is logged is for the eye: long runs are
thinned, pictures are small. Timeline `time`: seconds after the recording's first frame. World: as the run's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from fusion.result import Refinement, check_same_recording
from vio import se3
from vio.atomic import atomic_write
from vio.camera import Camera
from vio.depth_folder import DepthFolder
from vio.errors import OutputError
from vio.recording import Recording
from vio.thumbnails import thumbnail

Array = NDArray[np.float64]

MOST_POSES, MOST_PICTURES, MOST_POINTS = 5000, 600, 1500
PICTURE_PX = 256
RADIUS_SD = float(np.sqrt(chi2.ppf(0.95, 3)))
REFINED, MOTIONS, TRUTH, LESION, LANDMARK = (11, 104, 200), (208, 124, 31), (90, 98, 106), (179, 38, 122), (28, 124, 74)


def write_rerun(refinement: Refinement, path: str | Path, *, recording: Recording | None = None,
                depth: DepthFolder | None = None, lesions: Sequence[Mapping[str, Any]] | None = None) -> None:
    """Write the run as an `.rrd` file, atomically; open it with `rerun FILE`.

    Args:
        refinement: what to show.
        path: the file.
        recording: the recording that was refined: its frames, and its own depth where `depth` is not given.
        depth: predicted depth maps.
        lesions: rows of `lesions.json`.

    Raises:
        OutputError: rerun is not installed, or the file cannot be written.
        RecordingError: the recording is not the one that was refined, or one of its images is cut off or undecodable.
    """
    if recording is not None:
        check_same_recording(refinement, recording)
    rr = _rerun()
    stream = rr.RecordingStream("capsule-vio")
    memory = stream.memory_recording()
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    _log_tracks(rr, stream, refinement)
    _log_poses(rr, stream, refinement)
    _log_frames(rr, stream, refinement, recording, depth)
    _log_lesions(rr, stream, lesions or ())
    content = memory.drain_as_bytes()
    with atomic_write(path) as file:
        file.write(content)


def _rerun() -> Any:
    try:
        import rerun
    except ImportError:
        raise OutputError("view: the viewer's library is not installed; pip install 'capsule-vio[view]'") from None
    return rerun


def _some(count: int, most: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def _log_tracks(rr: Any, stream: Any, refinement: Refinement) -> None:
    """The whole ways, whatever the time."""
    tracks = [("refined", refinement.trajectory, REFINED), ("motions_alone", refinement.motions_only, MOTIONS)]
    if refinement.truth is not None:
        tracks.append(("truth", refinement.truth, TRUTH))
    for name, track, colour in tracks:
        points = track.positions_m[_some(len(track), MOST_POSES)]
        stream.log(f"world/{name}", rr.LineStrips3D([points], colors=[colour], radii=[2e-4]), static=True)


def _log_poses(rr: Any, stream: Any, refinement: Refinement) -> None:
    """The body, and where it is with 95 %."""
    trajectory = refinement.trajectory
    if refinement.view is not None:
        stream.log("world/body/camera", _transform(rr, refinement.view.T_body_camera), static=True)
    for k in _some(len(trajectory), MOST_POSES).tolist():
        stream.set_time("time", duration=float(trajectory.t_s[k]))
        stream.log("world/body", _transform(rr, trajectory.T_world_body[k]))
        if trajectory.cov is not None:
            R = trajectory.rotations[k]
            centre, half, quat_xyzw = ellipsoid(trajectory.positions_m[k], R @ trajectory.cov[k, 3:, 3:] @ R.T)
            stream.log("world/position_95", rr.Ellipsoids3D(
                centers=[centre], half_sizes=[half], quaternions=[rr.Quaternion(xyzw=quat_xyzw)], colors=[REFINED]))


def _transform(rr: Any, T: Array) -> Any:
    return rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3])


def ellipsoid(centre_m: Array, cov_m2: Array) -> tuple[Array, Array, Array]:
    """Centre (3,), half axes (3,) [m] and attitude (4,) `quat_xyzw` of the ellipsoid that holds 95 %."""
    variances, axes = np.linalg.eigh(cov_m2)
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    return centre_m, RADIUS_SD * np.sqrt(np.maximum(variances, 0.0)), se3.quat_xyzw_from_matrix(axes)


def _log_frames(rr: Any, stream: Any, refinement: Refinement, recording: Recording | None,
                depth: DepthFolder | None) -> None:
    """Small pictures, and the wall that their depth shows."""
    trajectory, view = refinement.trajectory, refinement.view
    for k in _some(len(trajectory), MOST_PICTURES).tolist():
        t_s = float(trajectory.t_s[k])
        stream.set_time("time", duration=t_s)
        frame = k + (0 if view is None else view.first_frame)
        if recording is not None and recording.has_images:
            picture = thumbnail(recording, frame, PICTURE_PX)
            stream.log("picture", rr.EncodedImage(contents=picture, media_type="image/jpeg"))
        if view is None or view.camera is None:
            continue
        depth_m = depth.depth_m(t_s) if depth is not None else None
        if depth_m is not None and depth is not None and depth.predicted:
            depth_m = depth_m * np.exp(refinement.log_scale[k] - view.prior_log_scale)
        elif depth is None and recording is not None and recording.has_depth:
            depth_m = recording.depth_m(frame)
        if depth_m is not None:
            T = trajectory.T_world_body[k] @ view.T_body_camera
            stream.log("world/wall", rr.Points3D(cloud(np.asarray(depth_m, float), view.camera, T), radii=[2e-4]))


def cloud(depth_m: Array, camera: Camera, T_world_camera: Array) -> Array:
    """Points (P, 3) in the world of at most `MOST_POINTS` known pixels of a z-depth map (H, W)."""
    rows, columns = np.nonzero(depth_m > 0)
    keep = _some(len(rows), MOST_POINTS) if len(rows) else np.zeros(0, np.int64)
    rows, columns = rows[keep], columns[keep]
    rays = camera.unproject(np.column_stack([columns, rows]).astype(float))
    good = np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0.05)
    points = rays[good] / rays[good][:, 2:] * depth_m[rows[good], columns[good]][:, None]
    return np.asarray(points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3])


def _log_lesions(rr: Any, stream: Any, rows: Sequence[Mapping[str, Any]]) -> None:
    """Each from the time it was seen on, with its ellipsoid."""
    for number, row in enumerate(rows, 1):
        stream.set_time("time", duration=float(row["timestamp_s"]))
        colour = LANDMARK if row["kind"] == "landmark" else LESION
        centre = 1e-3 * np.array([row["x_mm"], row["y_mm"], row["z_mm"]], float)
        stream.log(f"world/lesions/{number}", rr.Points3D([centre], colors=[colour], radii=[1e-3],
                                                          labels=[f"{number} {row['label']}"]))
        if "cov_mm2" in row:
            _, half, quat_xyzw = ellipsoid(centre, 1e-6 * np.array(row["cov_mm2"], float))
            stream.log(f"world/lesions/{number}/ellipsoid_95", rr.Ellipsoids3D(
                centers=[centre], half_sizes=[half], quaternions=[rr.Quaternion(xyzw=quat_xyzw)], colors=[colour]))
