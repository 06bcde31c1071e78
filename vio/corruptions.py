"""The twelve image corruptions of the paper's robustness study, each in five severities.

Kinds and parameters are those of ImageNet-C (Hendrycks and Dietterich, "Benchmarking Neural Network Robustness
to Common Corruptions and Perturbations", ICLR 2019), written anew from the formulas. Lengths are pixels, except
for the elastic transform, whose lengths are fractions of the shorter image side, so that it looks the same at any
size. Not every kind grows with its severity, for the tables do not: `saturate` first bleaches, `spatter` changes from
water to mud, and the published `elastic_transform` is strongest at severity 2.

Where this differs from the published code: glass blur exchanges pixels symmetrically (the published range is
half open, and its exchange copies instead), and values are rounded to 8 bits, not cut off.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.fft import dctn, idctn
from scipy.ndimage import gaussian_filter, map_coordinates

from vio.errors import CorruptionError

Image = NDArray[np.uint8]
Array = NDArray[np.float64]
Kind = Literal["impulse_noise", "speckle_noise", "shot_noise", "gaussian_noise", "glass_blur", "gaussian_blur",
               "defocus_blur", "saturate", "brightness", "contrast", "spatter", "elastic_transform"]
Elastic = Literal["hendrycks", "imagecorruptions"]

CORRUPTIONS: tuple[Kind, ...] = get_args(Kind)
"""All kinds, in the order of the paper's list of types: noise, blur, colour, occlusion and deformation."""
SEVERITIES = (1, 2, 3, 4, 5)

PARAMETERS: dict[Kind, tuple[Any, ...]] = {
    "impulse_noise": (0.03, 0.06, 0.09, 0.17, 0.27),  # share of values replaced
    "speckle_noise": (0.15, 0.2, 0.35, 0.45, 0.6),  # standard deviation relative to the value
    "shot_noise": (60, 25, 12, 5, 3),  # photons at full white
    "gaussian_noise": (0.08, 0.12, 0.18, 0.26, 0.38),  # standard deviation, white = 1
    "glass_blur": ((0.7, 1, 2), (0.9, 2, 1), (1.0, 2, 3), (1.1, 3, 2), (1.5, 4, 2)),  # sigma, farthest swap, passes
    "gaussian_blur": (1, 2, 3, 4, 6),  # sigma
    "defocus_blur": ((3, 0.1), (4, 0.5), (6, 0.5), (8, 0.5), (10, 0.5)),  # radius of the disk, sigma of its rim
    "saturate": ((0.3, 0), (0.1, 0), (2, 0), (5, 0.1), (20, 0.2)),  # factor and offset of the saturation
    "brightness": (0.1, 0.2, 0.3, 0.4, 0.5),  # added to the value
    "contrast": (0.4, 0.3, 0.2, 0.1, 0.05),  # factor about the mean
    "spatter": ((0.65, 0.3, 4, 0.69, 0.6, "water"), (0.65, 0.3, 3, 0.68, 0.6, "water"),  # mean, deviation, sigma,
                (0.65, 0.3, 2, 0.68, 0.5, "water"), (0.65, 0.3, 1, 0.65, 1.5, "mud"),  # threshold, opacity (mud:
                (0.67, 0.4, 1, 0.65, 1.5, "mud")),  # sigma of the rim), what it is
    "elastic_transform": ((2, 0.7, 0.1), (2, 0.08, 0.2), (0.05, 0.01, 0.02),  # amplitude, sigma, shift of the corners,
                          (0.07, 0.01, 0.02), (0.12, 0.01, 0.02)),  # of the shorter side
}
ELASTIC_MONOTONE = (0.05, 0.065, 0.085, 0.1, 0.12)  # of the shorter side; "imagecorruptions", without the affine part
ELASTIC_MONOTONE_SIGMA = 0.01

WATER_RGB = np.array([175, 238, 238]) / 255
MUD_RGB = np.array([63, 42, 20]) / 255
EMBOSS = np.array([[-2, -1, 0], [-1, 1, 1], [0, 1, 2]], np.float32)  # light from the upper left on a drop's rim
DROP_RIM_PX = 20.0  # distance from its edge at which a drop is flat
MUD_FLOOR = 0.8  # mud thinner than this is washed away


