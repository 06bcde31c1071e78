"""A refined trajectory as the course of a capsule through the gut: centreline, sampled centrelines, arc lengths."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.joint import JointSamples
from fusion.lesions.centreline import GRID_M, Centreline, arc_length, place_on_lines, trace_centreline
from fusion.result import Refinement
from vio.errors import LesionError

Array = NDArray[np.float64]

ZERO = 0
"""Arc length counts from the first frame's place."""
CHUNK, OWN_WAYS = 10, 12
SAMPLE_REACH_M = 15e-3
"""How far a sampled point is looked for along its sampled line from where the estimate lies."""


class Beside(NamedTuple):
    """A point beside the centreline."""

    arc_m: float
    sampled_m: Array
    """(S,) its arc length in every sampled trajectory."""
    aside_m: float
    """Its distance from the line."""


@dataclass(frozen=True)
class Course:
    """A refinement with what localisation asks of it; the costly parts are computed once, when first needed."""

    refinement: Refinement

    @property
    def t_s(self) -> Array:
        """(M,) times of the frames [s]."""
        return self.refinement.trajectory.t_s

    @property
    def joint(self) -> JointSamples | None:
        """How the errors of all poses hang together."""
        return self.refinement.joint

    @cached_property
    def centreline(self) -> Centreline:
        """The travelled centreline of the estimate.

        Raises:
            LesionError: fewer than two frames.
        """
        if len(self.t_s) < 2:
            raise LesionError("locate: the trajectory has a single pose; a path needs at least 2")
        return trace_centreline(self.refinement.trajectory.positions_m)

    @cached_property
    def sampled_lines_m(self) -> Array:
        """(S, J, 3) centrelines of sampled trajectories; S = 0 where joint uncertainty is unknown."""
        joint, frames = self.joint, np.arange(len(self.t_s))
        if joint is None:
            return np.zeros((0, *self.centreline.points_m.shape))
        p, R = self.refinement.trajectory.positions_m, self.refinement.trajectory.rotations
        lines = []
        for first in range(0, len(joint.xi), CHUNK):
            some = JointSamples(joint.node, joint.xi[first:first + CHUNK], joint.log_scale[first:first + CHUNK])
            lines.append(self.centreline.smooth(p + some.position_errors(R, frames)))
        return np.concatenate(lines)

    @cached_property
    def _lengths(self) -> tuple[Array, Array]:
        """Length along the estimate's line (1, J) and along the sampled ones (S, J)."""
        return arc_length(self.centreline.points_m[None]), arc_length(self.sampled_lines_m)

    @cached_property
    def ambiguity_m(self) -> Array:
        """(T, M) by how much frames move along the line when some sampled trajectories find their own way.

        Whether a capsule that comes back is where it was, or further on, can hang by little; the sampled lines take
        over the estimate's answer, these do not.
        """
        joint, frames = self.joint, np.arange(len(self.t_s))
        if joint is None:
            return np.zeros((0, len(frames)))
        p, R = self.refinement.trajectory.positions_m, self.refinement.trajectory.rotations
        some = JointSamples(joint.node, joint.xi[:OWN_WAYS], joint.log_scale[:OWN_WAYS])
        own = np.array([trace_centreline(track).frame_arc_m for track in p + some.position_errors(R, frames)])
        places = self.frame_places(frames)
        taken = np.array([_along(np.broadcast_to(length, (len(places), len(length))), places)
                          for length in self._lengths[1][:OWN_WAYS]])
        return np.asarray(own - (taken - taken[:, :1]))

    def frame_places(self, frames: NDArray[np.int64]) -> Array:
        """Where frames lie on the centreline, in grid steps."""
        grid = np.arange(len(self.centreline.arc_m))
        return np.interp(self.centreline.frame_arc_m[frames], self.centreline.arc_m, grid)

    def arc_at(self, place: float) -> tuple[float, Array]:
        """Arc length [m] of a place, on the estimate and on every sampled line (S,)."""
        count = len(self.sampled_lines_m)
        return float(self._arcs(np.array([place]), 0)[0]), self._arcs(np.full(count, place), 1)

    def arc_of(self, point_m: Array, errors_m: Array, frame: int, reach_m: float) -> Beside | None:
        """Where a point beside the gut lies along its centreline; None where the travelled line does not reach it.

        Args:
            point_m: (3,) in the world.
            errors_m: (S, 3) its error in every sampled trajectory.
            frame: the frame it was seen from.
            reach_m: how far along the line from there it is looked for.
        """
        near = float(self.frame_places(np.array([frame]))[0])
        point_m = point_m - self.centreline.drift_m[frame]
        last = len(self.centreline.points_m) - 1
        reach = int(np.ceil(reach_m / GRID_M))
        first = max(0, int(near) - reach)
        window = first, min(last, int(near) + reach)
        place = float(place_on_lines(point_m[None], self.centreline.points_m[None], *window)[0])
        if not 0 < place < last:
            return None
        around = int(np.ceil(SAMPLE_REACH_M / GRID_M))
        places = place_on_lines(point_m + errors_m, self.sampled_lines_m, max(0, int(place) - around),
                                min(last, int(place) + around + 1))
        cell = int(place)
        on_line = self.centreline.points_m[cell:cell + 2]
        aside = float(np.linalg.norm(point_m - on_line[0] - (place - cell) * (on_line[1] - on_line[0])))
        return Beside(float(self._arcs(np.array([place]), 0)[0]), self._arcs(places, 1), aside)

    def _arcs(self, places: Array, which: int) -> Array:
        """Arc length from the first frame's place, of one place on each line."""
        lengths = self._lengths[which]
        zero = float(self.frame_places(np.array([ZERO]))[0])
        return _along(lengths, places) - _along(lengths, np.full(len(places), zero))


def _along(lengths: Array, places: Array) -> Array:
    """Length (S,) at fractional places (S,) on lines with lengths (S, J)."""
    cell = np.clip(places.astype(np.int64), 0, lengths.shape[1] - 2)
    row, share = np.arange(len(places)), places - cell
    return np.asarray((1 - share) * lengths[row, cell] + share * lengths[row, cell + 1])
