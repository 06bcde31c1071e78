"""Depth-aligned motions beside truth: noise, scale, covariance, and how their errors go with the pose network's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learned.depth_aligned import ALIGNED_SIGNALS, TRACKING, AlignedModel, aligned_signals
from learned.evaluation import motion_score
from learned.inference import SIGNALS
from learned.measured import Measured
from learned.uncertainty import UncertaintyModel, choose_signals, fit_uncertainty, motion_nees
from vio import se3
from vio.depth_odometry import DepthNoise, PairFits, fit_pairs, shared_sightings
from vio.errors import TrackingError
from vio.tracking import track_images
from vio.tracks import Tracks

Array = NDArray[np.float64]

LEAST_PAIRS = 60
LEAST_SCALE_SD = 0.05
LEAST_PIXEL_PX, LEAST_RELATIVE = 0.05, 1e-3
"""No tracker and no network is better than this."""
ROBUST = 1.4826  # from the median of absolute values to the sd of a Gaussian


@dataclass(frozen=True)
class Aligned:
    """N pairs of one recording, measured by tracks and predicted depth, beside truth and the pose network."""

    pairs: Measured
    """The same pairs, as the pose network sees them."""
    fits: PairFits

    @property
    def as_measured(self) -> Measured:
        """These motions in the place of the network's."""
        return replace(self.pairs, T_i_j=self.fits.T_i_j)


def aligned_section(measured: Sequence[Measured], network: UncertaintyModel) -> dict[str, Any] | None:
    """The card's `depth_aligned`: an `AlignedModel` and figures; None with fewer than 60 pairs or without true depth.

    Args:
        measured: calibration recordings.
        network: covariances of the pose network, for the correlation.
    """
    tracked = [(m, tracks) for m in measured for tracks in [tracks_of(m)] if tracks is not None]
    noise = measured_noise([(m, tracks) for m, tracks in tracked if m.depth_true_m is not None])
    if noise is None:
        return None
    aligned = [a for m, tracks in tracked for a in [align(m, tracks, noise)]
               if len(a.fits.frame) and np.isfinite(a.as_measured.log_scale)]
    if sum(len(a.fits.frame) for a in aligned) < LEAST_PAIRS:
        return None
    scales = np.array([a.as_measured.log_scale for a in aligned])
    spread = float(np.std(scales, ddof=1)) if len(scales) > 1 else 1.0
    errors, signals, recording = _rows(aligned)
    model = AlignedModel(replace(noise, scale_log_sd=max(spread, LEAST_SCALE_SD)), float(np.mean(scales)),
                         fit_uncertainty(errors, signals, ALIGNED_SIGNALS,
                                         choose_signals(errors, signals, ALIGNED_SIGNALS, recording)), {})
    model = replace(model, network_correlation=network_correlation(aligned, model, network))
    return {**model.to_dict(), "pairs": len(errors), "recordings": len(aligned),
            "nees": float(aligned_nees(aligned, model).mean()), "motion": asdict(aligned_score(aligned))}


def tracks_of(m: Measured) -> Tracks | None:
    """Tracks of a recording's frames; None where there is nothing to follow."""
    try:
        return track_images(m.images, TRACKING)
    except TrackingError:  # fewer than two frames, or no texture: such a recording calibrates nothing here
        return None


