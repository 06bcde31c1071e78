"""What a chain of frames costs, and its linearisation: inertial steps, gauge, bias and scale walks, relative motions.

The same factors as in `graph.py`, evaluated for all frames at once in numpy. With body poses (R, p), velocity v,
gravity g and c = 1 (0 across a gap of the IMU), the inertial residual of interval k → k+1 in body axes of k is

    e_R = Log(ΔR(b)ᵀ R_kᵀ R_{k+1})
    e_v = R_kᵀ (v_{k+1} - v_k - c g dt) - Δv(b)
    e_p = R_kᵀ (p_{k+1} - p_k - c (v_k dt + ½ g dt²)) - Δp(b)

with ΔR(b), Δv(b), Δp(b) corrected to the current biases to first order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.chain import BIAS, BLOCK_NODES, DIM, POSE, RIGHT, SCALE, VELOCITY, ChainSystem, spans
from fusion.chain_far import JOINED, FarFactors
from fusion.chain_state import ChainState
from fusion.graph import Anchor
from fusion.inertial import InertialSteps
from fusion.solve import MotionTerm
from vio import se3
from vio.imu import GRAVITY_M_S2

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

GRAVITY_WORLD = np.array([0.0, 0.0, -GRAVITY_M_S2])
LONGEST_REACH = 4
"""Frames that a motion of the band may span; the work per frame grows with its square."""
TIE_INFORMATION = 1e10
"""Ties the copies of one log scale to 1e-5, far closer than any is known."""
ROTATION, SHIFT, SPEED, ACCEL_BIAS, GYRO_BIAS = (slice(k, k + 3) for k in range(1, 16, 3))
NEXT_ROTATION, NEXT_SHIFT, NEXT_SPEED = (slice(k, k + 3) for k in range(17, 26, 3))
NEXT_POSE = slice(17, 23)
"""Columns of a factor's rows."""
INERTIAL_ROWS, MOTION_ROWS = 9, 6


@dataclass(frozen=True)
class ScaleWalk:
    """Prior on the first segment's log scale, and a random walk from segment to segment."""

    of_node: Indices
    """(M,) segment of every frame, in order."""
    log_mean: float
    log_sd: float
    step_sd: Array
    """(K-1,)"""


