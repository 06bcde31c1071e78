"""Several sources of motions at once: one unit, one scale prior, and no evidence counted twice.

Two sources that look at the same images make partly the same errors. Where both claim covariance C and their errors
correlate by ρ, their difference Log(T_a⁻¹ T_b) has covariance 2 (1 - ρ) C: how much closer the sources are to each
other than independent ones would be measures ρ. Where a source's `meta` declares how its errors go with the other's, as
weights that were calibrated for both do, that is taken instead: it was measured beside truth, and for rotation and
translation apart. The mean of n motions of one pair of frames has variance C (1 + (n - 1) ρ) / n, which n factors give
when each carries C (1 + (n - 1) ρ).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from vio import se3
from vio.errors import MotionsError
from vio.motions import TIME_TOLERANCE_S, RelativeMotions

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

LEAST_SHARED = 20
"""Pairs of frames that two sources must share before their scales or errors are compared."""
CLEAR_STEP = 3.0
"""Steps over their noise that show a ratio of scales."""
CONTRADICTION = 4.0
"""Standard deviations between two priors of one scale at which they are refused."""
MEDIAN_CHI2_6 = 5.348


@dataclass(frozen=True)
class MergedMotions:
    """Motions of all sources in the unit of the first."""

    motions: RelativeMotions
    source: Indices
    """(N,) number of the source of every motion."""
    log_ratio: Array
    """(K,) ln(unit of source k / unit of the first)."""
    correlation: Array
    """(K, K, 2) of the rotation and translation errors of two sources, 0 to 1; 1 where a source meets itself."""


def merge_motions(sources: Sequence[RelativeMotions]) -> MergedMotions:
    """Put the motions of several sources into one set.

    Args:
        sources: each with its own unit and scale prior; the first one's unit is kept.

    Raises:
        MotionsError: no source, or two sources whose scale priors contradict their own motions.
    """
    if not sources:
        raise MotionsError("motions: no source; give at least one")
    shared = {(a, b): _shared(sources[a], sources[b]) for a, b in combinations(range(len(sources)), 2)}
    ratio = np.array([0.0, *(_log_ratio(sources[0], sources[k], *shared[0, k]) for k in range(1, len(sources)))])
    same_unit = [_scaled(motions, r) for motions, r in zip(sources, ratio, strict=True)]
    correlation = np.repeat(np.eye(len(sources))[..., None], 2, axis=2)
    for (a, b), (at_a, at_b) in shared.items():
        declared = _declared(sources[a], sources[b])
        found = _correlation(same_unit[a], same_unit[b], at_a, at_b) if declared is None else declared
        correlation[a, b] = correlation[b, a] = found
    inflation = _inflations(same_unit, shared, correlation)
    mean, sd = _prior(sources, ratio)
    joined = {name: np.concatenate([getattr(m, name) for m in same_unit]) for name in ("t_i_s", "t_j_s", "T_i_j")}
    cov = np.concatenate([m.cov * f[:, :, None] * f[:, None, :] for m, f in zip(same_unit, inflation, strict=True)])
    snr = None if any(m.snr is None for m in sources) else np.concatenate([m.snr for m in sources if m.snr is not None])
    order = np.argsort(joined["t_i_s"], kind="stable")
    source = np.repeat(np.arange(len(sources)), [len(m) for m in sources])
    meta = {"sources": [dict(m.meta) for m in sources], "log_ratio": ratio.tolist(),
            "correlation": correlation.round(4).tolist()}
    if any(m.meta.get("rotation") == "gyro" for m in sources):
        meta["rotation"] = "gyro"
    motions = RelativeMotions(joined["t_i_s"][order], joined["t_j_s"][order], joined["T_i_j"][order], cov[order], mean,
                              sd, None if snr is None else snr[order], meta)
    return MergedMotions(motions, source[order].astype(np.int64), ratio, correlation)


def _shared(a: RelativeMotions, b: RelativeMotions) -> tuple[Indices, Indices]:
    """Motions of both sources that join the same two frames."""
    def keys(motions: RelativeMotions) -> list[tuple[int, int]]:
        return [(round(i / TIME_TOLERANCE_S), round(j / TIME_TOLERANCE_S))
                for i, j in zip(motions.t_i_s.tolist(), motions.t_j_s.tolist(), strict=True)]

    place = {key: n for n, key in enumerate(keys(a))}
    found = [(place[key], n) for n, key in enumerate(keys(b)) if key in place]
    index = np.array(found, np.int64).reshape(-1, 2)
    return index[:, 0], index[:, 1]


def _log_ratio(a: RelativeMotions, b: RelativeMotions, at_a: Indices, at_b: Indices) -> float:
    """ln(unit of b / unit of a): the median ratio of shared steps, the priors' where there are too few."""
    steps = [np.linalg.norm(m.T_i_j[at, :3, 3], axis=1) for m, at in ((a, at_a), (b, at_b))]
    noise = [np.sqrt(np.trace(m.cov[at, 3:, 3:], axis1=1, axis2=2) / 3) for m, at in ((a, at_a), (b, at_b))]
    clear = (steps[0] > CLEAR_STEP * noise[0]) & (steps[1] > CLEAR_STEP * noise[1])
    if clear.sum() < LEAST_SHARED:
        return b.scale_log_mean - a.scale_log_mean
    return float(np.median(np.log(steps[0][clear] / steps[1][clear])))


