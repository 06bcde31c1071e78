"""Where the capsule lies still, and what that says of its motions.

Neither sensor can tell alone: to an IMU steady motion is rest, to a camera creep below its noise is. A stretch is rest
where the IMU feels nothing but its noise (`quiet.py`), and where the motions are zero within theirs: each (but for
outliers, of which nothing is claimed: what jumps and lies still again is no capsule but an error), chained
over windows of doubling length, chained over the whole stretch, long enough that creep at a stated speed would have
been found, and chained over all stretches, for what carries slowly carries on.

What is claimed is no stronger than what this excludes. Chained over a stretch with standard deviation σ, the motions
miss a displacement of k σ every other time. That there is none is therefore worth an sd of c σ, c = k / 1.96, whose
95 % interval holds what is missed. Spread over the motions, it is a second report "zero" of each translation t of
covariance P, itself of covariance c² P: together w t and w P with w = c² / (1 + c²). A motion at rest so stays one
motion, every engine takes it, and the gate judges it as before. Both grow with the root of time: such knowledge makes
what rest accumulates smaller by a factor, and cannot stop it.

Only who knows that nothing creeps slower than a speed v may claim more. Creep at v is missed for as long as it stays
within k σ(τ), over k² σ² / (v T) at most: what rest accumulates is then bounded.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.special import chndtrinc
from scipy.stats import chi2, norm

from fusion.config import RefineConfig, RestConfig
from fusion.engine import Begin, Engine
from fusion.graph import States
from fusion.problem import Problem
from fusion.quiet import covered, passing, quiet_intervals, windows
from fusion.result import RestConclusion
from fusion.scaled_motion import ScaledMotions
from fusion.solve import MotionTerm, Solution
from vio import se3
from vio.imu import ImuSamples

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Indices = NDArray[np.int64]

FALSE_ALARM = 0.05
"""Of each test: in how many recordings at rest an interval is lost to it; how many whole stretches are."""
FOUND = 0.95
"""How surely creep at the stated speed must be found."""
WHOLE = float(chi2.isf(FALSE_ALARM, 3))
"""Squared displacement over its covariance above which a whole stretch is not at rest."""
MISSED = float(np.sqrt(chndtrinc(WHOLE, 3, 0.5)))
"""Displacement over its standard deviation that the test of a whole stretch misses every other time."""
HOLDS_95 = 1.96
SHORTEST_CHAIN = 4
"""Motions in the shortest window that is chained."""
OUTLIERS_MOST = 0.2
"""Share of a stretch's motions that may be outliers."""
ROUNDS = 4


@dataclass(frozen=True)
class Rests:
    """Stretches at rest, and their motions."""

    span: Indices
    """(R, 2) first and last node."""
    motion: Indices
    """(K,) motions that say so."""
    of_motion: Indices
    """(K,) stretch of each."""
    share: Array
    """(R,) w: what is left of a motion's translation, and of its variance."""
    displacement_sd_m: Array
    """(R,) of the claim that the stretch's displacement is zero, along the worst axis."""

    def keep(self, which: Bools) -> Rests:
        """Some of the stretches (R,)."""
        of = np.cumsum(which) - 1
        mine = which[self.of_motion]
        return Rests(self.span[which], self.motion[mine], of[self.of_motion[mine]], self.share[which],
                     self.displacement_sd_m[which])

    def conclusion(self) -> RestConclusion:
        """For whoever reads the result."""
        return RestConclusion(self.span, self.displacement_sd_m)


@dataclass(frozen=True)
class _Chain:
    """One motion per interval, and what it says if the capsule rests."""

    motion: Indices
    """(M-1,) -1 where there is none."""
    shift: Array
    """(M-1, 3) translation, motion units; 0 where there is none."""
    cov: Array
    """(M-1, 3, 3)"""


