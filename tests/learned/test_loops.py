"""Loops found in images: the same places, in order, with the motion between them; and none where there is none."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import learned
from learned.loops import _Chain, _Loop, _thinned, trace_loops
from learned.methods import build_method
from learned.places import Places, aggregate, learn_words, local_features, look_alikes
from vio import se3
from vio.errors import RecordingError
from vio.formats.asl import read_asl
from vio.motions import RelativeMotions, match_frames
from vio.simulation import network_like_motions, preset_camera, simulate
from vio.simulation.images import write_rendered

FRAMES = 24


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """A recording of 48 frames that shows the first 24 again from its middle on, in reverse, and motions for it."""
    camera = preset_camera("fisheye-140", 128)
    simulation = simulate("small-bowel", "none", 0, 8.0, 6, driving="operated", camera=camera)
    folder = tmp_path_factory.mktemp("loops") / "REC"
    write_rendered(simulation, folder)
    once = read_asl(folder)
    assert len(once) == FRAMES
    order = np.r_[np.arange(FRAMES), np.arange(FRAMES)[::-1]]
    t_ns = once.frame_t_ns[0] + np.round(np.arange(2 * FRAMES) / 3 * 1e9).astype(np.int64)
    span = int(once.imu.t_ns[-1] - once.imu.t_ns[0]) + 25_000_000
    imu = replace(once.imu, t_ns=np.concatenate([once.imu.t_ns, once.imu.t_ns + span]),
                  gyro_rad_s=np.tile(once.imu.gyro_rad_s, (2, 1)), accel_m_s2=np.tile(once.imu.accel_m_s2, (2, 1)))
    recording = replace(once, frame_t_ns=t_ns, imu=imu, truth=None, truth_state=None, depth_paths=(),
                        frame_paths=tuple(once.frame_paths[k] for k in order))
    T = (once.truth_at_frames().T_world_body @ once.calibration.T_body_camera)[order]
    steps = network_like_motions(once.truth_at_frames(), once.calibration.T_body_camera, 1).motions
    true = se3.inverse(T[:-1]) @ T[1:]
    true[:, :3, 3] /= 0.02
    cov = np.concatenate([steps.cov, steps.cov[:1], steps.cov[::-1]])
    t = recording.frame_t_s
    return recording, RelativeMotions(t[:-1], t[1:], true, cov, np.log(0.02), 0.3), T


def test_frames_that_are_shown_again_are_found_where_they_were(seen):
    recording, motions, T = seen
    trace = trace_loops(recording, motions, search=learned.LoopSearch(gap_s=4.0))
    loops = trace.loops.motions
    assert loops is not None and len(loops) >= 2
    same = {(k, 2 * FRAMES - 1 - k) for k in range(FRAMES)}
    assert len(same & set(trace.proposed)) > 0.9 * len([k for k in range(FRAMES) if 2 * (FRAMES - k) - 1 > 12])
    i, j = match_frames(loops, recording.frame_t_s)
    true = se3.inverse(T[i]) @ T[j]
    off = np.linalg.norm(loops.T_i_j[:, :3, 3] * np.exp(motions.scale_log_mean) - true[:, :3, 3], axis=1)
    assert np.median(off) < 2e-3 and (j - i > 11).all()
    assert trace.loops.proposed >= len(trace.proposed) >= len(set(trace.supported) & set(trace.proposed))
    assert sum(trace.loops.refused.values()) + len(loops) == trace.loops.proposed


def test_what_is_shown_once_is_no_loop(seen):
    recording, motions, _ = seen
    first = replace(recording, frame_t_ns=recording.frame_t_ns[:FRAMES], frame_paths=recording.frame_paths[:FRAMES],
                    depth_paths=())
    t = first.frame_t_s
    inside = motions.t_j_s <= t[-1] + 1e-6
    once = RelativeMotions(motions.t_i_s[inside], motions.t_j_s[inside], motions.T_i_j[inside], motions.cov[inside],
                           motions.scale_log_mean, 0.3)
    loops = learned.find_loops(first, once, search=learned.LoopSearch(gap_s=20.0))
    assert loops.motions is None and loops.proposed == 0
    blind = replace(recording, frame_paths=(None,) * (2 * FRAMES))
    with pytest.raises(RecordingError, match=r"images are missing.*--loops"):
        learned.find_loops(blind, motions)


def test_look_alikes_are_those_of_brute_force():
    rng = np.random.default_rng(2)
    descriptor = rng.standard_normal((30, 8)).astype(np.float32)
    descriptor /= np.linalg.norm(descriptor, axis=1, keepdims=True)
    frame = np.sort(rng.choice(50, 30, replace=False))
    t = np.arange(50) * 0.5
    want = set()
    for a in range(30):
        far = [b for b in range(30) if abs(t[frame[a]] - t[frame[b]]) >= 6.0]
        for b in sorted(far, key=lambda b: -float(descriptor[a] @ descriptor[b]))[:3]:
            want.add((min(frame[a], frame[b]), max(frame[a], frame[b])))
    found = look_alikes(Places(frame, descriptor, {}), t, 6.0, 3)
    assert {tuple(pair) for pair in found.tolist()} == want and (found[:, 0] < found[:, 1]).all()


def test_descriptors_know_no_order_of_cells():
    rng = np.random.default_rng(3)
    cells = rng.standard_normal((4, 200, 6)).astype(np.float32)
    words = learn_words(cells.reshape(-1, 6), 5, rng)
    first = aggregate(cells, words)
    np.testing.assert_allclose(np.linalg.norm(first, axis=1), 1, rtol=1e-5)
    np.testing.assert_allclose(aggregate(cells[:, rng.permutation(200)], words), first, atol=1e-5)


def test_loops_support_each_other_only_where_they_tell_of_one_motion():
    rng, n = np.random.default_rng(4), 40
    steps = se3.exp(np.concatenate([rng.normal(0, 0.05, (n - 1, 3)), rng.normal(0, 0.1, (n - 1, 3))], axis=1))
    t, T = np.arange(n) / 3, se3.chain(steps)
    cov = np.broadcast_to(np.diag([1e-4] * 6), (n - 1, 6, 6))
    chain = _Chain(RelativeMotions(t[:-1], t[1:], steps, cov, -3.6, 0.3), t)
    sure = np.diag([1e-4] * 6)
    found = {(i, j): _Loop(se3.inverse(T[i]) @ T[j], sure) for i, j in ((2, 36), (3, 35), (5, 34))}
    found[4, 33] = _Loop(found[5, 34].T_i_j @ se3.exp([0.3, 0, 0, 0.5, 0, 0]), sure)
    support = {pair: chain.support(pair, found, 6) for pair in found}
    assert support == {(2, 36): 2, (3, 35): 2, (5, 34): 2, (4, 33): 0}
    assert set(_thinned(found, 1)) == {(2, 36), (5, 34)} or len(_thinned(found, 1)) == 2
    assert len(_thinned(found, 0)) == 4


@pytest.mark.parametrize("name", ["gyro-correlation", "endosfmlearner"])
def test_cells_are_described_by_unit_features_free_of_the_lights_gain(name):
    method = build_method(name, width=0.25, image_size=(64, 64), seed=3).eval()
    with torch.no_grad():
        maps = local_features(method, torch.rand(2, 3, 64, 64))
    torch.testing.assert_close(maps.norm(dim=1), torch.ones(2, *maps.shape[2:]))
