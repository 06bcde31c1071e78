"""An evaluation of weights on recordings with truth, beside guesses that need no network, as numbers and as text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from learned.evaluation import (
    DepthScore,
    Maps,
    MotionScore,
    angle_deg,
    depth_score,
    mean_inverse_depth,
    motion_score,
    nees_of,
    trivial_depths,
    trivial_motions,
)
from learned.gyro_update import CorrectedMotions
from learned.inference import SIGNALS
from learned.measured import Array, Measured, measure
from learned.uncertainty import UncertaintyModel, uncertainty_from_dict
from learned.weights import Weights
from vio.recording import Recording


@dataclass(frozen=True)
class Evaluation:
    """Scores over all recordings."""

    depth: dict[str, DepthScore]
    """Per name, "network" first; empty without depth truth."""
    motion: dict[str, MotionScore]
    """Per name, "network" first, then "network with gyro" where there is one."""
    gyro_alone_deg: float | None
    """Mean rotation error of the integrated gyro, its bias left in."""
    gyro_unbiased_deg: float | None
    """The same, freed of the bias that gravity and the network's rotations tell."""
    nees: float | None
    """Mean per degree of freedom at each recording's own scale; None for weights without covariances."""
    scale_error: float
    """Root mean square of ln(true over prior scale), per recording."""
    pairs: int
    recordings: int

    def to_dict(self) -> dict[str, Any]:
        """In values that JSON can hold."""
        return {name: _finite(value) for name, value in asdict(self).items()}


def evaluate(recordings: Sequence[Recording], weights: Weights, prior: Sequence[Maps] | None = None) -> Evaluation:
    """Judge weights on recordings with truth.

    Args:
        recordings: with images, camera, truth, and what the method needs.
        weights: from `learned.weights.load_weights`.
        prior: mean inverse-depth map for each recording, from training data; None = from the recordings themselves.

    Raises:
        RecordingError, ImuError: a recording that cannot be measured.
    """
    measured = [measure(weights.method, weights.card["depth_kind"], recording) for recording in recordings]
    return evaluation_of(measured, weights, prior)


def evaluation_of(measured: Sequence[Measured], weights: Weights, prior: Sequence[Maps] | None = None) -> Evaluation:
    """The same of what is measured already."""
    depth: dict[str, DepthScore] = {}
    if any(m.depth_true_m is not None for m in measured):
        maps = prior or [mean_inverse_depth(measured)] * len(measured)
        guesses = {"network": [m.depth for m in measured], **trivial_depths(measured, maps)}
        found = {name: depth_score(values, measured) for name, values in guesses.items()}
        depth = {name: score for name, score in found.items() if score is not None}
    motions = {"network": [m.T_i_j for m in measured]}
    model = weights.card["uncertainty"]
    gyro, freed = _gyro_error_deg(measured, [np.zeros(3)] * len(measured)), None
    if gyro is not None and model is not None:
        updates = [corrected(m, uncertainty_from_dict(model)) for m in measured]
        motions["network with gyro"] = [update.T_i_j for update in updates]
        freed = _gyro_error_deg(measured, [update.bias.bias_rad_s for update in updates])
    motion = {name: motion_score(values, measured) for name, values in {**motions, **trivial_motions(measured)}.items()}
    nees = None if model is None else float(nees_of(measured, uncertainty_from_dict(model), SIGNALS).mean())
    scales = np.array([m.log_scale for m in measured if np.isfinite(m.log_scale)]) - weights.card["scale_log_mean"]
    return Evaluation(depth, motion, gyro, freed, nees,
                      float(np.sqrt(np.mean(scales**2))) if len(scales) else float("nan"),
                      sum(len(m) for m in measured), len(measured))


def corrected(m: Measured, model: UncertaintyModel) -> CorrectedMotions:
    """Motions after the gyro's update."""
    assert m.gyro is not None
    k = np.arange(len(m))
    return m.gyro.correct(m.T_i_j, model.covariance(m.signals, SIGNALS), k, k + 1)


def _gyro_error_deg(measured: Sequence[Measured], biases: Sequence[Array]) -> float | None:
    """Mean rotation error of the gyros freed of some biases; None where a recording has no gyro."""
    gyros = [m.gyro for m in measured if m.gyro is not None]
    if len(gyros) < len(measured):
        return None
    return float(np.mean(np.concatenate([angle_deg(gyro.between_frames(bias), m.T_true_m)
                                         for gyro, bias, m in zip(gyros, biases, measured, strict=True)])))


def depth_rows(evaluation: Evaluation) -> list[list[str]]:
    """Name, AbsRel and Acc per image and per sequence, spread of the scale."""
    return [[name, f"{s.abs_rel_image:.3f}", f"{100 * s.acc_image:.1f} %", f"{s.abs_rel_sequence:.3f}",
             f"{100 * s.acc_sequence:.1f} %", f"{s.scale_sd:.3f}"] for name, s in evaluation.depth.items()]


def motion_rows(evaluation: Evaluation) -> list[list[str]]:
    """Name, rotation, direction in the median and the mean, step, correlation."""
    return [[name, f"{s.rotation_deg:.2f}°", f"{s.direction_deg:.1f}°", f"{s.direction_mean_deg:.1f}°",
             f"{s.step_mm:.2f} mm", f"{s.length_correlation:.2f}"] for name, s in evaluation.motion.items()]


DEPTH_HEADER = ("depth", "AbsRel, image", "Acc, image", "AbsRel, sequence", "Acc, sequence", "scale sd")
MOTION_HEADER = ("motion", "rotation", "direction, median", "direction, mean", "step error", "length correlation")


def format_evaluation(evaluation: Evaluation) -> str:
    """Two tables and three lines."""
    tables = [_table(DEPTH_HEADER, depth_rows(evaluation))] if evaluation.depth else []
    tables.append(_table(MOTION_HEADER, motion_rows(evaluation)))
    notes = [f"{evaluation.pairs} pairs of {evaluation.recordings} recordings"]
    if evaluation.gyro_alone_deg is not None:
        notes.append(f"gyro alone, bias left in: {evaluation.gyro_alone_deg:.2f}° per step")
    if evaluation.gyro_unbiased_deg is not None:
        notes.append("gyro alone, its bias estimated from gravity and the network: "
                     f"{evaluation.gyro_unbiased_deg:.3f}°")
    if evaluation.nees is not None:
        notes.append(f"motion NEES per degree of freedom {evaluation.nees:.2f} (honest: 1), scale off its prior by "
                     f"{100 * evaluation.scale_error:.0f} % (rms)")
    return "\n\n".join([*tables, "\n".join(notes)])


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    widths = [max(len(row[k]) for row in [header, *rows]) for k in range(len(header))]
    return "\n".join("  ".join(cell.ljust(w) if k == 0 else cell.rjust(w)
                               for k, (cell, w) in enumerate(zip(row, widths, strict=True)))
                     for row in [header, *rows])


def _finite(value: Any) -> Any:
    """JSON has no NaN: None in its place."""
    if isinstance(value, dict):
        return {name: _finite(inner) for name, inner in value.items()}
    return None if isinstance(value, float) and not np.isfinite(value) else value