def corrupt(image: Image, kind: Kind, severity: int, rng: np.random.Generator,
            elastic: Elastic = "hendrycks") -> Image:
    """Corrupt one image.

    Args:
        image: (H, W, 3) uint8, R, G, B; not changed.
        kind: one of `CORRUPTIONS`.
        severity: 1 (mild) to 5.
        rng: where randomness comes from; the same state gives the same bytes.
        elastic: table of the elastic transform: the published one, or the one of the later package
            `imagecorruptions`, which grows with severity and has no affine part.

    Returns:
        (H, W, 3) uint8.

    Raises:
        CorruptionError: no such kind, severity or table, or not an RGB image of 8 bits.
    """
    if kind not in CORRUPTIONS:
        raise CorruptionError(f"corruption {kind!r} is unknown; use one of {', '.join(CORRUPTIONS)}")
    if severity not in SEVERITIES:
        raise CorruptionError(f"corruption {kind}: severity is {severity!r}, must be a whole number from 1 to 5")
    if elastic not in get_args(Elastic):
        raise CorruptionError(f"corruption: elastic {elastic!r} is unknown; use one of {', '.join(get_args(Elastic))}")
    image = np.asarray(image)
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise CorruptionError(f"corruption {kind}: the image is {image.dtype} {image.shape}, must be uint8 (H, W, 3) "
                              "in R, G, B; repeat a grey image three times")
    parameters = PARAMETERS[kind][severity - 1]
    if kind == "elastic_transform" and elastic == "imagecorruptions":
        parameters = (ELASTIC_MONOTONE[severity - 1], ELASTIC_MONOTONE_SIGMA, 0.0)
    light = _FUNCTIONS[kind](image / 255.0, parameters, rng)
    return np.rint(np.clip(light, 0, 1) * 255).astype(np.uint8)


def _impulse_noise(image: Array, share: float, rng: np.random.Generator) -> Array:
    hit = rng.random(image.shape) < share
    return np.where(hit, rng.random(image.shape) < 0.5, image)


def _speckle_noise(image: Array, sigma: float, rng: np.random.Generator) -> Array:
    return image * (1 + rng.normal(0, sigma, image.shape))


def _shot_noise(image: Array, photons: float, rng: np.random.Generator) -> Array:
    return rng.poisson(image * photons) / photons


def _gaussian_noise(image: Array, sigma: float, rng: np.random.Generator) -> Array:
    return image + rng.normal(0, sigma, image.shape)


def _gaussian_blur(image: Array, sigma: float, rng: np.random.Generator) -> Array:
    return np.asarray(gaussian_filter(image, (sigma, sigma, 0), mode="nearest"))


def _glass_blur(image: Array, parameters: tuple[float, int, int], rng: np.random.Generator) -> Array:
    """Blur, let every pixel change places with a neighbour, one after the other from the lower right, blur again."""
    sigma, reach, passes = parameters
    height, width = image.shape[:2]
    inner = np.arange(height * width).reshape(height, width)[reach:height - reach, reach:width - reach]
    here = inner[::-1, ::-1].ravel()
    source = list(range(height * width))
    for _ in range(passes):
        rows, columns = rng.integers(-reach, reach, (2, len(here)), endpoint=True)
        for a, b in zip(here.tolist(), (here + rows * width + columns).tolist(), strict=True):
            source[a], source[b] = source[b], source[a]
    soft = _gaussian_blur(image, sigma, rng).reshape(-1, 3)
    return _gaussian_blur(soft[source].reshape(image.shape), sigma, rng)


def _defocus_blur(image: Array, parameters: tuple[int, float], rng: np.random.Generator) -> Array:
    radius, rim = parameters
    steps = np.arange(-radius - 2, radius + 3)
    disk = (steps[:, None] ** 2 + steps**2 <= radius**2).astype(float)
    disk = cv2.GaussianBlur(disk / disk.sum(), (3, 3) if radius <= 8 else (5, 5), rim)
    return np.asarray(cv2.filter2D(image, -1, disk))


def _saturate(image: Array, parameters: tuple[float, float], rng: np.random.Generator) -> Array:
    factor, offset = parameters
    hsv = cv2.cvtColor(image.astype(np.float32), cv2.COLOR_RGB2HSV)
    hsv[..., 1] = np.clip(hsv[..., 1] * factor + offset, 0, 1)
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB), float)


