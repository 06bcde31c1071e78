"""Quick and slow motion at two scales: the difference is what is measured."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from learned.scale_gain import FEWEST_BLOCKS, PROGRESS_STEPS, scale_gain_sd
from vio import se3


class Steps(SimpleNamespace):
    def __len__(self):
        return len(self.T_i_j)


def measured(seed, gain, unit, count=400):
    """Progress along x, shaking across it that averages out; the network shows the shaking smaller by `gain`."""
    rng = np.random.default_rng(seed)
    shake = np.diff(rng.standard_normal((count + 1, 3)), axis=0) * [0.0, 1.0, 1.0]
    R = se3.so3_exp(0.1 * rng.standard_normal((count, 3)))
    R_world = np.concatenate([np.eye(3)[None], se3.chain(se3.transform(R, np.zeros((count, 3))))[1:-1, :3, :3]])
    def steps(world):
        return se3.transform(R, np.einsum("nji,nj->ni", R_world, world))
    progress = np.tile([2.0, 0.0, 0.0], (count, 1))
    return Steps(T_i_j=steps((progress + gain * shake) / unit), T_true_m=steps(progress + shake))


@given(st.integers(0, 50), st.floats(0.4, 1.0), st.floats(0.01, 100.0))
def test_what_the_network_takes_from_quick_motion_is_found_whatever_its_unit(seed, gain, unit):
    found = scale_gain_sd([measured(seed, gain, unit)])
    slow, quick = 4.0, 4.0  # mean squares of progress and of shaking along two axes
    expected = -np.log((slow + gain * quick) / (slow + quick))
    assert found == pytest.approx(expected, abs=0.06)


def test_recordings_are_taken_together_and_short_ones_left_out():
    pair = [measured(1, 0.5, 1.0), measured(2, 1.0, 1.0)]
    each = [scale_gain_sd([one]) for one in pair]
    assert scale_gain_sd(pair) == pytest.approx(np.sqrt(np.mean(np.square(each))))
    assert scale_gain_sd([measured(3, 0.5, 1.0, FEWEST_BLOCKS * PROGRESS_STEPS - 1)]) == 0.0
