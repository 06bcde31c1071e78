"""How camera and IMU sit to each other, measured: the gyro's rotations against those of the motions.

With ΔR_b(τ, b) the gyro's rotation between two frames, read τ later than calibrated and freed of a bias b, a motion's
rotation R_m in camera axes, and R_bc the calibrated rotation of the camera in the body, the residual is

    e = Log(R_mᵀ · Exp(-δ) R_bcᵀ ΔR_b R_bc Exp(δ))

and δ, τ and b minimise its robust sum: Gauss-Newton with Cauchy weights. What is left also says by how much the
motions' claimed rotation noise is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.problem import Problem
from vio import se3
from vio.errors import ImuError
from vio.imu import gyro_rotations

Array = NDArray[np.float64]

LEAST_PAIRS = 50
MOST_PAIRS = 9000
SHAKEN = 3.0
"""Inflation of the gyro above which an interval is left out."""
ITERATIONS, SETTLED = 8, 1e-4
"""At most, and the squared step in standard deviations after which none follows."""
PRIOR_SD = np.array([0.5, 0.5, 0.5, 0.1])
"""Of δ [rad] and of τ about its start [s]: keeps a capsule that does not turn from any conclusion."""
CAUCHY = 3.0
MEDIAN_CHI2_3 = 2.366
SEARCHED_S, SEARCH_STEP_S = 3.0, 0.02
SEARCHED_AT_ONCE = 50_000
"""Turns that are interpolated at a time."""
AROUND_S = 10.0
"""Samples that are looked at before and after the compared motions: more than any offset that can be found."""
CLEAR_CORRELATION, BETTER_CORRELATION = 0.6, 0.1
"""That another offset must reach, and by which it must beat the calibrated one, before the fit starts from it."""
SIGNIFICANT_TURN, SIGNIFICANT_OFFSET, SIGNIFICANT_JUMP = 8.0, 6.0, 8.0
"""Standard deviations from the calibration at which a correction is applied, and between stretches at which a clock
jumps. A network's rotations err alike for longer than any block: on 38 rendered recordings turns that were none came
out up to 6.4 of them, offsets up to 4.9."""
BLOCK_PAIRS, FEWEST_BLOCKS = 10, 12
"""Consecutive pairs whose errors may hang together, and into how many such the pairs are divided at least."""
STRETCH_PAIRS, MOST_STRETCHES = 100, 24
LEAST_JUMP_S = 0.03
KNOWN_OFFSET_S = 0.01
"""Sd above which an offset is not known well enough to be applied."""
LEAST_ROTATION_RAD, LEAST_OFFSET_S = float(np.deg2rad(0.3)), 0.002
"""Corrections below are within what any calibration leaves."""


@dataclass(frozen=True)
class CameraImu:
    """Corrections that the data ask for, and what was done about them."""

    pairs: int
    """Motions that were compared; 0 where there were too few."""
    rotation_rad: Array
    """(3,) δ in camera axes: `T_body_camera · Exp(δ)` fits better."""
    rotation_sd_rad: Array
    """(3,)"""
    time_offset_s: float
    """τ, to be added to the calibrated time offset."""
    time_offset_sd_s: float
    rotation_noise: float
    """The motions' real rotation noise over the claimed one."""
    applied: bool = False
    reason: str = "too few motions to compare with the gyro"

    @property
    def rotation_significant(self) -> bool:
        """Whether the rotation is wrong beyond doubt, and by enough to matter."""
        z = np.abs(self.rotation_rad) / self.rotation_sd_rad
        return bool(z.max() > SIGNIFICANT_TURN and np.linalg.norm(self.rotation_rad) > LEAST_ROTATION_RAD)

    @property
    def offset_significant(self) -> bool:
        """Whether the clocks disagree beyond doubt, and by enough to matter."""
        clear = abs(self.time_offset_s) > max(SIGNIFICANT_OFFSET * self.time_offset_sd_s, LEAST_OFFSET_S)
        return clear and self.time_offset_sd_s < KNOWN_OFFSET_S


    def to_dict(self) -> dict[str, Any]:
        """Plain values for `summary.json`; null where nothing was compared."""
        known = self.pairs > 0
        return {"pairs": self.pairs, "rotation_rad": self.rotation_rad.tolist() if known else None,
                "rotation_sd_rad": self.rotation_sd_rad.tolist() if known else None,
                "time_offset_s": self.time_offset_s if known else None,
                "time_offset_sd_s": self.time_offset_sd_s if known else None,
                "applied": self.applied, "reason": self.reason}


