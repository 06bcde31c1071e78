"""How wrong a measured motion may be: a 6 x 6 covariance per pair, from signals that the network gives along.

ln sd of every degree of freedom is linear in a few signals, fitted by maximum likelihood to errors on validation
recordings; what remains of the errors gives one correlation matrix. Which signals are worth having is decided by
likelihood on recordings left out of the fit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from learned.errors import WeightsError

Array = NDArray[np.float64]

GROUPS = ((0, 1), (2,), (3, 4), (5,))
"""Degrees of freedom (rotation x, y, z, translation x, y, z in camera axes) that share their coefficients, but for
the constant: the image plane's two directions are alike."""
RIDGE = 0.5
"""Penalty on the coefficients of the signals, in errors' worth."""
FARTHEST = 2.5
"""Deviations from the mean beyond which a signal counts no further: nothing was fitted there."""
WORTH = 0.01
"""Gain in log likelihood per pair, on recordings left out, that one more signal has to bring."""
FOLDS = 5


@dataclass(frozen=True)
class UncertaintyModel:
    """Signals → covariance.

    Raises:
        WeightsError: parts that do not fit together.
    """

    signals: tuple[str, ...]
    """Names of the signals it reads, from those of `learned.inference.SIGNALS`."""
    mean: Array
    """(S,) of the signals over the calibration pairs."""
    sd: Array
    """(S,) of the same."""
    log_sd: Array
    """(6, 1 + S) constant and coefficients per degree of freedom: rad and motion units."""
    correlation: Array
    """(6, 6) of the errors over their standard deviations."""

    def __post_init__(self) -> None:
        count = len(self.signals)
        shapes = (self.mean.shape, self.sd.shape, self.log_sd.shape, self.correlation.shape)
        if shapes != ((count,), (count,), (6, 1 + count), (6, 6)) or not all(
                np.isfinite(part).all() for part in (self.mean, self.sd, self.log_sd, self.correlation)):
            raise WeightsError(f"weights: the uncertainty model for {count} signals has parts of shapes {shapes}, or "
                               "values that are not finite; calibrate again")

    def deviations(self, signals: Array, names: Sequence[str]) -> Array:
        """(B, 6) standard deviations for signals (B, len(names))."""
        return np.asarray(np.exp(self._design(signals, names) @ self.log_sd.T))

    def covariance(self, signals: Array, names: Sequence[str]) -> Array:
        """(B, 6, 6) covariances, rotation first, of `T_i_j` perturbed on the right."""
        sd = self.deviations(signals, names)
        return np.asarray(sd[:, :, None] * self.correlation * sd[:, None, :])

    def to_dict(self) -> dict[str, Any]:
        """In values that JSON can hold."""
        return {"signals": list(self.signals), "mean": self.mean.tolist(), "sd": self.sd.tolist(),
                "log_sd": self.log_sd.tolist(), "correlation": self.correlation.tolist()}

    def _design(self, signals: Array, names: Sequence[str]) -> Array:
        chosen = np.asarray(signals, float)[:, [list(names).index(name) for name in self.signals]]
        return standardised(chosen, self.mean, self.sd)


def uncertainty_from_dict(values: Mapping[str, Any]) -> UncertaintyModel:
    """What `to_dict` wrote.

    Raises:
        WeightsError: a part is missing or has another shape.
    """
    try:
        return UncertaintyModel(tuple(values["signals"]), *(np.array(values[key], float) for key in (
            "mean", "sd", "log_sd", "correlation")))
    except (KeyError, TypeError, ValueError):
        raise WeightsError("weights: the card's uncertainty model is incomplete; calibrate again") from None


def fit_uncertainty(errors: Array, signals: Array, names: Sequence[str], chosen: Sequence[str]) -> UncertaintyModel:
    """The model that explains errors best.

    Args:
        errors: (N, 6) `Log(T_predicted⁻¹ T_true)`, rad and motion units.
        signals: (N, len(names)).
        names: of the columns.
        chosen: signals to use; none gives one covariance for all.
    """
    columns = np.asarray(signals, float)[:, [list(names).index(name) for name in chosen]]
    mean, sd = columns.mean(axis=0), np.maximum(columns.std(axis=0), 1e-6)
    design = standardised(columns, mean, sd)
    log_sd = np.zeros((6, design.shape[1]))
    for group in GROUPS:
        log_sd[list(group)] = fit_log_sd(np.abs(errors[:, list(group)]), design)
    scaled = errors / np.exp(design @ log_sd.T)
    second = scaled.T @ scaled / len(scaled)
    root = np.sqrt(np.maximum(np.diag(second), 1e-12))
    log_sd[:, 0] += np.log(root)  # the group's law, each degree of freedom at its own size
    return UncertaintyModel(tuple(chosen), mean, sd, log_sd, _positive(second / np.outer(root, root)))