def _scaled(motions: RelativeMotions, log_ratio: float) -> RelativeMotions:
    """The motions in a unit that is smaller by `exp(log_ratio)`."""
    unit = np.repeat([1.0, np.exp(log_ratio)], 3)
    T = motions.T_i_j.copy()
    T[:, :3, 3] *= unit[3]
    return RelativeMotions(motions.t_i_s, motions.t_j_s, T, motions.cov * unit[:, None] * unit,
                           motions.scale_log_mean - log_ratio, motions.scale_log_sd, motions.snr, motions.meta)


def _declared(a: RelativeMotions, b: RelativeMotions) -> Array | None:
    """(2,) correlations of rotation and translation errors that one source knows of itself and the other's network."""
    for one, other in ((a, b), (b, a)):
        known, weights = one.meta.get("network_correlation"), _weights(one)
        of_network = other.meta.get("rotation") == "network" and "network_correlation" not in other.meta
        if known is not None and weights is not None and weights == _weights(other) and of_network:
            return np.clip([float(known["rotation"]), float(known["translation"])], 0.0, 1.0)
    return None


def _weights(motions: RelativeMotions) -> str | None:
    """Digest of the weights that measured them."""
    predictor = motions.meta.get("predictor")
    return predictor.get("sha256") if isinstance(predictor, dict) else None


def _correlation(a: RelativeMotions, b: RelativeMotions, at_a: Indices, at_b: Indices) -> float:
    """Of the errors of shared motions; 0 where too few are shared to tell."""
    if len(at_a) < LEAST_SHARED:
        return 0.0
    difference = se3.log(se3.inverse(a.T_i_j[at_a]) @ b.T_i_j[at_b])
    lower = np.linalg.cholesky(a.cov[at_a] + b.cov[at_b])
    whitened = np.linalg.solve(lower, difference[:, :, None])[:, :, 0]
    closeness = float(np.median((whitened**2).sum(axis=1))) / MEDIAN_CHI2_6
    return float(np.clip(1 - closeness, 0.0, 1.0))


def _inflations(sources: list[RelativeMotions], shared: dict[tuple[int, int], tuple[Indices, Indices]],
                correlation: Array) -> list[Array]:
    """Per source (N, 6) factors on the sds: √(1 + the correlations with the others that measured the same pair)."""
    out = [np.ones((len(motions), 2)) for motions in sources]
    for (a, b), (at_a, at_b) in shared.items():
        np.add.at(out[a], at_a, correlation[a, b])
        np.add.at(out[b], at_b, correlation[a, b])
    return [np.sqrt(np.repeat(factor, 3, axis=1)) for factor in out]


def _prior(sources: Sequence[RelativeMotions], log_ratio: Array) -> tuple[float, float]:
    """Mean and sd of ln(metres per first unit) from all priors, which must not contradict each other."""
    mean = np.array([m.scale_log_mean for m in sources]) - log_ratio
    sd = np.array([m.scale_log_sd for m in sources])
    for a, b in combinations(range(len(sources)), 2):
        apart, allowed = abs(float(mean[a] - mean[b])), CONTRADICTION * float(np.hypot(sd[a], sd[b])) + 1e-9
        if apart > allowed and sd[[a, b]].max() > 0:
            raise MotionsError(f"motions: sources {a + 1} and {b + 1} declare scales that are {np.exp(apart):.2f} "
                               f"times apart (limit {np.exp(allowed):.2f}): correct the scale_log_mean that is wrong")
    if (sd == 0).any():
        return float(mean[sd == 0][0]), 0.0
    information = 1 / sd**2
    return float(information @ mean / information.sum()), float(1 / np.sqrt(information.sum()))