def _brightness(image: Array, shift: float, rng: np.random.Generator) -> Array:
    hsv = cv2.cvtColor(image.astype(np.float32), cv2.COLOR_RGB2HSV)
    hsv[..., 2] = np.clip(hsv[..., 2] + shift, 0, 1)
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB), float)


def _contrast(image: Array, factor: float, rng: np.random.Generator) -> Array:
    mean = image.mean(axis=(0, 1))
    return np.asarray((image - mean) * factor + mean)


def _spatter(image: Array, parameters: tuple[float, float, float, float, float, str],
             rng: np.random.Generator) -> Array:
    """Drops where smoothed noise exceeds a threshold: water brightens towards its lit rim, mud covers."""
    mean, deviation, sigma, threshold, mix, what = parameters
    noise = gaussian_filter(rng.normal(mean, deviation, image.shape[:2]), sigma, mode="nearest")
    liquid = np.where(noise < threshold, 0.0, noise)
    if what == "mud":
        cover = gaussian_filter((liquid > threshold).astype(float), mix, mode="nearest")
        cover = np.where(cover < MUD_FLOOR, 0.0, cover)[..., None]
        return np.asarray(image * (1 - cover) + MUD_RGB * cover)
    shine = liquid * _drop_relief(liquid)
    peak = shine.max()
    return image if peak == 0 else np.asarray(image + (mix * shine / peak)[..., None] * WATER_RGB)


def _drop_relief(liquid: Array) -> Array:
    """How much light each place of the drops (H, W) throws back: an embossed map of the distance to their edges."""
    edges = cv2.Canny(np.clip(liquid * 255, 0, 255).astype(np.uint8), 50, 150)
    distance = np.minimum(cv2.distanceTransform(255 - edges, cv2.DIST_L2, 5), DROP_RIM_PX)
    level = cv2.equalizeHist(cv2.blur(distance, (3, 3)).astype(np.uint8))
    return np.asarray(cv2.blur(cv2.filter2D(level, cv2.CV_8U, EMBOSS), (3, 3)), float)


def _elastic_transform(image: Array, parameters: tuple[float, float, float], rng: np.random.Generator) -> Array:
    height, width = image.shape[:2]
    amplitude, sigma, corner = (value * min(height, width) for value in parameters)
    if corner:
        third = min(height, width) // 3
        centre = np.array([width, height]) // 2
        corners = (centre + third * np.array([[1, 1], [1, -1], [-1, -1]])).astype(np.float32)
        moved = (corners + rng.uniform(-corner, corner, (3, 2))).astype(np.float32)
        image = cv2.warpAffine(image, cv2.getAffineTransform(corners, moved), (width, height),
                               borderMode=cv2.BORDER_REFLECT_101)
    rows, columns = (np.arange(n) for n in (height, width))
    down, right = amplitude * _smooth(rng.uniform(-1, 1, (2, height, width)), sigma)
    at = [rows[:, None] + down, columns[None, :] + right]
    return np.stack([map_coordinates(image[..., c], at, order=1, mode="reflect") for c in range(3)], axis=-1)


def _smooth(fields: Array, sigma: float) -> Array:
    """Gaussian smoothing of fields (..., H, W) mirrored at their edges, for any sigma: a product in cosine space."""
    gains = [np.exp(-0.5 * (sigma * np.pi * np.arange(n) / n) ** 2) for n in fields.shape[-2:]]
    spectrum = dctn(fields, axes=(-2, -1)) * (gains[0][:, None] * gains[1])
    return np.asarray(idctn(spectrum, axes=(-2, -1)))


_FUNCTIONS: dict[Kind, Callable[[Array, Any, np.random.Generator], Array]] = {
    "impulse_noise": _impulse_noise, "speckle_noise": _speckle_noise, "shot_noise": _shot_noise,
    "gaussian_noise": _gaussian_noise, "glass_blur": _glass_blur, "gaussian_blur": _gaussian_blur,
    "defocus_blur": _defocus_blur, "saturate": _saturate, "brightness": _brightness, "contrast": _contrast,
    "spatter": _spatter, "elastic_transform": _elastic_transform,
}
