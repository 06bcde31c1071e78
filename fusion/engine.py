"""What the recipe of the graph needs from whoever solves it: a chain in numpy, or gtsam on any graph."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from fusion.config import RefineConfig
from fusion.joint import JointSamples
from fusion.problem import Problem
from fusion.scale import Segments
from fusion.scaled_motion import Linearized
from fusion.solve import MotionTerm, Solution
from fusion.stretches import Stretch

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Begin:
    """Where an optimisation of one problem begins."""

    model: Any
    """All factors but the motions, as the engine keeps them."""
    values: Any
    """First values of all frames."""
    stretches: tuple[Stretch, ...] = ()
    """How the chunks of the start fared, where the engine knows."""


@dataclass(frozen=True)
class Uncertainty:
    """How sure a solution is."""

    cov: Array
    """(M, 6, 6) of the poses, body axes, rotation first."""
    log_scale_variance: Array
    """(K,) of the segments' log scales; empty where scale is held."""
    joint: JointSamples | None
    """None where it could not be sampled."""


@dataclass(frozen=True)
class Step:
    """A linear change of a solution."""

    pose: Array
    """(M, 6) of the poses, body axes, rotation first."""
    scale: Array
    """(N,) of the log scale that applies to every motion; zero where scale is held."""


class Engine(Protocol):
    """Builds and solves; raises `EstimationError` where it cannot."""

    def begin(self, problem: Problem, config: RefineConfig, log_scale: float, accel_inflation: float) -> Begin:
        """Factors and first values at one log scale, the accelerometer's density multiplied by a factor."""
        ...

    def free(self, begin: Begin, problem: Problem, segments: Segments, walk_per_sqrt_s: float,
             log_scale: float) -> Begin:
        """The same with log scales as unknowns, starting from one value."""
        ...

    def solve(self, begin: Begin, term: MotionTerm, max_iterations: int, relative_tolerance: float) -> Solution:
        """Minimise the cost of factors and motions."""
        ...

    def uncertainty(self, begin: Begin, term: MotionTerm, segments: Segments | None,
                    rng: np.random.Generator) -> Uncertainty:
        """Covariances at `begin.values`; segments are None where scale is held."""
        ...

    def responses(self, begin: Begin, term: MotionTerm, blocks: Linearized, errors: Array) -> list[Step]:
        """`response` to each of a few errors (S, N, 6)."""
        ...

    def response(self, begin: Begin, term: MotionTerm, blocks: Linearized, error: Array) -> Step:
        """How the solution `begin.values` moves when the motions' whitened measurements move by `error` (N, 6).

        `blocks` is the term linearised there.
        """
        ...