def choose_signals(errors: Array, signals: Array, names: Sequence[str], recording: NDArray[np.int64]) -> list[str]:
    """Signals that pay on recordings left out of the fit, best first (greedy).

    Args:
        errors: (N, 6).
        signals: (N, len(names)).
        names: candidates.
        recording: (N,) number of the recording of each pair; whole recordings are left out.
    """
    chosen: list[str] = []
    best = _left_out(errors, signals, names, chosen, recording)
    while len(chosen) < len(names):
        scores = {name: _left_out(errors, signals, names, [*chosen, name], recording)
                  for name in names if name not in chosen}
        name = max(scores, key=lambda key: scores[key])
        if scores[name] < best + WORTH:
            break
        chosen, best = [*chosen, name], scores[name]
    return chosen


def log_likelihood(model: UncertaintyModel, errors: Array, signals: Array, names: Sequence[str]) -> float:
    """Mean per pair, without the constant."""
    sd = model.deviations(signals, names)
    scaled = errors / sd
    _, log_det = np.linalg.slogdet(model.correlation)
    mahalanobis = np.einsum("ni,ij,nj->n", scaled, np.linalg.inv(model.correlation), scaled)
    return float(np.mean(-0.5 * mahalanobis - np.log(sd).sum(axis=1) - 0.5 * log_det))


def motion_nees(errors: Array, cov: Array) -> Array:
    """(N,) `ξᵀ Σ⁻¹ ξ / 6` of errors (N, 6): 1 in the mean when covariances are honest."""
    return np.asarray(np.einsum("ni,ni->n", errors, np.linalg.solve(cov, errors[:, :, None])[:, :, 0]) / 6)


def standardised(columns: Array, mean: Array, sd: Array) -> Array:
    """(N, 1 + S) a column of ones and the signals in standard deviations from their mean, clipped at `FARTHEST`."""
    scaled = np.clip((columns - mean) / sd, -FARTHEST, FARTHEST)
    return np.column_stack([np.ones(len(columns)), scaled])


def fit_log_sd(sizes: Array, design: Array) -> Array:
    """Coefficients (S,) of ln sd, the w that maximise Σ -w·x - ½ e² exp(-2 w·x); a convex problem.

    Args:
        sizes: (N, k) absolute errors that share one sd per row.
        design: (N, S) rows x, the first column ones.
    """
    square = (sizes**2).mean(axis=1)
    start = np.zeros(design.shape[1])
    start[0] = 0.5 * np.log(square.mean() + 1e-18)

    def cost(w: Array) -> tuple[float, Array]:
        log_sd = design @ w
        ratio = square * np.exp(-2 * log_sd)
        penalty = np.concatenate([[0.0], RIDGE * w[1:]])
        return float(np.sum(log_sd + 0.5 * ratio) + 0.5 * penalty @ w), design.T @ (1 - ratio) + penalty
    return np.asarray(minimize(cost, start, jac=True, method="L-BFGS-B").x)


def _left_out(errors: Array, signals: Array, names: Sequence[str], chosen: Sequence[str],
              recording: NDArray[np.int64]) -> float:
    numbers = np.unique(recording)
    scores = []
    for fold in range(min(FOLDS, len(numbers))):
        out = np.isin(recording, numbers[fold::FOLDS])
        if out.all():
            continue
        model = fit_uncertainty(errors[~out], signals[~out], names, chosen)
        scores.append(log_likelihood(model, errors[out], signals[out], names) * out.sum())
    return float(np.sum(scores) / len(errors)) if scores else -np.inf


def _positive(correlation: Array, shrink: float = 0.02) -> Array:
    """A correlation matrix safely away from singular."""
    return np.asarray((1 - shrink) * correlation + shrink * np.eye(6))
