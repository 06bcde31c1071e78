"""Paired differences: the interval holds what it says, and tells chance from difference."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fusion.paired import block_length, paired_difference, ratio_over_recordings


def ar1(rng: np.random.Generator, n: int, rho: float) -> np.ndarray:
    """A stationary series of unit variance whose neighbours correlate by rho."""
    x = rng.normal(size=n)
    for k in range(1, n):
        x[k] = rho * x[k - 1] + np.sqrt(1 - rho**2) * x[k]
    return x


def test_the_interval_holds_the_true_difference_as_often_as_it_says():
    """Errors that correlate over 20 frames; an interval that took frames as independent would hold 50 %."""
    rng = np.random.default_rng(0)
    inside = []
    for _ in range(200):
        a, b = np.abs(ar1(rng, 800, 0.9)), 1.2 * np.abs(ar1(rng, 800, 0.9))
        found = paired_difference(a, b)
        inside.append(found.low_m <= 0.2 <= found.high_m)
    assert 0.87 <= np.mean(inside) <= 0.99


@settings(max_examples=50)
@given(errors=arrays(float, st.tuples(st.just(2), st.integers(2, 60)), elements=st.floats(0, 10)),
       seed=st.integers(0, 2**32 - 1))
def test_the_difference_is_that_of_the_rms_and_changes_sign_with_the_order(errors, seed):
    first, second = errors
    found, turned = paired_difference(first, second, seed), paired_difference(second, first, seed)
    expected = np.sqrt(np.mean(second**2)) - np.sqrt(np.mean(first**2))
    assert found.difference_m == pytest.approx(expected, abs=1e-9)
    assert (found.low_m, found.high_m) == pytest.approx((-turned.high_m, -turned.low_m), abs=1e-6)
    assert found == paired_difference(first, second, seed)


def test_what_is_always_better_is_significant_and_what_is_the_same_is_not():
    errors = np.random.default_rng(1).uniform(0.5, 1.5, 300)
    assert paired_difference(errors, 0.8 * errors).significant
    same = paired_difference(errors, errors)
    assert not same.significant and (same.low_m, same.high_m) == (0, 0)


def test_blocks_grow_with_correlation_and_leave_a_few():
    rng = np.random.default_rng(2)
    white, slow = (block_length(ar1(rng, 4000, rho)) for rho in (0.0, 0.9))
    tau = (1 + 0.9) / (1 - 0.9)
    assert white == round(4000 ** (1 / 3)) and 0.5 * 2 * tau < slow < 2 * 2 * tau
    assert block_length(np.arange(400.0)) == 100 and block_length(np.zeros(3)) == 1


def test_over_recordings_the_recordings_are_drawn():
    five = ratio_over_recordings([[np.log(r)] for r in (0.5, 0.5, 0.5, 0.5, 0.5)])
    assert (five.ratio, five.low, five.high) == pytest.approx((0.5, 0.5, 0.5)) and five.better == 5
    mixed = ratio_over_recordings([[np.log(0.25), np.log(1.0)], *[[np.log(2.0)]] * 4])
    assert mixed.ratio == pytest.approx(np.exp((np.log(0.5) + 4 * np.log(2)) / 5)) and mixed.better == 1
    assert mixed.low < 1 < mixed.high or mixed.low > 1
    few = ratio_over_recordings([[0.1], [0.2]])
    assert few.low is None and few.high is None and few.recordings == 2
