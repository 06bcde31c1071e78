"""`summary.json`: the conclusions of a refinement as plain values, and the accuracy when truth is known."""

from __future__ import annotations

from typing import Any

from fusion.result import Refinement
from vio import se3
from vio.alignment import associate
from vio.metrics import accuracy_table
from vio.paper_metrics import paper_motion_metrics
from vio.trajectory import Trajectory

SCHEMA = 1


def summarize(refinement: Refinement) -> dict[str, Any]:
    """The summary of the contract (schema 1); `accuracy` and `paper_metrics` only where truth is known."""
    r = refinement
    summary: dict[str, Any] = {
        "schema": SCHEMA,
        "name": r.name,
        "estimator": r.estimator,
        "fallback_reason": r.fallback_reason,
        "frames": len(r.trajectory),
        "duration_s": float(r.trajectory.t_s[-1] - r.trajectory.t_s[0]),
        "path_length_m": r.trajectory.path_length_m,
        "scale": {"policy": r.scale.policy, "log_mean": r.scale.log_mean, "log_sd": r.scale.log_sd,
                  "reason": r.scale.reason},
        "imu": {"chi2_per_dof": r.imu.chi2_per_dof, "inflation": r.imu.inflation,
                "gyro_bias_rad_s": r.gyro_bias_rad_s.mean(axis=0).tolist(),
                "accel_bias_m_s2": r.accel_bias_m_s2.mean(axis=0).tolist(),
                "gaps": [{"start_s": g.start_s, "end_s": g.end_s} for g in r.imu.gaps]},
        "camera_imu": r.camera_imu.to_dict(),
        "motions": {"used": r.motions_used, "rejected": len(r.rejected), "bridged": r.bridged,
                    "rotation_noise": r.motion_noise[0], "translation_noise": r.motion_noise[1]},
        "loops": {"proposed": 0, "accepted": 0},
        "time_offset_s": r.time_offset_s,
        "timing_s": r.timing_s,
        "peak_rss_bytes": r.peak_rss_bytes,
    }
    if r.truth is not None and len(r.truth) >= 2:
        summary |= accuracy_of({"refined": r.trajectory, "motions": r.motions_only}, r.truth)
    return summary


def accuracy_of(estimates: dict[str, Trajectory], truth: Trajectory) -> dict[str, Any]:
    """Accuracy under every alignment and the paper's per-step metrics, of the BODY's poses, on the same frames."""
    return {
        "accuracy": {name: accuracy_table(estimate, truth) for name, estimate in estimates.items()},
        "paper_metrics": {name: _paper_metrics(estimate, truth) for name, estimate in estimates.items()},
    }


def _paper_metrics(estimate: Trajectory, truth: Trajectory) -> dict[str, Any]:
    matched, reference = associate(estimate, truth)
    steps = [se3.inverse(t.T_world_body[:-1]) @ t.T_world_body[1:] for t in (matched, reference)]
    return dict(paper_motion_metrics(steps[0], steps[1]))