def measured_noise(tracked: Sequence[tuple[Measured, Tracks]]) -> DepthNoise | None:
    """How far tracked corners miss their true place, and how far two predicted depths of a point disagree.

    Both robust (from medians), for what is far off is down-weighted by the fit. `depth_relative` is the sd of ONE depth
    that makes the ratio of two as uncertain as it was found: what both sightings share does not count.

    Args:
        tracked: recordings with true depth and their tracks.

    Returns:
        Noise with a scale sd yet to be set; None without shared points.
    """
    misses, ratios = [np.zeros(0)], [np.zeros(0)]
    for m, tracks in tracked:
        true = m.depth_true_m
        assert true is not None
        seen = shared_sightings(tracks, m.camera, true.__getitem__)
        T_j_i = se3.inverse(m.T_true_m[seen.frame])
        points = np.einsum("nij,nj->ni", T_j_i[:, :3, :3], seen.cloud[seen.row_i]) + T_j_i[:, :3, 3]
        pixel, _ = m.camera.project(points)
        misses.append((tracks.pixel[seen.row_j] - pixel).ravel())
        over = shared_sightings(tracks, m.camera, lambda k, m=m, true=true: np.where(  # type: ignore[misc]
            true[k] > 0, m.depth[k] / np.maximum(true[k], 1e-9), 0))
        ratios.append(np.log(over.cloud[over.row_j, 2] / over.cloud[over.row_i, 2]))
    miss, ratio = (np.concatenate(x) for x in (misses, ratios))
    miss = miss[np.isfinite(miss)]
    if len(miss) == 0 or len(ratio) == 0:
        return None
    return DepthNoise(max(float(ROBUST * np.median(np.abs(miss))), LEAST_PIXEL_PX),
                      max(float(ROBUST * np.median(np.abs(ratio)) / np.sqrt(2)), LEAST_RELATIVE), 1.0)


def align(m: Measured, tracks: Tracks, noise: DepthNoise) -> Aligned:
    """Depth-aligned motions of a recording, its predicted depth taken as measured."""
    fits = fit_pairs(tracks, m.camera, m.depth.__getitem__, noise)
    k = fits.frame
    parts = {name: getattr(m, name)[k] for name in ("images", "depth", "T_i_j", "T_true_m", "signals", "step_s")}
    true = None if m.depth_true_m is None else m.depth_true_m[k]
    return Aligned(replace(m, **parts, depth_true_m=true, gyro=None), fits)


def aligned_score(aligned: Sequence[Aligned]) -> Any:
    """`learned.evaluation.MotionScore` of depth-aligned motions."""
    return motion_score([a.fits.T_i_j for a in aligned], [a.pairs for a in aligned])


def aligned_nees(aligned: Sequence[Aligned], model: AlignedModel) -> Array:
    """(N,) NEES per degree of freedom of all pairs, each recording at its own scale."""
    errors, signals, _ = _rows(aligned)
    return motion_nees(errors, model.uncertainty.covariance(signals, ALIGNED_SIGNALS))


def network_correlation(aligned: Sequence[Aligned], model: AlignedModel, network: UncertaintyModel) -> dict[str, Any]:
    """How errors of depth-aligned motions and of the pose network go together on the same pairs.

    Errors are taken over their sds, each source and recording at its own scale, and clipped at three: a few pairs that
    both get wrong must not decide. A coefficient is Σ a b / √(Σ a² Σ b²), without removing a mean.
    """
    a, b = [], []
    for one in aligned:
        if not np.isfinite(one.pairs.log_scale):
            continue
        sd_a = model.uncertainty.deviations(aligned_signals(one.fits), ALIGNED_SIGNALS)
        sd_b = network.deviations(one.pairs.signals, SIGNALS)
        a.append(np.clip(one.as_measured.errors(one.as_measured.log_scale) / sd_a, -3, 3))
        b.append(np.clip(one.pairs.errors(one.pairs.log_scale) / sd_b, -3, 3))
    x, y = np.concatenate(a), np.concatenate(b)
    product, square = (x * y).sum(axis=0), np.sqrt((x**2).sum(axis=0) * (y**2).sum(axis=0))
    return {"rotation": float(np.mean(product[:3] / square[:3])),
            "translation": float(np.mean(product[3:] / square[3:])), "per_axis": (product / square).tolist()}


def _rows(aligned: Sequence[Aligned]) -> tuple[Array, Array, NDArray[np.int64]]:
    """Errors (N, 6) in motion units at each recording's own scale, signals (N, S), number of the recording (N,)."""
    used = [a for a in aligned if np.isfinite(a.as_measured.log_scale)]
    errors = [a.as_measured.errors(a.as_measured.log_scale) for a in used]
    return (np.concatenate(errors), np.concatenate([aligned_signals(a.fits) for a in used]),
            np.concatenate([np.full(len(e), r) for r, e in enumerate(errors)]))
