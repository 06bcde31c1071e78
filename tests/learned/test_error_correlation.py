"""How long errors last is read off errors that were made to last so long."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from learned.error_correlation import error_correlation_s

STEP_S = 1 / 3


class Made(SimpleNamespace):
    def __len__(self):
        return len(self.step_s)


class Sure:
    """A model that claims 0.02 units whatever the signals."""

    def covariance(self, signals, names):
        return np.tile(0.02**2 * np.eye(6), (len(signals), 1, 1))


def made(seed: int, correlation_s: float, count: int = 1500, outlier: bool = False) -> Made:
    rng = np.random.default_rng(seed)
    white = rng.standard_normal((count, 6))
    rho, errors = np.exp(-STEP_S / correlation_s) if correlation_s else 0.0, white.copy()
    for k in range(1, count):
        errors[k] = rho * errors[k - 1] + np.sqrt(1 - rho**2) * white[k]
    if outlier:
        errors[100] = 1e3
    return Made(errors=lambda log_scale: 0.02 * errors, log_scale=0.0, signals=np.zeros((count, 1)),
                step_s=np.full(count, STEP_S))


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 40), st.floats(0.2, 0.9), st.booleans())
def test_the_time_that_errors_last_is_found(seed, correlation_s, outlier):
    found = error_correlation_s([made(seed, correlation_s, outlier=outlier), made(seed + 99, correlation_s)], Sure())
    assert found == pytest.approx(correlation_s, rel=0.25)


def test_independent_errors_hardly_last_and_nothing_says_nothing():
    assert error_correlation_s([made(1, 0.0)], Sure()) < 0.12  # ρ below 0.06
    assert error_correlation_s([], Sure()) == 0.0
