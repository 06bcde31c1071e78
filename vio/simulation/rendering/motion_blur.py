"""Motion blur from the camera's true motion during the exposure.

The image is averaged along each pixel's path through several poses within the exposure, as many as the fastest pixel
needs: a knock of 45 Hz bends these paths within one exposure.
"""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from vio.simulation.rendering.lens import Lens, project_point

Array = NDArray[np.float64]
Field = NDArray[np.float32]

_STRIDE = 8  # pixel paths are computed on a coarser grid
_PIXELS_PER_POSE = 2.0
_INVISIBLE_PIXELS = 0.25
_FAR_M = 0.15  # where no wall is seen
MOST_POSES = 15


def blur(image: Field, distance_m: Field, lens: Lens, T_mid_sub: Array) -> Field:
    """Average of an image over sub-poses.

    Args:
        image: (H, W, 3) linear, sharp, at mid exposure.
        distance_m: (H, W) along the rays; 0 where nothing is seen.
        lens: of the camera.
        T_mid_sub: (n, 4, 4) camera at equally spaced instants of the exposure, in the camera at mid exposure.
    """
    rows, columns = np.arange(0, lens.camera.height, _STRIDE), np.arange(0, lens.camera.width, _STRIDE)
    depth = distance_m[np.ix_(rows, columns)]
    points = np.where(depth > 0, depth, _FAR_M)[..., None] * lens.rays[np.ix_(rows, columns)]
    flows = np.zeros((len(T_mid_sub), *depth.shape, 2), np.float32)
    _flows(points, lens.sees[np.ix_(rows, columns)], rows, columns, lens.numbers, T_mid_sub, flows)
    np.clip(flows, -0.25 * lens.camera.width, 0.25 * lens.camera.width, out=flows)
    longest = float(np.abs(flows).max())
    if longest < _INVISIBLE_PIXELS:
        return image
    poses = int(np.clip(np.ceil(2 * longest / _PIXELS_PER_POSE), 3, len(flows)))
    chosen = np.unique(np.round(np.linspace(0, len(flows) - 1, poses)).astype(int))
    height, width = image.shape[:2]
    grid_x, grid_y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    total = np.zeros_like(image)
    for k in chosen:
        flow = _upsample(flows[k], width, height)
        total += cv2.remap(image, grid_x - flow[..., 0], grid_y - flow[..., 1], cv2.INTER_LINEAR,
                           borderMode=cv2.BORDER_REPLICATE)
    out: Field = total / np.float32(len(chosen))
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _flows(points: Array, seen: NDArray[np.bool_], rows: NDArray[np.intp], columns: NDArray[np.intp], lens: Array,
           T_mid_sub: Array, flows: Field) -> None:
    """Where each pixel's point is seen from every sub-pose, minus where it is: (n, h, w, 2) pixels, filled in."""
    for k in range(len(T_mid_sub)):
        for i in range(len(rows)):
            for j in range(len(columns)):
                if not seen[i, j]:
                    continue
                moved = np.zeros(3)
                for c in range(3):
                    for w in range(3):
                        moved[c] += (points[i, j, w] - T_mid_sub[k, w, 3]) * T_mid_sub[k, w, c]
                u, v, ok = project_point(moved[0], moved[1], moved[2], lens)
                if ok:
                    flows[k, i, j, 0], flows[k, i, j, 1] = u - columns[j], v - rows[i]


def _upsample(flow: Field, width: int, height: int) -> Field:
    """Values at every `_STRIDE`-th pixel to every pixel, bilinear."""
    x = np.arange(width, dtype=np.float32) / _STRIDE
    y = np.arange(height, dtype=np.float32) / _STRIDE
    grid = np.meshgrid(np.minimum(x, flow.shape[1] - 1), np.minimum(y, flow.shape[0] - 1))
    out: Field = cv2.remap(flow, grid[0], grid[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return out
