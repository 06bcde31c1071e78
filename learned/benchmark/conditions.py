"""What test images are shown as: as they are, or corrupted in one of the paper's twelve ways."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from vio.corruptions import CORRUPTIONS, SEVERITIES, Kind, corrupt
from vio.recording import Recording


@dataclass(frozen=True)
class Condition:
    """One way to show the test images; the vibration is never touched."""

    kind: Kind | None = None
    """None = as they are."""
    severity: int = 0

    @property
    def name(self) -> str:
        """Such as `clean` or `glass_blur-3`."""
        return "clean" if self.kind is None else f"{self.kind}-{self.severity}"


CLEAN = Condition()
CORRUPTED = tuple(Condition(kind, severity) for kind in CORRUPTIONS for severity in SEVERITIES)
"""All 60."""


@dataclass(frozen=True, kw_only=True)
class CorruptedRecording(Recording):
    """A recording whose frames are corrupted as they are read; nothing is written.

    The same sequence, frame and condition always give the same bytes, whatever else was read before, so that all
    variants are judged on the same images.
    """

    kind: Kind
    severity: int

    def frame(self, k: int) -> NDArray[np.uint8]:
        """Image of frame k, corrupted at the size it is stored in."""
        image = super().frame(k)
        rgb = np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image
        seed = [zlib.crc32(self.name.encode()), zlib.crc32(self.kind.encode()), self.severity, k]
        return corrupt(rgb, self.kind, self.severity, np.random.default_rng(seed))


def shown(recording: Recording, condition: Condition) -> Recording:
    """The recording as a condition shows it."""
    if condition.kind is None:
        return recording
    content = {field.name: getattr(recording, field.name) for field in fields(Recording)}
    return CorruptedRecording(**content, kind=condition.kind, severity=condition.severity)
