"""Paired differences against every resample there is, against scipy, and their symmetries."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.stats import bootstrap

from learned.benchmark.statistics import bootstrap_interval, paired_difference
from learned.errors import BenchmarkError

VALUES = arrays(float, st.tuples(st.integers(1, 4), st.integers(3, 6)), elements=st.floats(-100, 100).map(
    lambda x: round(x, 3)))


def test_the_interval_is_that_of_all_resamples():
    """4 · 256 ways to draw 2 seeds and 4 sequences are few enough to list."""
    cells = np.random.default_rng(4).normal(0.3, 1, (2, 4))
    every = np.array([cells[np.ix_(rows, columns)].mean() for rows in product(range(2), repeat=2)
                      for columns in product(range(4), repeat=4)])
    low, high = bootstrap_interval(cells, np.random.default_rng(0))
    assert 0.017 < np.mean(every < low + 1e-12) < 0.04 and 0.017 < np.mean(every > high - 1e-12) < 0.04


def test_with_one_seed_it_is_the_ordinary_bootstrap():
    cells = np.random.default_rng(2).gamma(2, 1, (1, 12))
    ours = bootstrap_interval(cells, np.random.default_rng(0))
    theirs = bootstrap((cells[0],), np.mean, n_resamples=20000, method="percentile",
                       rng=np.random.default_rng(1)).confidence_interval
    assert np.allclose(ours, theirs, atol=0.05 * (theirs.high - theirs.low))


@settings(max_examples=50)
@given(VALUES, st.floats(-10, 10), st.floats(0.1, 10))
def test_intervals_move_and_stretch_with_the_values(difference, shift, factor):
    base = np.zeros_like(difference)
    one = paired_difference(base, difference, "x")
    other = paired_difference(base + 5, 5 + factor * difference + shift, "x")
    size = 1e-9 * (1 + 1000 * factor + abs(shift))
    for name in ("mean", "low", "high"):
        assert abs(getattr(other, name) - (factor * getattr(one, name) + shift)) < size
    back = paired_difference(difference, base, "x")
    assert np.isclose(back.mean, -one.mean) and back.candidate_lower == one.candidate_higher
    assert one.low <= one.high


@pytest.mark.parametrize("seeds, sequences", [(1, 5), (3, 5)])
def test_the_interval_holds_what_it_says(seeds, sequences):
    """Of 160 studies without a difference; the plain percentiles hold less."""
    rng = np.random.default_rng(seeds)
    held, plain = 0, 0
    for _ in range(160):
        cells = rng.normal(size=(1, sequences)) + (seeds > 1) * (
            rng.normal(size=(seeds, 1)) + 0.5 * rng.normal(size=(seeds, sequences)))
        found = paired_difference(np.zeros_like(cells), cells, "x")
        low, high = bootstrap_interval(cells, np.random.default_rng(0))
        held, plain = held + (not found.excludes_zero), plain + (low <= 0 <= high)
    assert 0.9 < held / 160 < 0.995 and plain < held


def test_trainings_that_differ_widen_the_interval():
    """The same on every sequence, but other by seed: sequences alone would claim certainty."""
    cells = np.repeat([[-1.0], [0.5], [2.0]], 5, axis=1)
    found = paired_difference(np.zeros_like(cells), cells, "x")
    assert found.low < 0 < found.high and found.excludes_zero is False
    assert paired_difference(np.zeros((1, 5)), cells[2:], "x").excludes_zero is True


def test_only_sequences_with_both_values_count():
    base, other = np.zeros((2, 4)), np.ones((2, 4))
    base[1, 2] = other[0, 0] = np.nan
    found = paired_difference(base, other, "x")
    assert (found.mean, found.sequences, found.low, found.excludes_zero) == (1.0, 2, None, None)
    assert paired_difference(base, np.full((2, 4), np.nan), "x") is None
    with pytest.raises(BenchmarkError, match="compares values of shapes"):
        paired_difference(base, other[:, :3], "x")
