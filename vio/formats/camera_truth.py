"""Truth from poses of the camera: checked, and turned into poses of the body."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vio import se3
from vio.calibration import Calibration
from vio.errors import FormatError, GeometryError
from vio.trajectory import Trajectory

Array = NDArray[np.float64]


def rigid(T: ArrayLike, where: Callable[[int], str]) -> Array:
    """Return poses (N, 4, 4) with clean rotations.

    Raises:
        FormatError: one of them is no rigid transform; `where(k)` says where pose k was read.
    """
    T = np.asarray(T, float)
    try:
        return se3.check_transforms(T, "pose")
    except GeometryError:
        for k, one in enumerate(T):
            try:
                se3.check_transforms(one[None], "pose")
            except GeometryError as error:
                raise FormatError(f"{where(k)}: {str(error).partition(': ')[2]}") from None
        raise


def body_truth(
    T_world_camera: Array, t_ns: NDArray[np.int64], first_ns: int, calibration: Calibration
) -> Trajectory:
    """Poses of the body, whose times count from the first frame, from poses (N, 4, 4) of the camera in metres."""
    T_world_body = T_world_camera @ se3.inverse(calibration.T_body_camera)
    return Trajectory(np.asarray((t_ns - first_ns) * 1e-9), T_world_body)
