"""From radiance to pixels: exposure, vignette, glare, shot and read noise, tone curve."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vio.camera import Camera

Field = NDArray[np.float32]

_TARGET = 0.20  # mean of the exposed image that auto-exposure aims at
_BRIGHTEST = 97  # percentile at which highlights stop counting
_SHOT, _READ = np.float32(2.5e-4), np.float32(1e-5)
_SHOULDER = 0.7
_LINEAR_MAX = 4.0


@dataclass(frozen=True)
class SensorSwitches:
    """What of the sensor's behaviour is simulated."""

    auto_exposure: bool = True
    vignette: bool = True
    glare: bool = True
    noise: bool = True


class Sensor:
    """Turns linear radiance into 8-bit RGB.

    Args:
        camera: for the size of the image.
        switches: what to simulate.
        lit: (H, W) pixels that light reaches; the others stay black.
    """

    def __init__(self, camera: Camera, switches: SensorSwitches, lit: NDArray[np.bool_]) -> None:
        rows, columns = np.mgrid[0: camera.height, 0: camera.width]
        radius2 = ((columns - 0.5 * (camera.width - 1)) / (camera.width / 2)) ** 2
        radius2 = radius2 + ((rows - 0.5 * (camera.height - 1)) / (camera.height / 2)) ** 2
        self._vignette = np.maximum(1 - 0.17 * radius2, 0.2).astype(np.float32)[..., None]
        self._switches = switches
        soft = cv2.GaussianBlur(lit.astype(np.float32), (0, 0), 0.7) if not lit.all() else lit.astype(np.float32)
        self._lit = np.where(lit, np.clip(2 * soft - 1, 0, 1), 0).astype(np.float32)[..., None]
        self._curve = _tone_curve()

    def gain(self, radiance: Field) -> float:
        """Exposure that brings the middle of the image, without its brightest 3 %, to the target; 1 if all is dark."""
        height, width = radiance.shape[:2]
        top, left = height // 8, width // 8
        sample = radiance[top: height - top: 4, left: width - left: 4].mean(axis=-1)
        mean = float(np.mean(np.minimum(sample, np.percentile(sample, _BRIGHTEST))))
        return _TARGET / mean if mean > 0 else 1.0

    def expose(self, radiance: Field, gain: float, rng: np.random.Generator) -> NDArray[np.uint8]:
        """8-bit RGB (H, W, 3) of linear radiance (H, W, 3)."""
        exposed = radiance * np.float32(gain)
        if self._switches.vignette:
            exposed *= self._vignette
        if self._switches.glare:
            exposed += self._glare(exposed)
        if self._switches.noise:
            sd = np.sqrt(np.maximum(exposed, 0) * _SHOT + _READ)
            exposed += rng.standard_normal(exposed.shape, dtype=np.float32) * sd
        index = np.clip(exposed * np.float32(65535 / _LINEAR_MAX), 0, 65535).astype(np.uint16)
        out: NDArray[np.uint8] = (self._curve[index] * self._lit + np.float32(0.5)).astype(np.uint8)
        return out

    def _glare(self, exposed: Field) -> Field:
        """Light that the dome scatters: a halo of highlights and a veil of everything."""
        height, width = exposed.shape[:2]
        small_size = (max(width // 4, 1), max(height // 4, 1))
        small = cv2.resize(exposed, small_size, interpolation=cv2.INTER_AREA)
        bright = cv2.resize(np.maximum(exposed - np.float32(0.9), 0), small_size, interpolation=cv2.INTER_AREA)
        veil = np.float32(0.3) * cv2.GaussianBlur(bright, (0, 0), 0.9)
        veil += np.float32(0.05) * cv2.GaussianBlur(small, (0, 0), 3)
        out: Field = cv2.resize(veil, (width, height), interpolation=cv2.INTER_LINEAR)
        return out


def tone(exposed: Field) -> Field:
    """Linear exposed values as 0..255 floats: a soft shoulder above 0.7, then sRGB (IEC 61966-2-1)."""
    shoulder = _SHOULDER + (1 - _SHOULDER) * (1 - np.exp(-(exposed - _SHOULDER) / (1 - _SHOULDER)))
    soft = np.where(exposed < _SHOULDER, exposed, shoulder)
    encoded = np.where(soft < 0.0031308, 12.92 * soft, 1.055 * np.power(np.maximum(soft, 1e-9), 1 / 2.4) - 0.055)
    out: Field = (255 * encoded).astype(np.float32)
    return out


def _tone_curve() -> Field:
    return tone(np.linspace(0, _LINEAR_MAX, 65536, dtype=np.float32))
