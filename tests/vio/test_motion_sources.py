"""Several sources of motions: one unit, one prior, no evidence counted twice."""

from dataclasses import replace

import numpy as np
import pytest

from vio import se3
from vio.errors import MotionsError
from vio.motion_sources import merge_motions
from vio.motions import RelativeMotions

SD = np.array([5e-3] * 3 + [2e-4] * 3)


def truth(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return se3.exp(rng.standard_normal((n, 6)) * np.array([0.05] * 3 + [2e-3] * 3))


def source(T: np.ndarray, error: np.ndarray, unit_m: float, mean: float | None = None,
           sd: float = 0.1) -> RelativeMotions:
    """Motions with errors (N, 6) in metric units, in a unit of their own."""
    T = T @ se3.exp(error)
    T[:, :3, 3] /= unit_m
    scaled = SD / np.repeat([1.0, unit_m], 3)
    t = np.arange(len(T) + 1) / 3.0
    return RelativeMotions(t[:-1], t[1:], T, np.tile(np.diag(scaled**2), (len(T), 1, 1)),
                           np.log(unit_m) if mean is None else mean, sd)


@pytest.mark.parametrize(("share", "unit_m"), [(0.0, 0.5), (0.5, 2.0), (0.9, 1.0)])
def test_unit_and_correlation_are_measured_and_the_mean_is_claimed_honestly(share, unit_m):
    """The mean of both, on 2000 pairs, against its claimed covariance (1 + ρ) C / 2."""
    n, rng = 2000, np.random.default_rng(1)
    common, own_a, own_b = rng.standard_normal((3, n, 6)) * SD
    T = truth(n)
    sources = [source(T, np.sqrt(share) * common + np.sqrt(1 - share) * own, unit)
               for own, unit in ((own_a, 0.8), (own_b, 0.8 * unit_m))]
    merged = merge_motions(sources)
    assert merged.log_ratio[1] == pytest.approx(np.log(unit_m), abs=0.01)
    np.testing.assert_allclose(merged.correlation[0, 1], share, atol=0.08)
    metric = merged.motions.T_i_j.copy()
    metric[:, :3, 3] *= 0.8
    a, b = (metric[merged.source == k] for k in (0, 1))
    error = 0.5 * (se3.log(se3.inverse(T) @ a) + se3.log(se3.inverse(T) @ b))
    claimed = merged.motions.cov[merged.source == 0] / 2 * np.outer(np.repeat([1, 0.8], 3), np.repeat([1, 0.8], 3))
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(claimed), error).mean() / 6
    assert nees == pytest.approx(1.0, abs=0.12)


def test_a_source_given_twice_counts_once():
    once = source(truth(300), np.random.default_rng(2).standard_normal((300, 6)) * SD, 0.8)
    merged = merge_motions([once, once])
    assert (merged.correlation[0, 1] == 1.0).all() and len(merged.motions) == 600
    np.testing.assert_allclose(merged.motions.cov[::2], 2 * once.cov, rtol=1e-12)


def test_a_correlation_that_was_measured_beside_truth_is_taken_for_its_own_weights_alone():
    rng = np.random.default_rng(4)
    a, b = (source(truth(300), rng.standard_normal((300, 6)) * SD, 0.8) for _ in range(2))
    network = replace(a, meta={"rotation": "network", "predictor": {"sha256": "1f"}})
    known = {"source": "learned", "predictor": {"sha256": "1f"},
             "network_correlation": {"rotation": 0.2, "translation": 0.5}}
    for sources in ([network, replace(b, meta=known)], [replace(b, meta=known), network]):
        merged = merge_motions(sources)
        np.testing.assert_allclose(merged.correlation[0, 1], [0.2, 0.5])
        np.testing.assert_allclose(np.diagonal(merged.motions.cov[0]),
                                   np.repeat([1.2, 1.5], 3) * np.diagonal(sources[0].cov[0]), rtol=0.05)
    turned = replace(a, meta=network.meta | {"rotation": "gyro"})  # other rotations, other errors
    for one, other in ((network, known | {"predictor": {"sha256": "2e"}}), (network, {}), (turned, known)):
        assert (merge_motions([one, replace(b, meta=other)]).correlation[0, 1] < 0.15).all()


def test_one_source_stays_as_it_is():
    alone = source(truth(40), np.zeros((40, 6)), 0.8)
    merged = merge_motions([alone]).motions
    for name in ("t_i_s", "t_j_s", "T_i_j", "cov", "scale_log_mean", "scale_log_sd"):
        np.testing.assert_allclose(getattr(merged, name), getattr(alone, name), rtol=1e-12, atol=1e-15)


def test_wider_baselines_and_disjoint_pairs_are_left_alone():
    near = source(truth(60), np.zeros((60, 6)), 0.8)
    wide = replace(near, t_i_s=near.t_i_s[:-2], t_j_s=near.t_j_s[2:], T_i_j=near.T_i_j[:-2], cov=near.cov[:-2])
    merged = merge_motions([near, wide])
    assert (merged.correlation[0, 1] == 0).all() and (merged.motions.t_i_s[1:] >= merged.motions.t_i_s[:-1]).all()
    np.testing.assert_allclose(np.sort(merged.motions.cov[:, 0, 0]), SD[0] ** 2, rtol=1e-12)


def test_priors_are_joined_or_refused():
    T = truth(100)
    a, b = source(T, np.zeros((100, 6)), 0.8, sd=0.1), source(T, np.zeros((100, 6)), 0.4, np.log(0.4) + 0.1, sd=0.1)
    both = merge_motions([a, b]).motions
    assert both.scale_log_mean == pytest.approx(np.log(0.8) + 0.05) and both.scale_log_sd == pytest.approx(0.1 / 2**0.5)
    assert merge_motions([a, replace(b, scale_log_mean=np.log(0.4), scale_log_sd=0.0)]).motions.scale_log_sd == 0
    with pytest.raises(MotionsError, match=r"sources 1 and 2 declare scales that are 2\.72 times apart .* correct"):
        merge_motions([a, replace(b, scale_log_mean=np.log(0.4) + 1.0)])
    with pytest.raises(MotionsError, match="at least one"):
        merge_motions([])