@dataclass(frozen=True)
class ChainModel:
    """Everything but the motions: M frames, M-1 intervals."""

    steps: InertialSteps
    anchor: Anchor
    scale: ScaleWalk | None = None
    """None where scale is held."""

    @property
    def nodes(self) -> int:
        """Number of frames M."""
        return len(self.steps) + 1

    def cost(self, state: ChainState) -> float:
        """Half the squared whitened residuals of all factors but the motions."""
        total = 0.5 * float(sum((r**2).sum() for r in self._anchor_residuals(state)))
        for first, last in spans(len(self.steps), BLOCK_NODES):
            r = _times(self.steps.whiten[first:last], self._residuals(state, first, last)[0])
            total += 0.5 * float(np.vdot(r, r))
        walked = np.concatenate([np.diff(state.accel_bias, axis=0), np.diff(state.gyro_bias, axis=0)], axis=1)
        total += 0.5 * float(((walked / self.steps.bias_walk_sd) ** 2).sum())
        if self.scale is not None:
            total += 0.5 * float(((state.log_scale[0] - self.scale.log_mean) / self.scale.log_sd) ** 2)
            total += 0.5 * float(((np.diff(state.log_scale) / self.scale.step_sd) ** 2).sum())
        return total

    def system(self, term: MotionTerm, memory: ChainSystem | None = None) -> ChainSystem:
        """A system without factors, in the memory of an earlier one where it fits."""
        span = term.motions.j - term.motions.i
        reach = int(span.max(initial=1, where=span <= LONGEST_REACH))
        if memory is None or (memory.nodes, memory.reach) != (self.nodes, reach):
            return ChainSystem(self.nodes, reach)
        memory.clear()
        return memory

    def linearize(self, state: ChainState, term: MotionTerm, memory: ChainSystem | None = None) -> ChainSystem:
        """Normal equations of all factors and the motions at `state`, in the memory of an earlier one where it fits."""
        span = term.motions.j - term.motions.i
        far = np.flatnonzero(span > LONGEST_REACH)
        system = self.system(term, memory)
        reach = system.reach
        near = MotionRows(state, term, np.flatnonzero(span <= LONGEST_REACH))
        together = near.groups if reach == 1 else []
        rows = np.zeros((min(BLOCK_NODES, self.nodes), INERTIAL_ROWS + MOTION_ROWS * len(together), RIGHT + 1))
        raw = np.zeros((len(rows), INERTIAL_ROWS, RIGHT + 1))
        for first, last in spans(self.nodes - 1, BLOCK_NODES):
            now = rows[:last - first]
            self._inertial(state, first, last, raw[:last - first])
            np.matmul(self.steps.whiten[first:last], raw[:last - first], out=now[:, :INERTIAL_ROWS])
            for k in range(len(together)):
                near.write(k, first, last, now[:, INERTIAL_ROWS + MOTION_ROWS * k:])
            if reach == 1:
                system.add_chain(first, now)
            else:
                system.add(np.arange(first, last), np.arange(first + 1, last + 1), now)
        if reach > 1:
            near.add(system)
        bias = np.concatenate([state.accel_bias, state.gyro_bias], axis=1)
        system.add_links(BIAS, self.steps.bias_walk_sd**-2, -np.diff(bias, axis=0))
        self._add_anchor(system, state)
        self._add_scale(system, state)
        if len(far):
            system.far = far_factors(state, term, far)
        return system

    def _residuals(self, state: ChainState, first: int, last: int) -> tuple[Array, ...]:
        """Residuals (B, 9), and what their derivatives need: Exp(e_R), R_kᵀ R_{k+1}, and v and p in body axes."""
        s = self.steps
        now, then = slice(first, last), slice(first + 1, last + 1)
        R_t = np.swapaxes(state.R[now], 1, 2)
        R_ij = R_t @ state.R[then]
        dt, c = s.dt_s[now, None], s.free_fall[now, None]
        gyro, accel = state.gyro_bias[now] - s.gyro_bias, state.accel_bias[now] - s.accel_bias
        E = np.swapaxes(s.R[now] @ se3.so3_exp(_times(s.R_bg[now], gyro)), 1, 2) @ R_ij
        dv = _times(R_t, state.v[then] - state.v[now] - c * dt * GRAVITY_WORLD)
        dp = _times(R_t, state.p[then] - state.p[now] - c * (dt * state.v[now] + 0.5 * dt**2 * GRAVITY_WORLD))
        e_v = dv - s.v[now] - _times(s.v_bg[now], gyro) - _times(s.v_ba[now], accel)
        e_p = dp - s.p[now] - _times(s.p_bg[now], gyro) - _times(s.p_ba[now], accel)
        return np.concatenate([se3.so3_log(E), e_v, e_p], axis=1), E, R_ij, dv, dp

    def _inertial(self, state: ChainState, first: int, last: int, A: Array) -> None:
        """Write the rows (B, 9, 27) of the inertial steps, not whitened; the places that stay zero must be zero."""
        s, now = self.steps, slice(first, last)
        e, E, R_ij, dv, dp = self._residuals(state, first, last)
        R_t = np.swapaxes(state.R[now], 1, 2)
        R_ji = np.swapaxes(state.R[first + 1:last + 1], 1, 2) @ state.R[now]
        J = se3.so3_right_jacobian_inverse(e[:, :3])
        A[:, :3, NEXT_ROTATION] = J
        np.negative(J, out=J)
        np.matmul(J, R_ji, out=A[:, :3, ROTATION])
        np.matmul(J, np.swapaxes(E, 1, 2) @ s.R_bg[now], out=A[:, :3, GYRO_BIAS])
        A[:, 3:6, NEXT_SPEED] = R_t
        np.negative(R_t, out=A[:, 3:6, SPEED])
        np.multiply(A[:, 3:6, SPEED], (s.free_fall[now] * s.dt_s[now])[:, None, None], out=A[:, 6:, SPEED])
        for rows, moved, by_gyro, by_accel in ((slice(3, 6), dv, s.v_bg, s.v_ba), (slice(6, 9), dp, s.p_bg, s.p_ba)):
            A[:, rows, ROTATION] = se3.skew(moved)
            np.negative(by_gyro[now], out=A[:, rows, GYRO_BIAS])
            np.negative(by_accel[now], out=A[:, rows, ACCEL_BIAS])
        A[:, 6:, SHIFT] = -np.eye(3)
        A[:, 6:, NEXT_SHIFT] = R_ij
        np.negative(e, out=A[:, :, RIGHT])

    def _anchor_residuals(self, state: ChainState) -> tuple[Array, Array, Array]:
        """Whitened residuals of the first frame's pose, velocity and biases."""
        anchor = self.anchor
        R0, p0 = anchor.T_world_body[:3, :3], anchor.T_world_body[:3, 3]
        xi = np.r_[se3.so3_log(R0.T @ state.R[0]), R0.T @ (state.p[0] - p0)]
        bias = np.r_[state.accel_bias[0], state.gyro_bias[0]] - anchor.bias.vector()
        return (np.linalg.inv(np.linalg.cholesky(anchor.pose_cov)) @ xi,
                (state.v[0] - anchor.velocity_m_s) / anchor.velocity_sd, bias / anchor.bias_sd)

    def _add_anchor(self, system: ChainSystem, state: ChainState) -> None:
        pose, velocity, bias = self._anchor_residuals(state)
        A = np.zeros((15, DIM))
        R = self.anchor.T_world_body[:3, :3].T @ state.R[0]
        turn, zero = se3.so3_right_jacobian_inverse(se3.so3_log(R)), np.zeros((3, 3))
        A[:6, POSE] = np.linalg.inv(np.linalg.cholesky(self.anchor.pose_cov)) @ np.block([[turn, zero], [zero, R]])
        A[6:9, VELOCITY] = np.eye(3) / self.anchor.velocity_sd
        A[9:, BIAS] = np.diag(1 / self.anchor.bias_sd)
        system.add_prior(0, A.T @ A, -A.T @ np.concatenate([pose, velocity, bias]))

    def _add_scale(self, system: ChainSystem, state: ChainState) -> None:
        if self.scale is None:  # nobody asks for it: any positive information will do
            system.add_everywhere(0, 1.0)
            return
        walk = self.scale
        prior, gradient = np.zeros((DIM, DIM)), np.zeros(DIM)
        prior[0, 0] = walk.log_sd**-2
        gradient[0] = (walk.log_mean - state.log_scale[0]) * walk.log_sd**-2
        system.add_prior(0, prior, gradient)
        information, wanted = np.full((self.nodes - 1, 1), TIE_INFORMATION), np.zeros((self.nodes - 1, 1))
        meeting = np.flatnonzero(np.diff(walk.of_node))
        information[meeting, 0], wanted[meeting, 0] = walk.step_sd**-2, -np.diff(state.log_scale)
        system.add_links(SCALE, information, wanted)


