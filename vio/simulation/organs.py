"""What is known about each organ: its shape, its wall, how it contracts, and how a capsule moves in it.

Sources: colon length 189.5 ± 26.3 cm (Khashab 2009, 10.1055/s-0029-1214899), diameter 29 to 46 mm; small bowel 4 to
7 m long and 25 to 30 mm wide; contraction rates stomach 3 per minute, small bowel 7 to 12, colon slow waves 3 to 8
(PMC8553224, table 7); small-bowel waves travel 5 to 20 mm/s; mean speed of a capsule 0.16 to 0.6 mm/s in the small
bowel and 0.02 to 0.03 mm/s in the colon (length over transit time), most of the distance in short bursts
(biomedcentral 1471-230X/11/145). What has no source (folds, colours, wander) was chosen by eye against real frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

FoldKind = Literal["haustral", "circular", "rugae"]


@dataclass(frozen=True)
class Waves:
    """Peristaltic contractions that travel along an organ."""

    per_minute: float
    speed_m_s: float
    width_m: float
    amplitude: float
    """Share of the radius by which a contraction narrows the lumen."""


@dataclass(frozen=True)
class Look:
    """Colours and relief of the mucosa."""

    albedo: tuple[float, float, float]
    """Linear reflectance, R, G, B."""
    vessels_per_m2: float
    vessel_density: float
    """Optical density of a surface vessel in the green."""
    relief_mm: tuple[float, float]
    """Height of the finest relief and of the one of 1 to 4 mm."""
    villi: bool
    bile: float
    """Share of the wall under a film of bile."""
    foam: float
    """Patches of bubbles per metre of gut."""
    debris: float
    """Lumps of residue per metre of gut."""


@dataclass(frozen=True)
class Organ:
    """One organ with all the numbers that the simulator needs."""

    code: int
    """Part of every seed, so that organs differ with the same seed."""
    length_m: float
    semi_axes_m: tuple[float, float, float]
    """Ellipsoid that the centreline is steered back into."""
    bend_radius_m: float
    """Typical (RMS) radius of curvature of the centreline."""
    tightest_radius_m: float
    """Never bends more than this: about 1.7 times the lumen's radius, or cross-sections would meet."""
    bend_length_m: float
    """Arc length over which the curvature changes."""
    radius_m: float
    radius_variation: float
    folds: FoldKind
    view_m: float
    """How far the renderer looks along the lumen."""
    waves: Waves
    look: Look
    lesions_per_m: float
    lesion_kinds: tuple[str, ...]
    landmarks: tuple[str | None, str | None]
    """Names of the entrance and the exit, where the lumen closes."""
    speed_factor: float
    """Scale of the speeds of "natural" and "operated" driving."""
    transit_factor: float
    """Scale of the speeds of "transit" driving; 1 is a small bowel."""
    tumble_gap_s: float
    """Mean time between two tumbles."""


ORGANS = {
    "colon": Organ(
        code=1, length_m=1.90, semi_axes_m=(0.16, 0.09, 0.16), bend_radius_m=0.08, tightest_radius_m=0.042,
        bend_length_m=0.08, radius_m=19e-3, radius_variation=0.12, folds="haustral", view_m=0.17,
        waves=Waves(per_minute=3.0, speed_m_s=4e-3, width_m=18e-3, amplitude=0.10),
        look=Look(albedo=(0.66, 0.30, 0.21), vessels_per_m2=2400.0, vessel_density=0.95, relief_mm=(0.012, 0.06),
                  villi=False, bile=0.0, foam=10.0, debris=16.0),
        lesions_per_m=14.0, lesion_kinds=("polyp", "ulcer", "bleeding"), landmarks=("ileocecal valve", None),
        speed_factor=0.8, transit_factor=0.10, tumble_gap_s=20.0),
    "small-bowel": Organ(
        code=2, length_m=5.50, semi_axes_m=(0.11, 0.07, 0.10), bend_radius_m=0.04, tightest_radius_m=0.024,
        bend_length_m=0.03, radius_m=12.5e-3, radius_variation=0.10, folds="circular", view_m=0.13,
        waves=Waves(per_minute=9.0, speed_m_s=10e-3, width_m=9e-3, amplitude=0.12),
        look=Look(albedo=(0.70, 0.36, 0.19), vessels_per_m2=1100.0, vessel_density=0.35, relief_mm=(0.045, 0.03),
                  villi=True, bile=0.25, foam=14.0, debris=6.0),
        lesions_per_m=12.0, lesion_kinds=("ulcer", "bleeding", "angioectasia"),
        landmarks=("pylorus", "ileocecal valve"), speed_factor=1.0, transit_factor=1.0, tumble_gap_s=40.0),
    "stomach": Organ(
        code=3, length_m=0.27, semi_axes_m=(0.07, 0.05, 0.09), bend_radius_m=0.12, tightest_radius_m=0.075,
        bend_length_m=0.06, radius_m=34e-3, radius_variation=0.10, folds="rugae", view_m=0.24,
        waves=Waves(per_minute=3.0, speed_m_s=3e-3, width_m=22e-3, amplitude=0.10),
        look=Look(albedo=(0.62, 0.24, 0.15), vessels_per_m2=670.0, vessel_density=0.50, relief_mm=(0.022, 0.06),
                  villi=False, bile=0.0, foam=20.0, debris=12.0),
        lesions_per_m=24.0, lesion_kinds=("polyp", "ulcer", "bleeding"), landmarks=(None, "pylorus"),
        speed_factor=1.2, transit_factor=0.5, tumble_gap_s=10.0),
}
"""The organs by name."""
