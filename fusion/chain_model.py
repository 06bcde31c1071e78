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

from fusion.chain import BIAS, BLOCK_NODES, DIM, POSE, SCALE, SCALE_AND_POSE, VELOCITY, ChainSystem, Nodes, spans
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
FIRST, SECOND = slice(1, 16), slice(1, 10)
"""Unknowns of its two frames that an inertial step speaks of."""
ROTATION, SHIFT, SPEED, ACCEL_BIAS, GYRO_BIAS = (slice(k, k + 3) for k in range(0, 15, 3))
"""Columns within those."""


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
            total += 0.5 * float((self._residuals(state, first, last)[0] ** 2).sum())
        walked = np.concatenate([np.diff(state.accel_bias, axis=0), np.diff(state.gyro_bias, axis=0)], axis=1)
        total += 0.5 * float(((walked / self.steps.bias_walk_sd) ** 2).sum())
        if self.scale is not None:
            total += 0.5 * float(((state.log_scale[0] - self.scale.log_mean) / self.scale.log_sd) ** 2)
            total += 0.5 * float(((np.diff(state.log_scale) / self.scale.step_sd) ** 2).sum())
        return total

    def linearize(self, state: ChainState, term: MotionTerm, memory: ChainSystem | None = None) -> ChainSystem:
        """Normal equations of all factors and the motions at `state`, in the memory of an earlier one if given."""
        span = term.motions.j - term.motions.i
        far = np.flatnonzero(span > LONGEST_REACH)
        reach = int(span.max(initial=1, where=span <= LONGEST_REACH))
        system = memory or ChainSystem(self.nodes, reach)
        if memory is not None:
            memory.clear()
        for first, last in spans(len(self.steps), BLOCK_NODES):
            A_i, A_j, b = self._inertial(state, first, last)
            system.add(*_pair(first, last, reach), (FIRST, A_i), (SECOND, A_j), b)
        bias = np.concatenate([state.accel_bias, state.gyro_bias], axis=1)
        system.add_links(BIAS, self.steps.bias_walk_sd**-2, -np.diff(bias, axis=0))
        self._add_anchor(system, state)
        self._add_scale(system, state)
        near = None if len(far) == 0 else np.flatnonzero(span <= LONGEST_REACH)
        add_motions(system, state, term, near)
        if len(far):
            system.far = far_factors(state, term, far)
        return system

    def _residuals(self, state: ChainState, first: int, last: int) -> tuple[Array, Array, Array, Array, Array]:
        """Whitened residuals (B, 9), and what their derivatives need."""
        s = self.steps
        now, then = slice(first, last), slice(first + 1, last + 1)
        R_t = np.swapaxes(state.R[now], 1, 2)
        R_ij = R_t @ state.R[then]
        dt, c = s.dt_s[now, None], s.free_fall[now, None]
        gyro, accel = state.gyro_bias[now] - s.gyro_bias, state.accel_bias[now] - s.accel_bias
        e_R = se3.so3_log(np.swapaxes(s.R[now] @ se3.so3_exp(_times(s.R_bg[now], gyro)), 1, 2) @ R_ij)
        dv = _times(R_t, state.v[then] - state.v[now] - c * dt * GRAVITY_WORLD)
        dp = _times(R_t, state.p[then] - state.p[now] - c * (dt * state.v[now] + 0.5 * dt**2 * GRAVITY_WORLD))
        e_v = dv - s.v[now] - _times(s.v_bg[now], gyro) - _times(s.v_ba[now], accel)
        e_p = dp - s.p[now] - _times(s.p_bg[now], gyro) - _times(s.p_ba[now], accel)
        r = _times(s.whiten[now], np.concatenate([e_R, e_v, e_p], axis=1))
        return r, e_R, R_ij, dv, dp

    def _inertial(self, state: ChainState, first: int, last: int) -> tuple[Array, Array, Array]:
        """Whitened Jacobians (B, 9, 15), (B, 9, 9) at the two frames, and right-hand side (B, 9)."""
        s, now = self.steps, slice(first, last)
        r, e_R, R_ij, dv, dp = self._residuals(state, first, last)
        R_t = np.swapaxes(state.R[now], 1, 2)
        J = se3.so3_right_jacobian_inverse(e_R)
        A_i, A_j = np.zeros((last - first, 9, 15)), np.zeros((last - first, 9, 9))
        A_i[:, :3, ROTATION] = -J @ np.swapaxes(R_ij, 1, 2)
        A_i[:, :3, GYRO_BIAS] = -J @ np.swapaxes(se3.so3_exp(e_R), 1, 2) @ s.R_bg[now]
        A_j[:, :3, ROTATION] = J
        A_i[:, 3:6, ROTATION] = se3.skew(dv)
        A_i[:, 3:6, SPEED] = -R_t
        A_i[:, 3:6, ACCEL_BIAS], A_i[:, 3:6, GYRO_BIAS] = -s.v_ba[now], -s.v_bg[now]
        A_j[:, 3:6, SPEED] = R_t
        A_i[:, 6:, ROTATION] = se3.skew(dp)
        A_i[:, 6:, SHIFT] = -np.eye(3)
        A_i[:, 6:, SPEED] = -R_t * (s.free_fall * s.dt_s)[now, None, None]
        A_i[:, 6:, ACCEL_BIAS], A_i[:, 6:, GYRO_BIAS] = -s.p_ba[now], -s.p_bg[now]
        A_j[:, 6:, SHIFT] = R_ij
        W = s.whiten[now]
        return W @ A_i, W @ A_j, -r

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


def add_motions(system: ChainSystem, state: ChainState, term: MotionTerm, near: Indices | None = None) -> None:
    """Add the relative motions, all or the `near` ones, with the weights of their loss."""
    motions, log_scale = term.motions, term.log_scale(state)
    groups = _groups(motions.i, motions.j) if near is None else \
        [near[group] for group in _groups(motions.i[near], motions.j[near])]
    for group in groups:
        for first, last in spans(len(group), BLOCK_NODES):
            n = group[first:last]
            which = slice(int(n[0]), int(n[-1]) + 1) if n[-1] - n[0] == len(n) - 1 else n
            blocks = term.blocks(state, which, log_scale)
            root = np.sqrt(term.losses(blocks.squared_norm, which)[1])[:, None]
            A_i, rows = blocks.A_i, POSE
            if term.segment is not None:
                A_i, rows = np.concatenate([blocks.A_s, A_i], axis=2), SCALE_AND_POSE
            i, j = _ends(motions.i[which], motions.j[which], system.reach)
            system.add(i, j, (rows, A_i * root[:, :, None]), (POSE, blocks.A_j * root[:, :, None]), blocks.b * root)


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


def _ends(i: Indices, j: Indices, reach: int) -> tuple[Nodes, Nodes]:
    """Frames of motions, as slices where these join one neighbour after the other."""
    neighbours = (j - i == 1).all() and (np.diff(i) == 1).all()
    return _pair(int(i[0]), int(j[-1]), reach) if neighbours else (i, j)


def _pair(first: int, last: int, reach: int) -> tuple[Nodes, Nodes]:
    """Frames `first` to `last` (exclusive) and their successors, as slices where frames make no blocks."""
    if reach == 1:
        return slice(first, last), slice(first + 1, last + 1)
    return np.arange(first, last), np.arange(first + 1, last + 1)


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