def read_camera_imu(values: dict[str, Any], rotation_noise: float) -> CameraImu:
    """What `to_dict` wrote.

    Raises:
        KeyError: a key is missing.
        ValueError: a number is none.
    """
    if not values["pairs"]:
        return replace(UNKNOWN, reason=str(values["reason"]))
    rotation, sd = (np.asarray(values[key], float) for key in ("rotation_rad", "rotation_sd_rad"))
    if rotation.shape != (3,) or sd.shape != (3,):
        raise ValueError("camera_imu holds no rotation of three numbers")
    return CameraImu(int(values["pairs"]), rotation, sd, float(values["time_offset_s"]),
                     float(values["time_offset_sd_s"]), rotation_noise, bool(values["applied"]), str(values["reason"]))


UNKNOWN = CameraImu(0, np.zeros(3), np.full(3, np.inf), 0.0, np.inf, 1.0)


@dataclass(frozen=True)
class Pairs:
    """K neighbouring motions beside the gyro."""

    node: NDArray[np.int64]
    """(K,) first frame."""
    R: Array
    """(K, 3, 3) measured, camera axes."""
    whiten: Array
    """(K, 3, 3) inverse Cholesky factor of the claimed rotation covariance."""
    gyro: Array
    """(K, 3, 3) the gyro's rotation of the body, bias left in."""

    def __len__(self) -> int:
        return len(self.node)


def compared_pairs(problem: Problem, most: int = MOST_PAIRS, where: float = 0.5) -> Pairs:
    """The surest motions between neighbouring frames where the gyro can be believed.

    Args:
        problem: of M nodes.
        most: consecutive ones that are taken.
        where: of those there are, 0 the first, 1 the last.
    """
    return _pairs_at(problem, *_comparable(problem), most, where)


def _comparable(problem: Problem) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The surest motion from every node (M-1,), and the nodes (K,) where it can be compared."""
    surest = problem.motions.surest_neighbours(len(problem))
    calm = problem.imu_usable & (problem.gyro_inflation < SHAKEN)
    return surest, np.flatnonzero((surest >= 0) & calm)


def _pairs_at(problem: Problem, surest: NDArray[np.int64], node: NDArray[np.int64], most: int, where: float) -> Pairs:
    begin = int(where * max(len(node) - most, 0))
    node = node[begin : begin + most]
    chosen = surest[node]
    gyro = np.zeros((0, 3, 3))
    if len(node):
        gyro = _gyro(problem, node, 0.0, np.zeros(3))
    return Pairs(node, problem.motions.R[chosen], problem.motions.whiten[chosen, :3, :3], gyro)


def _gyro(problem: Problem, node: NDArray[np.int64], shift_s: float, bias: Array) -> Array:
    """(K, 3, 3) the gyro's rotations from the frames compared to their next, read `shift_s` later, less a bias."""
    frames = problem.t_s[node[0] : node[-1] + 2] + shift_s
    t = problem.imu_t_s
    inside = slice(max(int(np.searchsorted(t, frames[0])) - 2, 0), int(np.searchsorted(t, frames[-1])) + 2)
    samples = problem.samples
    cut = type(samples)(samples.t_ns[inside], samples.gyro_rad_s[inside], samples.accel_m_s2[inside])
    # A shift may leave the log: what is beyond it turns by nothing, and counts as outliers.
    reach = np.clip(frames, t[0], t[-1]) + 1e-8 * np.arange(len(frames))
    rotations: Array = gyro_rotations(cut, t[inside], reach, bias)[node - node[0]]
    return rotations


