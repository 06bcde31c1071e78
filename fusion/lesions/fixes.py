"""From a frame, a pixel and a depth to a point in the world with its covariance.

With the body's pose T = (R, p), the camera in the body (R_bc, t_bc), the ray r of the pixel scaled to r_z = 1 and the
z-depth d = exp(s) d_units, the point is

    x = R x_b + p,   x_b = R_bc r d + t_bc.

To first order, for a right perturbation (ω, ρ) of the pose, δs of the log scale, δl of the log depth, δu of
the pixel:

    δx = R (ρ - [x_b]× ω) + R R_bc r d (δs + δm + δl) + d R R_bc (∂r/∂u) δu.

Pose and scale are correlated, for a scale error also moves the pose: their joint covariance enters, not their sum.
δm is what a predicted map is off as a whole once s is right: neighbouring images share it (`merging.py`), while δl is
the pixel's own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.joint import JointSamples
from fusion.lesions.sightings import Sighting
from fusion.result import Refinement, View
from vio import se3
from vio.camera import Camera
from vio.depth_folder import DepthFolder
from vio.errors import LesionError
from vio.recording import Recording

Array = NDArray[np.float64]

PIXEL_SD = 5.0
"""How well a marked pixel, or the centre of a box, meets the lesion's centre."""
PATCH = 2
"""Depth is the median of the known values within so many pixels."""
VIEW_SD_M = 20e-3
"""How far from the camera a lesion of unknown depth may be, for deciding whether two sightings are one lesion."""
RELATIVE_SD = 0.10
"""Standard deviation of a depth as a share of it, where nobody says otherwise."""
NO_DEPTH = "no depth was given: position and arc length are those of the camera, the lesion lies in its view"


@dataclass(frozen=True)
class Fix:
    """One sighting, placed."""

    sighting: Sighting
    index: int
    """Frame, counted in the trajectory."""
    point_m: Array
    """(3,) in the world."""
    pose_cov: Array
    """(3, 3) from pose and scale, which other sightings share in part."""
    own_cov: Array
    """(3, 3) from depth and pixel, of this sighting alone."""
    image_m: Array
    """(3,) error that one standard deviation of its depth map's own scale makes; zero where that is exact."""
    common_m: Array
    """(S, 3) sampled errors from pose and scale."""
    with_depth: bool
    note: str
    """Why the point is only the camera's; empty otherwise."""


@dataclass(frozen=True)
class DepthSource:
    """Where depth comes from, at most one of the two."""

    folder: DepthFolder | None
    recording: Recording | None
    relative_sd: float | None
    """Sd of a depth as a share of it; None = what the folder's sd maps say, `RELATIVE_SD` where there are none."""

    @property
    def predicted(self) -> bool:
        """Whether depth is metric at the prior scale only, and follows the refined scale."""
        return self.folder is not None and self.folder.predicted

    @property
    def image_log_sd(self) -> float:
        """Sd of the ln scale of a whole map beyond the motions' scale; zero where the user gave one sd for all."""
        known = None if self.folder is None or self.relative_sd is not None else self.folder.image_log_sd
        return known or 0.0

    def map_of(self, frame: int, t_s: float) -> NDArray[np.float32] | None:
        """Depth map of a frame of the recording, or None."""
        if self.folder is not None:
            return self.folder.depth_m(t_s)
        return None if self.recording is None else self.recording.depth_m(frame)

    def relative_sd_at(self, t_s: float, pixel: Array) -> float:
        """Sd of the depth around a pixel (column, row), as a share of it."""
        if self.relative_sd is not None:
            return self.relative_sd
        values = None if self.folder is None else self.folder.log_sd(t_s)
        patch = np.zeros(0) if values is None else _patch(values, pixel)
        return float(np.median(patch[patch > 0])) if (patch > 0).any() else RELATIVE_SD


def place_sighting(refinement: Refinement, sighting: Sighting, index: int, view: View | None,
                   depth: DepthSource) -> Fix:
    """Place one sighting of trajectory frame `index`, by depth where there is one, else at the camera.

    Raises:
        LesionError: the pixel lies outside the image.
        VioError: a depth map is unusable.
    """
    pixel = _pixel(sighting, None if view is None else view.camera)
    depth_m, note = _depth(refinement, sighting, index, view, depth, pixel)
    if depth_m is None or view is None or view.camera is None or pixel is None:
        offset = np.zeros(3) if view is None else view.T_body_camera[:3, 3]
        nothing = np.zeros(3)
        return _fix(refinement, sighting, index, offset, nothing, np.eye(3) * VIEW_SD_M**2, nothing, note)
    ray, slope = _ray(view.camera, pixel)
    R_bc, t_bc = view.T_body_camera[:3, :3], view.T_body_camera[:3, 3]
    R = refinement.trajectory.rotations[index]
    along = depth_m * (R_bc @ ray)
    aside = depth_m * (R_bc @ slope)
    relative_sd = depth.relative_sd_at(float(refinement.trajectory.t_s[index]), pixel)
    own = R @ (relative_sd**2 * np.outer(along, along) + PIXEL_SD**2 * aside @ aside.T) @ R.T
    scaled = along if depth.predicted else np.zeros(3)
    return _fix(refinement, sighting, index, along + t_bc, scaled, own, depth.image_log_sd * (R @ along), "")


