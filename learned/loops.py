"""Loops: does the capsule see again what it saw before, and from where?

Proposals are frames whose place descriptors are alike; each is verified by keypoints and predicted depth
(`vio.revisit`), and believed only where pairs of neighbouring frames, measured for themselves, tell of the same motion:
the gut looks like itself, but not twice in a row from the same steps. What is left may still be wrong; the graph has
the last word (`fusion.loops`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learned.network_predictor import NetworkPredictor, predictor_for
from learned.places import describe_places, look_alikes
from learned.views import Views
from learned.weights import load_weights
from vio import se3
from vio.errors import RecordingError
from vio.loops import Loops
from vio.motions import RelativeMotions, chain_motions, match_frames
from vio.recording import Recording
from vio.revisit import REASONS, Revisit, RevisitLimits, RevisitNoise, compare_views

Array = NDArray[np.float64]
Pair = tuple[int, int]
Progress = Callable[[int, int], None]

UNSUPPORTED = "no pair of neighbouring frames tells of the same motion"
BESIDE = "a surer loop lies beside it"
UNREADABLE = "a frame cannot be read"
AROUND = ((1, 1), (-1, -1), (1, -1), (-1, 1), (0, 1), (1, 0), (0, -1), (-1, 0))
AGREE = 16.8
"""99 % of chi² with 6 degrees of freedom: two loops tell of the same motion."""
UNIT_PAIRS, LEAST_UNIT_PAIRS = 80, 15
"""Neighbouring frames on which the unit of the depth is compared with that of the motions; fewest that tell."""
CLEAR_STEP = 3.0
"""Steps over their noise that tell a unit."""
UNIT_SD = 0.05
"""Sd of ln of that ratio however many pairs tell it: revisits are seen from further apart than neighbours."""


@dataclass(frozen=True)
class LoopSearch:
    """How loops are looked for; chosen on simulated recordings that no reported figure comes from."""

    gap_s: float = 10.0
    """Frames closer in time make no loop."""
    look_alikes: int = 4
    """Proposals per frame."""
    window: int = 6
    """Frames within which another loop lies beside one, at both ends."""
    support: int = 2
    """Loops beside it that must tell of the same motion."""
    spacing: int = 2
    """Loops whose frames are both within so many frames share what they know; the surest is kept."""
    noise: RevisitNoise = field(default_factory=RevisitNoise)
    limits: RevisitLimits = field(default_factory=RevisitLimits)


@dataclass(frozen=True)
class LoopTrace:
    """A search with what every stage left."""

    loops: Loops
    proposed: list[Pair]
    """Frames that look alike."""
    verified: list[Pair]
    """Of these, and of those tried beside them, what keypoints and depth confirm."""
    supported: list[Pair]
    """Of these, what neighbouring pairs agree with."""


def find_loops(recording: Recording, motions: RelativeMotions, predictor: NetworkPredictor | str | Path | None = None,
               *, search: LoopSearch | None = None, progress: Progress | None = None) -> Loops:
    """Look for frames that show a place again, and measure the motion between them.

    Args:
        recording: with images, camera, and an IMU log if the weights look at vibration.
        motions: of the same recording, from any source; they say what neighbouring loops must agree on, and in what
            unit loops are told.
        predictor: weights ready for this recording; a path = weights of `capsule-vio train`, None = those that come
            along.
        search: how to look.
        progress: called with (pairs compared, pairs in all).

    Raises:
        WeightsError, CameraError, ImuError: weights that are missing, damaged, or do not fit the recording.
        RecordingError: no images.
        MotionsError: motions of another recording.
    """
    return trace_loops(recording, motions, predictor, search=search, progress=progress).loops


def trace_loops(recording: Recording, motions: RelativeMotions, predictor: NetworkPredictor | str | Path | None = None,
                *, search: LoopSearch | None = None, progress: Progress | None = None) -> LoopTrace:
    """As `find_loops`, with what every stage left; for whoever judges the search."""
    search = search or LoopSearch()
    if not isinstance(predictor, NetworkPredictor):
        predictor = predictor_for(recording, load_weights(predictor))
    if not recording.has_images:
        raise RecordingError(f"recording {recording.name}: images are missing, and loops are found in images; restore "
                             "cam0/data, or refine without --loops")
    proposed = look_alikes(describe_places(recording, predictor), recording.frame_t_s, search.gap_s,
                           search.look_alikes)
    verified = _Verified(recording, predictor, search)
    for n, (i, j) in enumerate(proposed.tolist()):
        verified.compare(i, j)
        if progress is not None:
            progress(n + 1, len(proposed))
    unit, unit_sd = _unit(verified.views, motions, recording.frame_t_s, search)
    found = {pair: _in_unit(revisit, unit, unit_sd) for pair, revisit in verified.found.items()}
    chain = _Chain(motions, recording.frame_t_s)
    for pair in [pair for pair in found if chain.support(pair, found, search.window) < search.support]:
        for i, j in ((pair[0] + a, pair[1] + b) for a, b in AROUND):
            if verified.compare(i, j):
                found[i, j] = _in_unit(verified.found[i, j], unit, unit_sd)
    supported = {pair: loop for pair, loop in found.items()
                 if chain.support(pair, found, search.window) >= search.support}
    kept = _thinned(supported, search.spacing)
    refused = Counter(verified.refused)
    refused[UNSUPPORTED] += len(found) - len(supported)
    refused[BESIDE] += len(supported) - len(kept)
    loops = Loops(_as_motions(kept, recording, motions, predictor, unit), verified.compared,
                  {reason: count for reason, count in refused.items() if count})
    return LoopTrace(loops, [(i, j) for i, j in proposed.tolist()], sorted(found), sorted(supported))


@dataclass(frozen=True)
class _Loop:
    """A verified pair in the unit of the motions."""

    T_i_j: Array
    cov: Array


class _Verified:
    """Pairs that were compared, each once, and what came of it."""

    def __init__(self, recording: Recording, predictor: NetworkPredictor, search: LoopSearch) -> None:
        self.views, self._search, self._t = Views(recording, predictor), search, recording.frame_t_s
        self.found: dict[Pair, Revisit] = {}
        self.refused: Counter[str] = Counter()
        self._seen: set[Pair] = set()

    @property
    def compared(self) -> int:
        """Pairs in all."""
        return len(self._seen)

    def compare(self, i: int, j: int) -> bool:
        """Whether a pair that was not compared before shows one place."""
        if (i, j) in self._seen or not 0 <= i < j < len(self._t) or self._t[j] - self._t[i] < self._search.gap_s:
            return False
        self._seen.add((i, j))
        first, second = self.views[i], self.views[j]
        if first is None or second is None:
            self.refused[UNREADABLE] += 1
            return False
        result = compare_views(first, second, self._search.noise, self._search.limits)
        if isinstance(result, str):
            self.refused[REASONS[result]] += 1
            return False
        self.found[i, j] = result
        return True


def _unit(views: Views, motions: RelativeMotions, frame_t_s: Array, search: LoopSearch) -> tuple[float, float]:
    """ln(depth unit / motion unit) and its sd, from steps that both measured; from the priors where too few are."""
    i, j = match_frames(motions, frame_t_s)
    length = np.linalg.norm(motions.T_i_j[:, :3, 3], axis=1)
    noise = np.sqrt(np.trace(motions.cov[:, 3:, 3:], axis1=1, axis2=2) / 3)
    clear = np.flatnonzero((length > CLEAR_STEP * noise) & (j - i == 1))
    chosen = clear[np.unique(np.linspace(0, len(clear) - 1, min(len(clear), UNIT_PAIRS)).round().astype(int))] \
        if len(clear) else clear
    ratio = []
    for n in chosen.tolist():
        first, second = views[int(i[n])], views[int(j[n])]
        if first is None or second is None:
            continue
        result = compare_views(first, second, search.noise, search.limits)
        if not isinstance(result, str):
            ratio.append(np.log(length[n] / max(float(np.linalg.norm(result.T_i_j[:3, 3])), 1e-9)))
    if len(ratio) < LEAST_UNIT_PAIRS:
        return 0.0, float(motions.scale_log_sd)
    middle = float(np.median(ratio))
    spread = 1.4826 * float(np.median(np.abs(np.array(ratio) - middle)))
    return middle, float(np.hypot(UNIT_SD, 1.25 * spread / np.sqrt(len(ratio))))


def _in_unit(revisit: Revisit, unit: float, unit_sd: float) -> _Loop:
    T = revisit.T_i_j.copy()
    T[:3, 3] *= np.exp(unit)
    factor = np.repeat([1.0, np.exp(unit)], 3)
    along = np.r_[np.zeros(3), T[:3, :3].T @ T[:3, 3]]
    return _Loop(T, revisit.cov * factor[:, None] * factor + unit_sd**2 * np.outer(along, along))


class _Chain:
    """What the motions say of neighbouring frames."""

    def __init__(self, motions: RelativeMotions, frame_t_s: Array) -> None:
        same_unit = replace(motions, scale_log_mean=0.0)
        self._T = chain_motions(same_unit, frame_t_s, np.eye(4))[0].T_world_body
        self._step_cov = np.diag(np.median(np.diagonal(motions.cov, axis1=1, axis2=2), axis=0))

    def support(self, pair: Pair, found: Mapping[Pair, _Loop], window: int) -> int:
        """How many other loops within the window tell of the same motion as one."""
        i, j = pair
        near = ((i + a, j + b) for a in range(-window, window + 1) for b in range(-window, window + 1) if a or b)
        return sum(self._agree(pair, other, found) for other in near if other in found)

    def _agree(self, pair: Pair, other: Pair, found: Mapping[Pair, _Loop]) -> bool:
        loop, beside = found[pair], found[other]
        expected = self._between(other[0], pair[0]) @ loop.T_i_j @ self._between(pair[1], other[1])
        off = se3.log(se3.inverse(expected) @ beside.T_i_j)
        steps = abs(other[0] - pair[0]) + abs(other[1] - pair[1])
        return bool(off @ np.linalg.solve(loop.cov + beside.cov + steps * self._step_cov, off) < AGREE)

    def _between(self, a: int, b: int) -> Array:
        return np.asarray(se3.inverse(self._T[a]) @ self._T[b])


def _thinned(found: Mapping[Pair, _Loop], spacing: int) -> dict[Pair, _Loop]:
    """The surest of those beside each other, in order."""
    kept: dict[Pair, _Loop] = {}
    for pair in sorted(found, key=lambda pair: (float(np.linalg.slogdet(found[pair].cov)[1]), pair)):
        i, j = pair
        beside = ((i + a, j + b) for a in range(-spacing, spacing + 1) for b in range(-spacing, spacing + 1))
        if not any(other in kept for other in beside):
            kept[pair] = found[pair]
    return dict(sorted(kept.items()))


def _as_motions(kept: Mapping[Pair, _Loop], recording: Recording, motions: RelativeMotions,
                predictor: NetworkPredictor, unit: float) -> RelativeMotions | None:
    if not kept:
        return None
    i, j = np.array(list(kept), np.int64).T
    meta: dict[str, Any] = {"source": "loops", "method": "place descriptors; keypoints and predicted depth",
                            "predictor": dict(predictor.card), "log_unit_ratio": unit}
    t = recording.frame_t_s
    return RelativeMotions(t[i], t[j], np.array([loop.T_i_j for loop in kept.values()]),
                           np.array([loop.cov for loop in kept.values()]), motions.scale_log_mean,
                           motions.scale_log_sd, meta=meta)