def measure_camera_imu(problem: Problem, pairs: Pairs) -> CameraImu:
    """Rotation and time offset between camera and IMU from the gyro; `UNKNOWN` where too few motions compare."""
    if len(pairs) < LEAST_PAIRS:
        return UNKNOWN
    problem = _around(problem, pairs)
    R_bc = problem.motions.T_body_camera[:3, :3]
    start, delta, bias = _search_offset(problem, pairs), np.zeros(3), problem.gyro_bias_rad_s
    tau, prior = start, np.diag(np.concatenate([PRIOR_SD, np.full(3, np.inf)]) ** -2)
    for _ in range(ITERATIONS):
        J, e = _linearised(problem, pairs, R_bc @ se3.so3_exp(delta), tau, bias)
        squared = (e**2).sum(axis=1)
        spread2 = max(float(np.median(squared)) / MEDIAN_CHI2_3, 1e-12)
        weight = 1 / (1 + squared / (CAUCHY**2 * spread2))
        H = np.einsum("nki,n,nkj->ij", J, weight, J) + spread2 * prior
        off = np.concatenate([delta, [tau - start], np.zeros(3)])
        gradient = np.einsum("nki,n,nk->i", J, weight, e) + spread2 * prior @ off
        step = -np.linalg.solve(H, gradient)
        delta, tau, bias = delta + step[:3], tau + float(step[3]), bias + step[4:]
        if -float(step @ gradient) < SETTLED * spread2:
            break
    sd = np.sqrt(np.maximum(_variances(np.linalg.inv(H), np.einsum("nki,n,nk->ni", J, weight, e), spread2), 1e-16))
    return CameraImu(len(pairs), delta, sd[:3], tau, float(sd[3]), float(np.sqrt(spread2)), False,
                     "within its uncertainty of the calibration")