def _fix(refinement: Refinement, sighting: Sighting, index: int, x_body: Array, scaled: Array, own: Array,
         image: Array, note: str) -> Fix:
    T = refinement.trajectory.T_world_body[index]
    R = T[:3, :3]
    J = np.hstack([-R @ se3.skew(x_body), R, (R @ scaled)[:, None]])
    pose_cov = J @ pose_and_scale_covariance(refinement, index) @ J.T
    common = _common(refinement.joint, refinement.trajectory.rotations, index, R @ x_body, R @ scaled)
    return Fix(sighting, index, R @ x_body + T[:3, 3], 0.5 * (pose_cov + pose_cov.T), own, image, common, not note,
               note)


def pose_and_scale_covariance(refinement: Refinement, index: int) -> Array:
    """(7, 7) of a pose's right perturbation, rotation first, and of the log scale.

    The exact marginals on the diagonal; between them the samples' correlation, carried over so that the whole stays
    positive semidefinite; zero where there are no samples.
    """
    cov = np.zeros((7, 7))
    if refinement.trajectory.cov is None:
        raise LesionError("locate: the trajectory carries no covariances; give a run folder or a refinement")
    cov[:6, :6] = refinement.trajectory.cov[index]
    cov[6, 6] = float(refinement.log_scale_sd[index]) ** 2
    joint = refinement.joint
    if joint is None or index == 0 or cov[6, 6] == 0:
        return cov
    nearest = int(np.argmin(np.abs(joint.node - index)))
    draws = np.column_stack([joint.xi[:, nearest], joint.log_scale[:, nearest]])
    draws = draws / np.maximum(draws.std(axis=0), 1e-300)
    sampled = draws.T @ draws / len(draws)
    sd = np.sqrt(np.diag(cov)[:6])
    exact = np.linalg.cholesky(cov[:6, :6] / np.outer(sd, sd))
    carried = exact @ np.linalg.solve(np.linalg.cholesky(sampled[:6, :6] + 1e-9 * np.eye(6)), sampled[:6, 6])
    length = float(np.linalg.norm(np.linalg.solve(exact, carried)))
    cov[:6, 6] = cov[6, :6] = sd * carried * np.sqrt(cov[6, 6]) * min(1.0, 1.0 / max(length, 1e-12))
    return cov


def _common(joint: JointSamples | None, R_world_body: Array, index: int, lever: Array, scaled: Array) -> Array:
    """(S, 3) sampled errors of a point at `lever` from the body, in world axes."""
    if joint is None:
        return np.zeros((0, 3))
    at = np.array([index])
    turn, shift = joint.rotation_errors(R_world_body, at)[:, 0], joint.position_errors(R_world_body, at)[:, 0]
    return np.asarray(shift + np.cross(turn, lever) + joint.scale_errors(at) * scaled)


def _pixel(sighting: Sighting, camera: Camera | None) -> Array | None:
    if camera is None:
        return None
    if sighting.pixel is None:
        return np.array([(camera.width - 1) / 2, (camera.height - 1) / 2])
    pixel = np.array(sighting.pixel)
    if not camera.contains(pixel):
        raise LesionError(f"{sighting.where}: pixel {pixel[0]:g}, {pixel[1]:g} lies outside the image of "
                          f"{camera.width} x {camera.height}; give u, v in the recording's own resolution")
    return pixel


def _depth(refinement: Refinement, sighting: Sighting, index: int, view: View | None, depth: DepthSource,
           pixel: Array | None) -> tuple[float | None, str]:
    """z-depth [m] at the pixel, metric at the refined scale; or None and why."""
    if depth.folder is None and (depth.recording is None or not depth.recording.has_depth):
        return None, NO_DEPTH
    if view is None or view.camera is None or pixel is None:
        return None, "the camera's calibration is unknown: position and arc length are those of the camera"
    values = depth.map_of(view.first_frame + index, float(refinement.trajectory.t_s[index]))
    if values is None:
        return None, "this frame has no depth map: position and arc length are those of the camera"
    camera = view.camera
    if values.shape != (camera.height, camera.width):
        raise LesionError(f"{sighting.where}: its depth map has {values.shape[1]} x {values.shape[0]} pixels but the "
                          f"camera {camera.width} x {camera.height}; give maps in the camera's resolution")
    patch = _patch(values, pixel)
    if not all(np.isfinite(part).all() for part in _ray(camera, pixel)):
        return None, "no ray of the calibrated camera meets this pixel: position and arc length are those of the camera"
    if not (patch > 0).any():
        return None, "depth is unknown at this pixel: position and arc length are those of the camera"
    known = float(np.median(patch[patch > 0]))
    if depth.predicted:
        known *= float(np.exp(refinement.log_scale[index] - view.prior_log_scale))
    return known, ""


def _patch(values: NDArray[np.float32], pixel: Array) -> NDArray[np.float32]:
    """Values (H, W) around a pixel."""
    column, row = (int(np.clip(round(float(p)), 0, size - 1)) for p, size in
                   zip(pixel, values.shape[::-1], strict=True))
    return values[max(row - PATCH, 0):row + PATCH + 1, max(column - PATCH, 0):column + PATCH + 1]


def _ray(camera: Camera, pixel: Array) -> tuple[Array, Array]:
    """The ray (3,) of a pixel, scaled to z = 1, and its derivative (3, 2) by the pixel."""
    around = camera.unproject(pixel + np.array([[0.0, 0.0], [0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]]))
    around = around / around[:, 2:]
    return around[0], np.column_stack([around[1] - around[2], around[3] - around[4]])