def find_rests(problem: Problem, felt: ImuSamples, states: States, accepted: Bools, log_scale: Array,
               config: RestConfig) -> Rests:
    """Stretches in which IMU and motions agree that the capsule lies still.

    Args:
        problem: its motions as they were solved.
        felt: inertial samples as measured, nothing taken out of them.
        states: of the solution: the gyro's bias.
        accepted: (N,) motions that are no outliers.
        log_scale: (M,) ln metres per motion unit.
        config: the speeds that are stated.
    """
    motions, count = problem.motions, len(problem) - 1
    still = problem.imu_usable & quiet_intervals(felt, problem.imu_t_s, problem.t_s, states.gyro_bias, problem.noise,
                                                 FALSE_ALARM)
    far = _far_from_zero(motions) & accepted
    lone = far & (motions.j - motions.i == 1) & _lone(covered(motions.i[far], motions.j[far], count))[motions.i]
    moving = far & ~lone
    chains = _chains(motions, accepted & ~far, count + 1)
    still &= _measured(motions, count) & ~covered(motions.i[moving], motions.j[moving], count)
    spread = _lasting_factor(problem)
    for chain in chains:
        level = FALSE_ALARM / len(chains) / windows(count, SHORTEST_CHAIN, count)
        still = passing(still, SHORTEST_CHAIN, count, partial(_chained, chain, spread), level)
    found = []
    for first, last in _runs(still):
        judged = _judge(problem, chains, spread, first, last, log_scale, config)
        if judged is not None:
            found.append((first, last, *judged))
    if any(_together(chain, spread, found) > WHOLE for chain in chains):
        found = []
    return _gathered(found, chains)


def claim(sd_m: float, duration_s: float, slowest_m_s: float) -> float:
    """Sd of "no displacement" over that of the chained motions, which may be called c in the formulas above.

    Args:
        sd_m: of the chained motions over a stretch, lasting errors included.
        duration_s: of the stretch.
        slowest_m_s: nothing creeps slower.
    """
    return MISSED / HOLDS_95 * min(1.0, MISSED * sd_m / (slowest_m_s * duration_s))


def at_rest(motions: ScaledMotions, rests: Rests, log_scale: Array) -> ScaledMotions:
    """The motions, those of stretches at rest together with what that says of them; they measure no scale any more.

    With less noise than they claim, their sizes against the IMU's would pull the scale.

    Args:
        motions: as they were.
        rests: the stretches.
        log_scale: (N,) of every motion.
    """
    w = np.ones(len(motions))
    w[rests.motion] = rests.share[rests.of_motion]
    whiten = motions.whiten.copy()
    whiten[:, :, 3:] /= np.sqrt(w)[:, None, None]
    held = np.full(len(motions), np.nan)
    held[rests.motion] = log_scale[rests.motion]
    return replace(motions, t=motions.t * w[:, None], whiten=whiten, held_log_scale=held)


def with_rests(engine: Engine, begin: Begin, term: MotionTerm, rests: Rests,
               config: RefineConfig) -> tuple[MotionTerm, Solution, Rests] | None:
    """Solve again with the stretches at rest, less those that the rest of the graph contradicts; None where none holds.

    Args:
        engine: that found the solution without them.
        begin: its factors and the solution.
        term: its motions, gated.
        rests: what was found.
        config: the gate and the solver's limits.

    Raises:
        EstimationError: no solution with them.
    """
    solver = config.solver
    for _ in range(ROUNDS):
        if not len(rests.span):
            return None
        joined = replace(term, motions=at_rest(term.motions, rests, term.log_scale(begin.values)))
        solution = engine.solve(begin, joined, solver.max_iterations, solver.relative_tolerance)
        beyond = rests.of_motion[solution.squared_norm[rests.motion] > config.robust.gate]
        if not len(beyond):
            return joined, solution, rests
        rests = rests.keep(~np.isin(np.arange(len(rests.span)), beyond))
    return None


def _chains(motions: ScaledMotions, accepted: Bools, nodes: int) -> list[_Chain]:
    """The surest motion of every interval, the next surest where a pair was measured again, and so on."""
    left, out = np.flatnonzero(accepted & (motions.j - motions.i == 1)), []
    while len(left):
        surest = motions.select(left).surest_neighbours(nodes)
        motion = np.where(surest >= 0, left[surest], -1)
        there = motion >= 0
        shift, cov = np.zeros((nodes - 1, 3)), np.zeros((nodes - 1, 3, 3))
        shift[there] = motions.t[motion[there]]
        lower = np.linalg.inv(motions.whiten[motion[there]])[:, 3:]
        cov[there] = lower @ np.swapaxes(lower, 1, 2)
        out.append(_Chain(motion, shift, cov))
        left = np.setdiff1d(left, motion)
    return out


