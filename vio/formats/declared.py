"""What only the user can say about other people's data: a camera, a rate, a unit, depth planes.

Readers never guess these. Each names what it accepts; saying something that a format knows itself is refused, so that
nothing is silently ignored.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from vio.calibration import Calibration
from vio.camera import Camera
from vio.errors import RecordingError

OPTIONS = {
    "calibration": "--calibration",
    "rate_hz": "--rate-hz",
    "unit_m": "--unit-m",
    "depth_planes": "--depth-planes",
    "presentation_times": "--presentation-times",
}
"""How the command line calls each field."""

RATE_LIMITS_HZ = (1e-3, 1e4)


@dataclass(frozen=True)
class Declared:
    """What the user declares about a recording; None = not said.

    Raises:
        RecordingError: a number that is not positive and finite, or depth planes without 0 < near < far.
    """

    calibration: Calibration | None = None
    """Camera, where it sits in the body, IMU noise; replaces the format's own."""
    rate_hz: float | None = None
    """Frames per second, constant, for data that carry no times."""
    unit_m: float | None = None
    """Metres per unit of positions and depth planes (Unity units, reconstruction units)."""
    depth_planes: tuple[float, float] | None = None
    """Near and far plane of the renderer, in the unit of `unit_m`."""
    presentation_times: bool | None = None
    """True: the film's presentation times ARE the capture times."""

    def __post_init__(self) -> None:
        for name in ("rate_hz", "unit_m"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise RecordingError(f"{OPTIONS[name]} is {value}; give a positive number")
        if self.rate_hz is not None and not RATE_LIMITS_HZ[0] <= self.rate_hz <= RATE_LIMITS_HZ[1]:
            raise RecordingError(f"{OPTIONS['rate_hz']} is {self.rate_hz}; give {RATE_LIMITS_HZ[0]:g} to "
                                 f"{RATE_LIMITS_HZ[1]:g} frames per second")
        if self.depth_planes is not None:
            near, far = self.depth_planes
            if not 0 < near < far < np.inf:
                raise RecordingError(f"{OPTIONS['depth_planes']}: near {near:g}, far {far:g}; give 0 < near < far")
            if self.unit_m is None:
                raise RecordingError(f"{OPTIONS['depth_planes']}: planes {near:g} and {far:g} are in units of unknown "
                                     f"size; add {OPTIONS['unit_m']}")

    def check_accepted(self, format: str, accepts: frozenset[str]) -> None:
        """Raise if something was declared that the reader of `format` does not need.

        Raises:
            RecordingError: naming the option.
        """
        for entry in fields(self):
            if getattr(self, entry.name) is not None and entry.name not in accepts:
                raise RecordingError(f"format {format} does not take {OPTIONS[entry.name]}: it knows this itself or "
                                     "cannot use it; leave the option out")

    def calibration_or(self, camera: Camera | None) -> Calibration:
        """The declared calibration, else one of the format's own camera in a body that IS the camera."""
        return self.calibration or Calibration(camera)
