"""Chaining motions, near and wide."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from vio import se3
from vio.motions import RelativeMotions, chain_motions

T_BODY_CAMERA = se3.exp([0.3, -0.2, 0.5, 0.01, 0.0, -0.02])


def motions_between(T_world_body, t_s, i, j, sd=1e-3):
    T = T_world_body @ T_BODY_CAMERA
    n = len(i)
    return RelativeMotions(t_s[i], t_s[j], se3.inverse(T[i]) @ T[j], np.tile(sd**2 * np.eye(6), (n, 1, 1)), 0.0, 0.1)


@given(st.integers(0, 2**32 - 1))
def test_chain_returns_the_poses_the_motions_came_from(seed):
    rng = np.random.default_rng(seed)
    t_s = np.cumsum(rng.uniform(0.1, 1, 12))
    T = se3.chain(se3.exp(rng.normal(0, [0.3] * 3 + [0.01] * 3, (11, 6))))
    chained, bridged = chain_motions(motions_between(T, t_s, np.arange(11), np.arange(1, 12)), t_s, T_BODY_CAMERA, T[0])
    assert bridged == 0
    assert np.abs(chained.T_world_body - T).max() < 1e-9


def test_wide_motions_alone_reach_every_keyframe_and_lie_between():
    t_s = np.arange(9.0)
    twist = np.array([0.02, -0.01, 0.03, 0.002, 0.001, 0.003])
    T = se3.chain(np.tile(se3.exp(twist), (8, 1, 1)))
    keys = np.arange(0, 9, 4)
    chained, bridged = chain_motions(motions_between(T, t_s, keys[:-1], keys[1:]), t_s, T_BODY_CAMERA, T[0])
    assert bridged == 0
    assert np.abs(chained.T_world_body - T).max() < 1e-9


def test_short_and_certain_motions_come_first_and_a_hole_stands_still():
    t_s = np.arange(5.0)
    T = se3.chain(np.tile(se3.exp([0, 0, 0.1, 0.001, 0, 0]), (4, 1, 1)))
    good = motions_between(T, t_s, np.array([0, 1]), np.array([1, 2]))
    wrong = motions_between(se3.chain(np.tile(se3.exp([0.5, 0, 0, 0.1, 0, 0]), (4, 1, 1))), t_s, np.array([0, 0]),
                            np.array([1, 2]), sd=0.1)
    both = RelativeMotions(*(np.concatenate([getattr(m, name) for m in (wrong, good)])
                             for name in ("t_i_s", "t_j_s", "T_i_j", "cov")), 0.0, 0.1)
    chained, bridged = chain_motions(both, t_s, T_BODY_CAMERA, T[0])
    assert bridged == 2
    assert np.abs(chained.T_world_body[:3] - T[:3]).max() < 1e-9
    assert np.abs(chained.T_world_body[3:] - T[2]).max() < 1e-9