def _measured(motions: ScaledMotions, count: int) -> Bools:
    """(count,) intervals that a motion of theirs alone speaks of, outlier or not."""
    out = np.zeros(count, bool)
    out[motions.i[motions.j - motions.i == 1]] = True
    return out


def _far_from_zero(motions: ScaledMotions) -> Bools:
    """(N,) motions that say by themselves that the camera moved."""
    measured = np.concatenate([se3.so3_log(motions.R), motions.t], axis=1)
    whitened = (motions.whiten @ measured[:, :, None])[:, :, 0]
    return np.asarray(np.einsum("nk,nk->n", whitened, whitened) > chi2.isf(FALSE_ALARM / len(motions), 6))


def _lone(moving: Bools) -> Bools:
    """(C,) intervals without one that moves on either side: a capsule does not jump there and lie still again."""
    beside = np.concatenate([[False], moving, [False]])
    return np.asarray(~(beside[:-2] | beside[2:]))


def _lasting_factor(problem: Problem) -> float:
    """Variance of a long chain over the sum of its motions' variances, where errors last."""
    if problem.error_correlation_s == 0:
        return 1.0
    rho = float(np.exp(-np.median(problem.dt_s) / problem.error_correlation_s))
    return (1 + rho) / (1 - rho)


def _chained(chain: _Chain, spread: float, first: Indices, last: Indices) -> tuple[Array, Array]:
    """Squared displacement of windows over its covariance, as a capsule at rest would have it."""
    total, cov = (np.concatenate([np.zeros((1, *x.shape[1:])), np.cumsum(x, axis=0)]) for x in (chain.shift, chain.cov))
    moved, sure = total[last] - total[first], spread * (cov[last] - cov[first])
    there = np.trace(sure, axis1=1, axis2=2) > 0
    sure[~there] = np.eye(3)
    return np.einsum("nk,nk->n", moved, np.linalg.solve(sure, moved[:, :, None])[:, :, 0]), np.full(len(first), 3.0)


def _runs(still: Bools) -> list[tuple[int, int]]:
    """First and last node of every unbroken run of intervals."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(int), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _judge(problem: Problem, chains: list[_Chain], spread: float, first: int, last: int, log_scale: Array,
           config: RestConfig) -> tuple[float, float] | None:
    """Share w and sd [m] of the claim for one stretch; None where it may be anything but rest."""
    span = slice(first, last)
    if (chains[0].motion[span] < 0).mean() > OUTLIERS_MOST:
        return None
    whole = np.array([first]), np.array([last])
    if any(_chained(chain, spread, *whole)[0][0] > WHOLE for chain in chains):
        return None
    unit_m, duration_s = float(np.exp(log_scale[first:last + 1].mean())), float(problem.t_s[last] - problem.t_s[first])
    cov = spread * chains[0].cov[span].sum(axis=0)
    sd_m = unit_m * float(np.sqrt(np.linalg.eigvalsh(cov)[-1]))
    if (np.sqrt(WHOLE) + norm.isf(1 - FOUND)) * sd_m > config.found_m_s * duration_s:
        return None
    worth = claim(sd_m, duration_s, config.slowest_m_s)
    alone = worth**2 * spread  # over a single motion's variance
    return alone / (1 + alone), worth * sd_m


def _together(chain: _Chain, spread: float, found: list[tuple[int, int, float, float]]) -> float:
    """Squared displacement over its covariance of all stretches at once: what carries slowly carries on."""
    if not found:
        return 0.0
    mine = np.concatenate([np.arange(first, last) for first, last, _, _ in found])
    moved, cov = chain.shift[mine].sum(axis=0), spread * chain.cov[mine].sum(axis=0)
    return float(moved @ np.linalg.solve(cov, moved)) if np.trace(cov) > 0 else 0.0


def _gathered(found: list[tuple[int, int, float, float]], chains: list[_Chain]) -> Rests:
    motion, of = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for k, (first, last, _, _) in enumerate(found):
        mine = chains[0].motion[first:last]
        motion.append(mine[mine >= 0])
        of.append(np.full(len(motion[-1]), k))
    return Rests(np.array([f[:2] for f in found], np.int64).reshape(-1, 2), np.concatenate(motion), np.concatenate(of),
                 np.array([f[2] for f in found]), np.array([f[3] for f in found]))
