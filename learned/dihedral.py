"""The eight mirror images and quarter turns of a camera's view, for images, geometry and inertial samples alike.

With Q the orthogonal matrix of the change of camera axes: points and translations Q p, rotations Q R Qᵀ, specific
forces Q f. An angular rate is a pseudovector: det(Q) Q ω, so that a mirrored capsule turns the mirrored way.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from vio.camera import Camera

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Symmetry:
    """One of the eight: first mirror left-right, then top-bottom, then exchange rows and columns."""

    mirror_x: bool = False
    mirror_y: bool = False
    exchange: bool = False

    @property
    def Q(self) -> Array:
        """(3, 3) new camera axes from old ones."""
        Q = np.diag([-1.0 if self.mirror_x else 1.0, -1.0 if self.mirror_y else 1.0, 1.0])
        return Q[[1, 0, 2]] if self.exchange else Q

    @property
    def Q4(self) -> Array:
        """(4, 4) the same for transforms: `Q4 @ T @ Q4.T`."""
        Q4 = np.eye(4)
        Q4[:3, :3] = self.Q
        return Q4

    def image(self, image: Tensor) -> Tensor:
        """Images, masks or depth maps (..., H, W) as the new camera sees them."""
        axes = [axis for axis, mirrored in ((-1, self.mirror_x), (-2, self.mirror_y)) if mirrored]
        image = image.flip(axes) if axes else image
        return image.transpose(-1, -2) if self.exchange else image

    def camera(self, camera: Camera) -> Camera:
        """The camera of the changed images."""
        k = list(camera.distortion)
        if self.mirror_x:
            camera = replace(camera, cx=camera.width - 1 - camera.cx)
        if self.mirror_y:
            camera = replace(camera, cy=camera.height - 1 - camera.cy)
        if camera.model == "pinhole":  # p1 moves points along y, p2 along x
            k[2], k[3] = -k[2] if self.mirror_y else k[2], -k[3] if self.mirror_x else k[3]
            k[2:4] = k[3:1:-1] if self.exchange else k[2:4]
        if self.exchange:
            camera = replace(camera, width=camera.height, height=camera.width, fx=camera.fy, fy=camera.fx,
                             cx=camera.cy, cy=camera.cx)
        return replace(camera, distortion=tuple(k))

    def rotation(self, R: Array) -> Array:
        """Rotations (..., 3, 3) between camera axes."""
        return np.asarray(self.Q @ R @ self.Q.T)

    def transform(self, T: Array) -> Array:
        """Transforms (..., 4, 4) between camera axes."""
        return np.asarray(self.Q4 @ T @ self.Q4.T)

    def imu(self, windows: Array, R_body_camera: Array) -> Array:
        """Samples (..., 6), gyro [rad/s] then specific force [m/s²], in body axes changed along with the camera's.

        The new body sits in the new camera as before (`R_body_camera` stays), so its axes change by
        `R_body_camera Q R_body_cameraᵀ`.
        """
        change = R_body_camera @ self.Q @ R_body_camera.T
        handed = np.linalg.det(self.Q)
        return np.concatenate([handed * windows[..., :3] @ change.T, windows[..., 3:] @ change.T], axis=-1)


SYMMETRIES = tuple(Symmetry(*choice) for choice in product((False, True), repeat=3))
"""All eight; the first changes nothing."""
UPRIGHT = tuple(symmetry for symmetry in SYMMETRIES if not symmetry.exchange)
"""The four that keep width and height."""
