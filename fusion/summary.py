"""`summary.json`: the conclusions of a refinement as plain values, and the accuracy when truth is known."""

from __future__ import annotations

from typing import Any

import numpy as np

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
                "gaps": [{"start_s": g.start_s, "end_s": g.end_s} for g in r.imu.gaps],
                "bias_steps": [step.to_dict() for step in r.imu.bias_steps],
                "bias_wanders": [wander.to_dict() for wander in r.imu.bias_wanders]},
        "camera_imu": r.camera_imu.to_dict(),
        "motions": {"used": r.motions_used, "rejected": len(r.rejected), "bridged": r.bridged,
                    "rotation_noise": r.motion_noise[0], "translation_noise": r.motion_noise[1]},
        "rest": {"stretches": len(r.rest.span),
                 "duration_s": float(np.diff(r.trajectory.t_s[r.rest.span], axis=1).sum())},
        "loops": {"proposed": r.loops.proposed, "accepted": int(r.loops.accepted.sum()),
                  "refused": dict(sorted(r.loops.refused.items()))},
        "time_offset_s": r.time_offset_s,
        "timing_s": r.timing_s,
        "peak_rss_bytes": r.peak_rss_bytes,
    }
    estimates = {"refined": r.trajectory, "motions": r.motions_only}
    if r.online is not None:
        summary["online"] = {"lag_s": r.online.lag_s, "latency_ms": r.online.latency_ms, "resets": r.online.resets}
        estimates["filtered"] = r.online.filtered
    if r.truth is not None and len(r.truth) >= 2:
        summary |= accuracy_of(estimates, r.truth)
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


def sentences(summary: dict[str, Any]) -> str:
    """A summary in a few lines for a terminal."""
    from fusion.compare_text import verdict

    scale, fallback = summary["scale"], summary["fallback_reason"]
    lines = [
        f"estimator: {summary['estimator']}" + (f" (fell back: {fallback})" if fallback else ""),
        f"{summary['frames']} frames, {summary['duration_s']:.1f} s, path {summary['path_length_m']:.4f} m",
        f"scale: {scale['policy']} – {scale['reason']}",
        f"motions: {summary['motions']['used']} used, {summary['motions']['rejected']} rejected",
    ]
    lines += [f"imu: {step['words']}; it was let go there" for step in summary["imu"]["bias_steps"]]
    lines += [f"imu: {wander['words']}; it may do so there" for wander in summary["imu"]["bias_wanders"]]
    if summary["rest"]["stretches"]:
        lines.append(f"rest: {rest_in_words(summary['rest'], summary['duration_s'])}")
    if summary["loops"]["proposed"]:
        lines.append(f"loops: {loops_in_words(summary['loops'])}")
    if "online" in summary:
        ms = summary["online"]["latency_ms"]
        lines.append(f"online with {summary['online']['lag_s']:g} s lag: latency per frame {ms['p50']:.1f} ms in the "
                     f"median, 99 % within {ms['p99']:.1f} ms, at most {ms['max']:.1f} ms")
    if "accuracy" in summary:
        lines.append(verdict(summary["accuracy"]["motions"], summary["accuracy"]["refined"]))
    return "\n".join(lines)


def loops_in_words(loops: dict[str, Any]) -> str:
    """Which places were recognised, and why the other proposals were not believed."""
    count, refused = loops["accepted"], sorted(loops["refused"].items(), key=lambda item: (-item[1], item[0]))
    text = f"{count} of {loops['proposed']} pairs of frames that look alike were used as the same place seen again"
    return text + (": " + "; ".join(f"{n} not, {reason}" for reason, n in refused) if refused else "") + "."


def rest_in_words(rest: dict[str, Any], duration_s: float) -> str:
    """How long the capsule lay still."""
    times = "once" if rest["stretches"] == 1 else f"{rest['stretches']} times"
    return (f"the capsule lay still {times}, {rest['duration_s']:.0f} s in all "
            f"({100 * rest['duration_s'] / duration_s:.0f} % of the time): IMU and motions agree.")
