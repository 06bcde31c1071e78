"""Gauss-Newton on a chain of frames."""

from __future__ import annotations

import numpy as np

from fusion.chain import ChainSystem
from fusion.chain_model import ChainModel
from fusion.chain_state import ChainState
from fusion.solve import SMALLEST_STEP, MotionTerm, Solution
from vio.errors import EstimationError

AS_PREDICTED = 0.2
"""Share of the tolerance by which a step's gain may differ from the linear system's prediction, so that there is
nothing left to gain: the next step, which would only find that out, is not made."""


def chain_gauss_newton(model: ChainModel, state: ChainState, term: MotionTerm, max_iterations: int,
                       relative_tolerance: float, memory: ChainSystem | None = None) -> Solution:
    """Minimise the model's factors plus the motion term, halving any step that raises the cost.

    `memory` is a system that is no longer needed.

    Raises:
        EstimationError: the cost is not finite, or a linear system is indeterminate.
    """
    here = _Evaluated(model, state, term)
    iterations, system = 0, memory
    while iterations < max_iterations:
        if not np.isfinite(here.cost):
            raise EstimationError(f"graph: the cost is {here.cost} after {iterations} iterations")
        system = model.linearize(here.state, term, system)
        delta = system.factor().solve()
        predicted = system.gain(delta)
        moved = _line_search(model, here, term, delta)
        iterations += 1
        if moved is None:
            break
        gained = here.cost - moved.cost
        converged = (gained <= relative_tolerance * here.cost
                     or abs(gained - predicted) <= AS_PREDICTED * relative_tolerance * moved.cost)
        here = moved
        if converged:
            break
    return Solution(here.state, here.squared_norm, here.native_cost, iterations)


class _Evaluated:
    """A state and what it costs."""

    def __init__(self, model: ChainModel, state: ChainState, term: MotionTerm) -> None:
        self.state = state
        self.native_cost = model.cost(state)
        self.squared_norm = term.squared_norm(state)
        self.cost = self.native_cost + term.losses(self.squared_norm)[0]


def _line_search(model: ChainModel, here: _Evaluated, term: MotionTerm, delta: np.ndarray) -> _Evaluated | None:
    """The first of the full, half, quarter … step that does not raise the cost; None when all do."""
    of_node = None if model.scale is None else model.scale.of_node
    step = 1.0
    while step >= SMALLEST_STEP:
        candidate = _Evaluated(model, here.state.moved(step * delta, of_node), term)
        if np.isfinite(candidate.cost) and candidate.cost <= here.cost:
            return candidate
        step *= 0.5
    return None