class MotionRows:
    """The motions that the band holds, as whitened rows with the weights of their loss.

    Args:
        state: where they are linearised.
        term: the motions.
        near: those that the band holds.
    """

    def __init__(self, state: ChainState, term: MotionTerm, near: Indices) -> None:
        self.state, self.term, self._log_scale = state, term, term.log_scale(state)
        i, j = term.motions.i[near], term.motions.j[near]
        groups = [near[group] for group in _groups(i, j)]
        self.groups = [group[np.argsort(term.motions.i[group], kind="stable")] for group in groups]
        """Motions by first frame, no frame twice a first or twice a second one within a group."""
        self._first = [term.motions.i[group] for group in self.groups]

    def write(self, group: int, first: int, last: int, rows: Array) -> None:
        """Write those of a group that start at frames `first` to `last` (exclusive) into those frames' rows."""
        begin, end = np.searchsorted(self._first[group], [first, last])
        at = self._first[group][begin:end] - first
        self._write(self.groups[group][begin:end], rows, slice(0, len(at)) if len(at) == last - first else at)

    def _write(self, n: Indices, rows: Array, at: slice | Indices) -> None:
        if len(n) < len(rows):
            rows[:, :MOTION_ROWS] = 0.0
        if len(n) == 0:
            return
        which = slice(int(n[0]), int(n[-1]) + 1) if (np.diff(n) == 1).all() else n
        blocks = self.term.blocks(self.state, which, self._log_scale)
        root = np.sqrt(self.term.losses(blocks.squared_norm, which)[1])[:, None, None]
        for columns, source in ((SCALE, slice(0, 1)), (POSE, slice(1, 7)), (NEXT_POSE, slice(7, 13)),
                                (slice(RIGHT, RIGHT + 1), slice(13, 14))):
            if columns != SCALE or self.term.segment is not None:
                rows[at, :MOTION_ROWS, columns] = blocks.columns[:, :, source] * root

    def add(self, system: ChainSystem) -> None:
        """Add all to a system."""
        motions = self.term.motions
        for group in self.groups:
            for first, last in spans(len(group), BLOCK_NODES):
                n = group[first:last]
                rows = np.zeros((len(n), MOTION_ROWS, RIGHT + 1))
                self._write(n, rows, slice(0, len(n)))
                system.add(motions.i[n], motions.j[n], rows)


def far_factors(state: ChainState, term: MotionTerm, far: Indices) -> FarFactors:
    """The motions `far` with the weights of their loss, as factors outside the band."""
    blocks = term.blocks(state, far, term.log_scale(state))
    root = np.sqrt(term.losses(blocks.squared_norm, far)[1])[:, None]
    A_i, A_j = (np.zeros((len(far), 6, JOINED)) for _ in range(2))
    A_i[:, :, 1:], A_j[:, :, 1:] = blocks.A_i, blocks.A_j
    if term.segment is not None:
        A_i[:, :, :1] = blocks.A_s
    return FarFactors(term.motions.i[far], term.motions.j[far], A_i * root[:, :, None], A_j * root[:, :, None],
                      blocks.b * root)


def _groups(i: Indices, j: Indices) -> list[Indices]:
    """Motions so that no frame is twice a first or twice a second one within a group."""
    rank = _occurrence(i) * (len(i) + 1) + _occurrence(j)
    return [np.flatnonzero(rank == value) for value in np.unique(rank)]


def _occurrence(values: Indices) -> Indices:
    """(N,) how many equal values stand before each."""
    order = np.argsort(values, kind="stable")
    ordered = values[order]
    begin = np.flatnonzero(np.diff(ordered, prepend=ordered[:1] - 1))
    out = np.empty(len(values), np.int64)
    out[order] = np.arange(len(values)) - np.repeat(begin, np.diff(np.append(begin, len(values))))
    return out


def _times(A: Array, x: Array) -> Array:
    """Matrices (B, n, m) times vectors (B, m)."""
    return np.asarray((A @ x[:, :, None])[:, :, 0])
