"""The paper's metrics of one test sequence, and what each of them was aligned by.

Depth: every image by one factor, median truth over median prediction, as the published codes of the four methods do.
Adjacent-frame motion: every sequence by one factor, least squares over its steps. Trajectory: Sim(3). A network that
never saw a length cannot be judged without; the paper does not say what it did.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from learned.errors import BenchmarkError
from learned.inference import SIGNALS
from learned.measured import Measured
from vio import se3
from vio.errors import DegenerateAlignmentError
from vio.metrics import ate, rpe
from vio.paper_metrics import paper_depth_metrics, paper_motion_metrics
from vio.trajectory import Trajectory

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Scores: TypeAlias = dict[str, float | None]
"""Value by `Metric.key`; None where the sequence does not determine it."""

MM = 1e3
PER_IMAGE, PER_SEQUENCE, SIM3 = "one median scale per image", "one least-squares scale per sequence", "Sim(3)"


@dataclass(frozen=True)
class Metric:
    """One column of a table."""

    key: str
    label: str
    alignment: str
    digits: int
    higher_is_better: bool = False


METRICS = (
    Metric("abs_diff_mm", "AbsDiff [mm]", PER_IMAGE, 3), Metric("abs_rel", "AbsRel", PER_IMAGE, 4),
    Metric("sq_rel_mm", "SqRel [mm]", PER_IMAGE, 3), Metric("rmse_mm", "RMSE [mm]", PER_IMAGE, 3),
    Metric("log_rmse", "logRMSE", PER_IMAGE, 4), Metric("acc_percent", "Acc [%]", PER_IMAGE, 2, True),
    Metric("ate_paper_mm", "ATE, paper's [mm]", PER_SEQUENCE, 3), Metric("abs_diff_t_mm", "AbsDiff_t [mm]",
                                                                         PER_SEQUENCE, 3),
    Metric("abs_rel_t", "AbsRel_t", PER_SEQUENCE, 3), Metric("are_paper_deg", "ARE [°]", PER_SEQUENCE, 3),
    Metric("abs_diff_r_deg", "AbsDiff_r [°]", PER_SEQUENCE, 3), Metric("abs_rel_r", "AbsRel_r", PER_SEQUENCE, 3),
    Metric("ate_sim3_mm", "ATE, trajectory [mm]", SIM3, 3), Metric("t_error_mm", "t-error [mm]", PER_SEQUENCE, 3),
    Metric("r_error_deg", "r-error [°]", PER_SEQUENCE, 3),
)
"""Six of depth; the paper's six of adjacent-frame motion (its "ATE" is the mean error of the step); the rmse of the
trajectory (`vio.metrics.ate`) and of its steps (`vio.metrics.rpe`)."""
HEADLINES = ("abs_rel", "acc_percent", "ate_paper_mm", "are_paper_deg")
"""What verdicts are about."""


def scores(measured: Measured, usable: Bools) -> Scores:
    """All metrics of one sequence.

    Args:
        measured: predictions beside truth.
        usable: (H, W) pixels to compare, found on the uncorrupted images.

    Raises:
        BenchmarkError: the sequence has no true depth.
        TrajectoryError: predicted depth that is not positive and finite.
    """
    return _depth(measured, usable) | _steps(measured) | _trajectory(measured)


def guess(measured: Measured) -> Measured:
    """What needs no network: the same depth everywhere, and rest."""
    return replace(measured, depth=np.ones_like(measured.depth),
                   T_i_j=np.broadcast_to(np.eye(4), measured.T_i_j.shape).copy())


def mean_log_snr(measured: Measured) -> float:
    """Mean over the pairs of the logarithm of the SNR that the vibration spoke for; 0 without one."""
    return float(measured.signals[:, SIGNALS.index("snr")].mean())


def step_scale_m(measured: Measured) -> float:
    """Metres per motion unit: least squares over the steps, not below zero; 0 for a guess of rest."""
    found, true = measured.T_i_j[:, :3, 3], measured.T_true_m[:, :3, 3]
    return float(max((found * true).sum() / max((found * found).sum(), 1e-12), 0.0))


def _depth(measured: Measured, usable: Bools) -> Scores:
    if measured.depth_true_m is None:
        raise BenchmarkError(f"benchmark: {measured.name} has no true depth for some frame; render it again, "
                             "with depth")
    valid = (measured.depth_true_m > 0) & usable & (measured.depth > 0)
    kept = valid.any(axis=(1, 2))
    if not kept.any():
        raise BenchmarkError(f"benchmark: {measured.name} has no pixel with true and predicted depth; look at its "
                             "depth images")
    found = paper_depth_metrics(measured.depth[kept], measured.depth_true_m[kept], valid[kept], median_scaling=True)
    return {"abs_diff_mm": MM * found["abs_diff"], "abs_rel": found["abs_rel"], "sq_rel_mm": MM * found["sq_rel"],
            "rmse_mm": MM * found["rmse"], "log_rmse": found["log_rmse"], "acc_percent": 100 * found["acc_1_25"]}


def _scaled(measured: Measured) -> Array:
    T = measured.T_i_j.copy()
    T[:, :3, 3] *= step_scale_m(measured)
    return T


def _steps(measured: Measured) -> Scores:
    found = paper_motion_metrics(_scaled(measured), measured.T_true_m)
    return {"ate_paper_mm": MM * found["ate_paper"], "abs_diff_t_mm": MM * found["abs_diff_t"],
            "abs_rel_t": found["abs_rel_t"], "are_paper_deg": float(np.degrees(found["are_paper"])),
            "abs_diff_r_deg": float(np.degrees(found["abs_diff_r"])), "abs_rel_r": found["abs_rel_r"]}


def _trajectory(measured: Measured) -> Scores:
    t_s = np.concatenate([[0.0], np.cumsum(measured.step_s)])
    found = Trajectory(t_s, se3.chain(_scaled(measured)))
    true = Trajectory(t_s, se3.chain(measured.T_true_m))
    steps = rpe(found, true)
    whole: float | None
    try:
        whole = MM * ate(Trajectory(t_s, se3.chain(measured.T_i_j)), true, "sim3").rmse_m
    except DegenerateAlignmentError:  # straight, motionless, or too short: there is no such number
        whole = None
    return {"ate_sim3_mm": whole, "t_error_mm": MM * steps.rmse_m,
            "r_error_deg": float(np.degrees(steps.rotation_rmse_rad))}
