"""Whether the motions' claimed translation noise is right: its variance component, estimated from a solved graph.

With whitened residuals r and redundancy 3 n - tr(P) of the n accepted motions' translations, the claimed noise is wrong
by the factor sqrt(rᵀr / redundancy) (Förstner, Zeitschrift für Vermessungswesen 104, 1979). P, the part of the errors
that the estimate follows, is as large as the graph; its trace is that of random probes z: E[zᵀPz] = tr(P) (Hutchinson,
Comm. Stat. Sim. 18, 1989). One probe costs one linear solve.

Errors that last are followed further by the estimate and leave smaller residuals. The redundancy is then what probes of
such errors leave, in place of independent ones.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fusion.engine import Begin, Engine, Step
from fusion.graph import read_poses
from fusion.scaled_motion import Linearized, ScaledMotions, linearize
from fusion.solve import MotionTerm

Array = NDArray[np.float64]
Lasting = Callable[[Array], Array]

PROBED_MOTIONS = 4000
"""Motions times probes: the factor is then known to a few percent."""
LEAST_REDUNDANCY, LEAST_SHARE = 30.0, 0.03
"""Below, in all or per translation, the data do not tell the motions' noise from the capsule's motion: where the
estimate follows the motions alone, probes of 1000 of them scatter by 25 about none."""
LEAST_MOTIONS = 50
LARGEST = 10.0
"""Factor, up or down, beyond which it is no longer a noise card that is wrong."""
ONCE = 0.9
RIGHT = (0.8, 1.25)
"""Factors that are left alone."""


def is_right(factor: float) -> bool:
    """Whether claimed noise that is wrong by this factor may stay."""
    return RIGHT[0] <= factor <= RIGHT[1]


def measured_once(motions: ScaledMotions) -> bool:
    """Whether hardly a pair of frames was measured twice.

    Sources that share errors are closer to each other than to the truth, and carry covariances widened for it: their
    residuals would make the noise look smaller than it is.
    """
    pairs = np.unique(motions.i * (int(motions.j.max()) + 1) + motions.j)
    return len(pairs) > ONCE * len(motions)


def bounded(factor: float) -> float:
    """A factor that a noise card can be wrong by."""
    return float(np.clip(factor, 1 / LARGEST, LARGEST))


def with_noise(motions: ScaledMotions, rotation: float, translation: float) -> ScaledMotions:
    """The motions with their noise multiplied: standard deviations of rotation and translation."""
    return replace(motions, whiten=motions.whiten / np.repeat([rotation, translation], 3))


def translation_noise(engine: Engine, begin: Begin, term: MotionTerm, rng: np.random.Generator,
                      lasting: Lasting | None = None) -> float:
    """Real over claimed standard deviation of the translations; 1 where the data do not tell.

    Args:
        engine: that solved the graph.
        begin: all other factors, and the common solution.
        term: the motions as they were solved; those with weight below 1 are left out.
        rng: source of the probes.
        lasting: white noise (S, N, 3) → errors of unit variance as they last; None where they do not.

    Raises:
        EstimationError: the linear system has no unique solution.
    """
    accepted = term.weight == 1.0
    if accepted.sum() < LEAST_MOTIONS or not measured_once(term.motions):
        return 1.0
    blocks = linearize(term.motions, *read_poses(begin.values), term.log_scale(begin.values))
    residual2 = float((blocks.b[accepted, 3:] ** 2).sum())
    probes = max(1, round(PROBED_MOTIONS / len(term.motions)))
    redundancy = 3.0 * int(accepted.sum())
    for _ in range(probes):
        white = rng.standard_normal((1, len(term.motions), 3))
        z, followed = white[0], _followed(engine, begin, term, blocks, white[0] * accepted[:, None])
        redundancy -= float((z * followed)[accepted].sum()) / probes
        if lasting is not None:
            longer = lasting(white)[0]
            left = longer - _followed(engine, begin, term, blocks, longer * accepted[:, None])
            redundancy += float((left**2 - (z - followed) ** 2)[accepted].sum()) / probes
    least = max(LEAST_REDUNDANCY, LEAST_SHARE * 3 * int(accepted.sum()))
    return bounded(np.sqrt(residual2 / redundancy)) if redundancy > least else 1.0


def _followed(engine: Engine, begin: Begin, term: MotionTerm, blocks: Linearized, error: Array) -> Array:
    """(N, 3) by how much the predicted whitened translations follow errors (N, 3) of the measured ones."""
    z = np.concatenate([np.zeros_like(error), error], axis=1)
    return _predicted(blocks, term.motions, engine.response(begin, term, blocks, z))


def _predicted(blocks: Linearized, motions: ScaledMotions, change: Step) -> Array:
    """(N, 3) change of the predicted whitened translations under a change of the solution."""
    A_i, A_j, A_s = (A[:, 3:] for A in (blocks.A_i, blocks.A_j, blocks.A_s))
    moved = (A_i @ change.pose[motions.i][:, :, None] + A_j @ change.pose[motions.j][:, :, None])[:, :, 0]
    return np.asarray(moved + A_s[:, :, 0] * change.scale[:, None])