def _variances(inverse: Array, pulls: Array, spread2: float) -> Array:
    """(7,) of a fit whose pairs pull (K, 7) at it: what independent errors of one size would leave, or, where larger,
    what the pulls of consecutive pairs together show (Liang and Zeger, Biometrika 73, 1986)."""
    block = int(np.clip(len(pulls) // FEWEST_BLOCKS, 1, BLOCK_PAIRS))
    together = np.add.reduceat(pulls, np.arange(0, len(pulls), block), axis=0)
    shown = np.einsum("ij,bj->bi", inverse, together)
    return np.asarray(np.maximum(np.diag(inverse) * spread2, (shown**2).sum(axis=0)))


def _around(problem: Problem, pairs: Pairs) -> Problem:
    """The problem with the inertial samples near the pairs alone: a whole examination has a million."""
    ends = problem.t_s[pairs.node[[0, -1]] + [0, 1]] + [-AROUND_S, AROUND_S]
    near = slice(*np.searchsorted(problem.imu_t_s, ends))
    samples = problem.samples
    cut = type(samples)(samples.t_ns[near], samples.gyro_rad_s[near], samples.accel_m_s2[near])
    return replace(problem, samples=cut, imu_t_s=problem.imu_t_s[near])


def check_clock(problem: Problem) -> None:
    """Refuse a clock that jumps: stretches of the recording that ask for time offsets far from each other.

    Raises:
        ImuError: naming the jump and between which times it lies.
    """
    surest, node = _comparable(problem)
    stretches = min(MOST_STRETCHES, len(node) // STRETCH_PAIRS)
    before: tuple[float, CameraImu] | None = None
    for k in range(stretches):
        pairs = _pairs_at(problem, surest, node, STRETCH_PAIRS, k / max(stretches - 1, 1))
        found = measure_camera_imu(problem, pairs)
        if found.pairs == 0 or not found.time_offset_sd_s < KNOWN_OFFSET_S:
            continue
        middle = float(problem.t_s[pairs.node[len(pairs) // 2]])
        if before is not None:
            jump = found.time_offset_s - before[1].time_offset_s
            sd = float(np.hypot(found.time_offset_sd_s, before[1].time_offset_sd_s))
            if abs(jump) > max(SIGNIFICANT_JUMP * sd, LEAST_JUMP_S):
                raise ImuError(f"imu: its clock jumps by {1e3 * jump:+.0f} ms (sd {1e3 * sd:.0f}) against the camera's "
                               f"between {before[0]:.0f} and {middle:.0f} s; mend the stamps, or cut there")
        before = middle, found


def _linearised(problem: Problem, pairs: Pairs, R_bc: Array, tau: float, bias: Array) -> tuple[Array, Array]:
    """Whitened Jacobian (K, 3, 7) by δ, τ and b, and residual (K, 3)."""
    gyro = _gyro(problem, pairs.node, tau, bias)
    predicted = R_bc.T @ gyro @ R_bc
    e = se3.so3_log(np.swapaxes(pairs.R, 1, 2) @ predicted)
    rate_i, rate_j = (_rates(problem, problem.t_s[pairs.node + k] + tau) - bias for k in (0, 1))
    J = np.empty((len(pairs), 3, 7))
    J[:, :, :3] = np.eye(3) - np.swapaxes(predicted, 1, 2)
    J[:, :, 3] = (rate_j - (np.swapaxes(gyro, 1, 2) @ rate_i[:, :, None])[:, :, 0]) @ R_bc
    J[:, :, 4:] = -R_bc.T * problem.dt_s[pairs.node, None, None]
    J = se3.so3_right_jacobian_inverse(e) @ J
    return pairs.whiten @ J, (pairs.whiten @ e[:, :, None])[:, :, 0]


def _rates(problem: Problem, t_s: Array) -> Array:
    gyro = problem.samples.gyro_rad_s
    return np.column_stack([np.interp(t_s, problem.imu_t_s, gyro[:, axis]) for axis in range(3)])


def _search_offset(problem: Problem, pairs: Pairs) -> float:
    """The shift whose speeds of turning agree best, which needs no extrinsics; 0 unless another is clearly better."""
    t, gyro = problem.imu_t_s, problem.samples.gyro_rad_s - problem.gyro_bias_rad_s
    speed = np.linalg.norm(gyro, axis=1)
    turned = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(t))])
    seen = np.linalg.norm(se3.so3_log(pairs.R), axis=1)
    seen = np.minimum(seen, 5 * np.median(seen))
    shifts = np.round(np.arange(-SEARCHED_S, SEARCHED_S + 1e-9, SEARCH_STEP_S), 6)
    parts = np.array_split(shifts[:, None], -(-len(seen) * len(shifts) // SEARCHED_AT_ONCE))
    first, next_ = problem.t_s[pairs.node], problem.t_s[pairs.node + 1]
    score = np.concatenate([_correlations(seen, np.interp(next_ + some, t, turned) - np.interp(first + some, t, turned))
                            for some in parts])
    best = int(np.argmax(score))
    calibrated = float(score[np.argmin(np.abs(shifts))])
    clear = score[best] > max(calibrated + BETTER_CORRELATION, CLEAR_CORRELATION)
    return float(shifts[best]) if clear else 0.0


def _correlations(a: Array, b: Array) -> Array:
    """(S,) of one signal (K,) with others (S, K)."""
    a, b = a - a.mean(), b - b.mean(axis=1, keepdims=True)
    size = np.linalg.norm(a) * np.sqrt(np.einsum("sk,sk->s", b, b))
    return np.asarray(b @ a / np.maximum(size, 1e-30))
