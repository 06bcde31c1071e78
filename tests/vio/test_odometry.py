"""Classical motions against synthetic worlds with known truth, against EuRoC, and against nothing to see."""

import dataclasses

import numpy as np
import pytest

from vio import depth_odometry, se3
from vio.calibration import Calibration
from vio.camera import Camera
from vio.depth_odometry import DepthNoise, fit_pairs, measure_motions_with_depth
from vio.errors import TrackingError
from vio.imu import ImuNoise, ImuSamples
from vio.odometry import measure_motions, measure_recording
from vio.recording import Recording
from vio.tracks import tracks_from_table

PINHOLE = Camera("pinhole", 320, 320, 160.0, 160.0, 160.0, 160.0, (0.1, -0.05, 0.0, 0.0))
FISHEYE = Camera("equidistant", 320, 320, 130.0, 130.0, 160.0, 160.0, (0.0, 0.0, 0.0, 0.0))
FRAMES = 50


def poses(seed, frames=FRAMES):
    """Cameras that wind along a tube's axis, 1 mm a frame, in metres."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames)
    phase = rng.uniform(0, 6, 5)
    position = np.column_stack([3e-3 * np.sin(0.15 * t + phase[0]), 3e-3 * np.sin(0.11 * t + phase[1]), 1e-3 * t])
    turn = 0.15 * np.column_stack([np.sin(0.2 * t + phase[2]), np.sin(0.17 * t + phase[3]), np.sin(0.1 * t + phase[4])])
    return se3.transform(se3.so3_exp(turn), position)


def wall(seed, length_m, points):
    """Points on a tube of 12 mm radius around the path."""
    rng = np.random.default_rng([seed, 1])
    angle, along = rng.uniform(0, 2 * np.pi, points), rng.uniform(-0.01, length_m + 0.08, points)
    radius = 0.012 * (1 + 0.1 * rng.standard_normal(points))
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), along])


def observed(T, camera, seed, noise_px=0.3, wrong=0.03, points=1500):
    """Noisy tracks of the wall, some of which jump to a random place for good."""
    rng = np.random.default_rng([seed, 2])
    world = wall(seed, T[-1, 2, 3], points)
    frame, track, pixel = [], [], []
    wrong_ids = rng.random(points) < wrong
    for k, pose in enumerate(T):
        local = (world - pose[:3, 3]) @ pose[:3, :3]
        uv, valid = camera.project(local)
        valid &= (uv >= 2).all(axis=1) & (uv < 317).all(axis=1) & (local[:, 2] > 2e-3) & (local[:, 2] < 0.06)
        uv = uv + noise_px * rng.standard_normal(uv.shape)
        uv[wrong_ids] += rng.uniform(-40, 40, (wrong_ids.sum(), 2))
        ids = np.flatnonzero(valid & (uv >= 0).all(axis=1) & (uv < 319).all(axis=1))[:150]
        frame.append(np.full(len(ids), k))
        track.append(ids)
        pixel.append(uv[ids])
    return tracks_from_table(np.concatenate(frame), np.concatenate(track), np.concatenate(pixel), len(T))


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
@pytest.mark.parametrize("seed", [1, 2])
def test_one_scale_runs_through_and_directions_are_right(camera, seed):
    T = poses(seed)
    motions = measure_motions(observed(T, camera, seed), camera, np.arange(FRAMES) / 3)
    i, j = (np.round(t * 3).astype(int) for t in (motions.t_i_s, motions.t_j_s))
    assert len(motions) > 0.9 * (FRAMES - 1) and motions.meta["maps"] == 1
    truth = se3.inverse(T[i]) @ T[j]
    size, measured = (np.linalg.norm(m[:, :3, 3], axis=1) for m in (truth, motions.T_i_j))
    ratio = size / measured
    halves = [np.median(part) for part in np.array_split(ratio, 2)]
    assert abs(halves[0] / halves[1] - 1) < 0.05
    scale = np.median(ratio)
    off = se3.log(se3.inverse(motions.T_i_j) @ truth_in_units(truth, scale))
    assert np.degrees(np.median(np.linalg.norm(off[:, :3], axis=1))) < 0.15
    assert np.median(np.linalg.norm(off[:, 3:], axis=1) * scale) < 0.08 * np.median(size)
    # The covariances are meant for tracked patches, whose errors drift; on white noise they are on the safe side.
    nees = np.einsum("ni,nij,nj->n", off, np.linalg.inv(motions.cov), off) / 6
    assert 0.02 < np.median(nees) < 2


def truth_in_units(truth, scale):
    out = truth.copy()
    out[:, :3, 3] /= scale
    return out


def test_a_blind_stretch_is_left_out_and_the_rest_measured():
    T = poses(3)
    tracks = observed(T, PINHOLE, 3)
    blind = (tracks.frame >= 24) & (tracks.frame < 27)
    tracks = tracks_from_table(tracks.frame[~blind], tracks.track[~blind] + 5000 * (tracks.frame[~blind] >= 27),
                               tracks.pixel[~blind], FRAMES)
    motions = measure_motions(tracks, PINHOLE, np.arange(FRAMES) / 3)
    measured = set(np.round(motions.t_i_s * 3).astype(int))
    assert not measured & {23, 24, 25, 26}
    assert motions.meta["maps"] == 2 and len(measured) > 35
    sd = np.sqrt(np.einsum("nii->ni", motions.cov)[:, 3:].max(axis=1)) / np.linalg.norm(motions.T_i_j[:, :3, 3], axis=1)
    before = np.round(motions.t_i_s * 3) < 24
    assert max(np.median(sd[before]), np.median(sd[~before])) > 0.3  # the other map's unit is its own
    assert min(np.median(sd[before]), np.median(sd[~before])) < 0.3


@pytest.mark.parametrize("tracks", [
    tracks_from_table([0, 1, 2], [1, 1, 1], [[10.0, 10], [11, 10], [12, 10]]),
    tracks_from_table(np.repeat([0, 1, 2], 40), np.tile(np.arange(40), 3),
                      np.tile(np.random.default_rng(0).uniform(20, 300, (40, 2)), (3, 1))),
], ids=["one track", "no motion"])
def test_tracks_without_parallax_are_refused_in_one_line(tracks):
    with pytest.raises(TrackingError, match="parallax") as error:
        measure_motions(tracks, PINHOLE, np.arange(3.0))
    assert "\n" not in str(error.value)


def test_real_features_of_euroc_agree_with_its_truth(shared_data):
    gtsam = pytest.importorskip("gtsam")
    import importlib.util
    from pathlib import Path

    from vio import open_recording

    spec = importlib.util.spec_from_file_location(
        "eqvio_tracks", Path(__file__).parents[2] / "benchmarks" / "eqvio_tracks.py")
    eqvio = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(eqvio)
    frames, tracks = eqvio.load_eqvio_tracks(Path(gtsam.findExampleDataFile("eqvio_processed_30s.csv")))
    recording = open_recording(shared_data / "euroc_v101")
    index = frames[::4]
    motions = measure_motions(tracks, eqvio.CAMERA, recording.truth.t_s[frames], frame_indices=index)
    T = recording.truth.T_world_body[frames] @ recording.calibration.T_body_camera
    i, j = (np.searchsorted(recording.truth.t_s[frames], t - 1e-6) for t in (motions.t_i_s, motions.t_j_s))
    truth = se3.inverse(T[i]) @ T[j]
    size, measured = (np.linalg.norm(m[:, :3, 3], axis=1) for m in (truth, motions.T_i_j))
    ratio = np.array([np.median(part) for part in np.array_split((size / measured)[size > 0.02], 4)])
    assert len(motions) > 100
    assert ratio.std() / ratio.mean() < 0.1  # measured 0.04: one scale over 22 s
    off = se3.log(se3.inverse(motions.T_i_j) @ truth_in_units(truth, ratio.mean()))
    assert np.degrees(np.median(np.linalg.norm(off[:, :3], axis=1))) < 0.1  # measured 0.05
    assert np.median(np.linalg.norm(off[:, 3:], axis=1)) * ratio.mean() < 8e-3  # measured 3 mm of 80


# ---- with depth ------------------------------------------------------------------------------

def recording_of(frames):
    t_ns = (np.arange(frames) * 1e9 / 3).astype(np.int64)
    imu = ImuSamples(t_ns, np.zeros((frames, 3)), np.tile([0, 0, 9.81], (frames, 1)))
    return Recording("synthetic", t_ns, imu, Calibration(PINHOLE, np.eye(4), ImuNoise(), 0.0))


def depth_at_tracks(T, tracks, seed, relative, points=1500):
    """A depth map that holds the true depth, with noise, under every observation."""
    rng, world = np.random.default_rng([seed, 3]), wall(seed, T[-1, 2, 3], points)

    def depth(k):
        image = np.zeros((320, 320), np.float32)
        rows = tracks.frame == k
        local = (world[tracks.track[rows]] - T[k, :3, 3]) @ T[k, :3, :3]
        x, y = np.round(tracks.pixel[rows]).astype(int).T
        image[y, x] = local[:, 2] * (1 + relative * rng.standard_normal(len(local)))
        return image

    return depth


def test_depth_gives_metric_motions_with_honest_covariances():
    T, noise = poses(5), DepthNoise(pixel_px=0.3, depth_relative=0.02)
    tracks = observed(T, PINHOLE, 5)
    motions = measure_motions_with_depth(recording_of(FRAMES), depth_at_tracks(T, tracks, 5, 0.02), noise, tracks)
    assert len(motions) == FRAMES - 1
    off = se3.log(se3.inverse(motions.T_i_j) @ (se3.inverse(T[:-1]) @ T[1:]))
    assert np.median(np.linalg.norm(off[:, 3:], axis=1)) < 2e-4  # of steps of 1 mm
    nees = np.einsum("ni,nij,nj->n", off, np.linalg.inv(motions.cov), off) / 6
    assert 0.4 < np.mean(nees) < 2.5


def test_motion_from_depth_needs_depth_and_a_camera():
    T = poses(6, 5)
    tracks = observed(T, PINHOLE, 6)
    with pytest.raises(TrackingError, match="depth"):
        measure_motions_with_depth(recording_of(5), lambda k: None, tracks=tracks)
    blind = dataclasses.replace(recording_of(5), calibration=Calibration(None, np.eye(4), ImuNoise(), 0.0))
    with pytest.raises(TrackingError, match="intrinsics"):
        measure_motions_with_depth(blind, lambda k: None, tracks=tracks)
    with pytest.raises(TrackingError, match="image"):
        measure_recording(blind)


def test_pairs_are_those_that_a_plain_search_finds_in_any_block(monkeypatch):
    T, seed = poses(7, 9), 7
    tracks = observed(T, PINHOLE, seed)
    keep = np.random.default_rng(7).random(len(tracks)) < 0.8
    keep &= tracks.frame != 4  # nothing seen in one frame: two pairs fall out
    tracks = dataclasses.replace(tracks, frame=tracks.frame[keep], track=tracks.track[keep], pixel=tracks.pixel[keep])
    depth = depth_at_tracks(T, tracks, seed, 0.0)
    whole = fit_pairs(tracks, PINHOLE, depth, DepthNoise())
    assert whole.frame.tolist() == [0, 1, 2, 5, 6, 7]
    rows = [set(tracks.track[tracks.frame == k]) for k in range(9)]
    assert whole.points.tolist() == [len(rows[k] & rows[k + 1]) for k in whole.frame]
    monkeypatch.setattr(depth_odometry, "PAIRS_AT_ONCE", 2)
    parts = fit_pairs(tracks, PINHOLE, depth, DepthNoise())
    np.testing.assert_allclose(parts.T_i_j, whole.T_i_j, atol=1e-12)
    np.testing.assert_allclose(parts.cov, whole.cov, rtol=1e-6)
