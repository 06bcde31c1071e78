"""An organ as the capsule finds it: centreline, wall, its motion, and what lies on it, all from one seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vio.simulation.centreline import Centreline
from vio.simulation.organs import ORGANS, Organ
from vio.simulation.wall import Wall
from vio.simulation.wall_motion import WallMotion

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Anatomy:
    """One organ of one patient."""

    name: str
    organ: Organ
    seed: tuple[int, ...]
    """Of this anatomy; textures derive theirs from it."""
    centreline: Centreline
    wall: Wall
    motion: WallMotion


def make_anatomy(name: str, seed: int, wall_motion: float = 1.0) -> Anatomy:
    """The organ `name` (a key of `ORGANS`) of the patient `seed`; `wall_motion` scales its contractions."""
    organ = ORGANS[name]
    key = (seed, organ.code)
    centreline = Centreline(organ, np.random.default_rng([*key, 4]))
    wall = Wall(organ, key)
    return Anatomy(name, organ, key, centreline, wall, WallMotion(wall, centreline, organ.waves, wall_motion))
