"""Weights and their card, prediction with them, covariances that are as large as errors, and a gyro that corrects."""

import json
import pickle
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import safetensors
import torch
from safetensors.torch import load_file, save_file

import learned
from learned.calibration import calibrated, write_calibrated
from learned.errors import TrainingError, WeightsError
from learned.evaluation import depth_score, motion_score, trivial_depths, trivial_motions
from learned.gyro_update import with_gyro
from learned.inference import SIGNALS, distinct, estimate_pairs
from learned.measured import Measured, measure
from learned.methods import build_method
from learned.report import evaluate, format_evaluation
from learned.train_config import train_config
from learned.training import TrainedRun
from learned.uncertainty import choose_signals, fit_uncertainty, motion_nees, uncertainty_from_dict
from learned.weights import load_weights, save_weights
from vio import se3
from vio.camera import Camera
from vio.errors import CameraError, ConfigError, ImuError, RecordingError
from vio.formats.asl import read_asl
from vio.imu import ImuSamples

CAMERA = Camera("pinhole", 64, 64, 42, 44, 30.5, 33.0, (-0.1, 0.02, 0.004, -0.003))
CARD = {"depth_kind": "range", "scale_log_mean": -3.9, "scale_log_sd": 0.2, "uncertainty": None}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("recording")


@pytest.fixture
def ball(folder, written):
    return read_asl(folder / "ball") if (folder / "ball").is_dir() else written(folder, CAMERA)


def small(seed: int = 3):
    return build_method("gyro-correlation", width=0.125, image_size=(64, 64), seed=seed).eval()


@pytest.fixture
def file(folder, ball) -> Path:
    """Calibrated weights of an untrained network: covariances must be honest all the same."""
    path = folder / "small.safetensors"
    if not path.is_file():
        config = train_config(small().config, steps=1)
        run = TrainedRun(small(), config, 1, False, 0, {"loss": 1.0})
        write_calibrated(run, [ball], [replace(ball, name=f"again {k}") for k in range(5)], path)
    return path


def test_weights_survive_the_file_in_half_its_size(tmp_path):
    method = small()
    whole, half = tmp_path / "whole.safetensors", tmp_path / "half.safetensors"
    save_weights(whole, method, CARD, half=False)
    digest = save_weights(half, method, CARD)
    assert half.stat().st_size < 0.65 * whole.stat().st_size
    exact, rounded = load_weights(whole), load_weights(half)
    assert rounded.card["sha256"] == digest and rounded.method.config == method.config
    for name, value in method.state_dict().items():
        assert torch.equal(exact.method.state_dict()[name], value)
        torch.testing.assert_close(rounded.method.state_dict()[name], value, rtol=1e-3, atol=1e-7)
    assert not rounded.method.training
    first = half.read_bytes()
    assert save_weights(half, method, CARD) == digest and half.read_bytes() == first


def test_wrong_files_are_refused_in_one_line(tmp_path):
    path = tmp_path / "w.safetensors"
    save_weights(path, small(), CARD)
    with safetensors.safe_open(path, "pt") as opened:
        metadata, tensors = opened.metadata(), load_file(path)
    first = next(name for name in tensors if tensors[name].ndim == 4)

    def rewritten(change, card=None):
        changed = dict(tensors)
        change(changed)
        save_file(changed, path, metadata if card is None else {"card": json.dumps(card)})
        return path
    whole = json.loads(metadata["card"])
    other = build_method("gyro-correlation", width=0.25, image_size=(64, 64))
    cases = [
        (lambda: rewritten(lambda t: t.update({first: t[first] + 0.01})), "SHA-256"),
        (lambda: rewritten(lambda t: t.pop(first)), "SHA-256"),
        (lambda: rewritten(lambda t: None, whole | {"sha256": "0" * 64}), "was changed"),
        (lambda: rewritten(lambda t: None, {k: v for k, v in whole.items() if k != "method"}), "lacks method"),
        (lambda: rewritten(lambda t: None, whole | {"schema": 99}), "schema 99"),
        (lambda: rewritten(lambda t: None, whole | {"method": {"name": "yolo"}}), "cannot build"),
        (lambda: rewritten(lambda t: None, whole | {"method": whole["method"] | {"width": 0.25}}), "another shape"),
        (lambda: rewritten(lambda t: None, whole | {"method": whole["method"] | {"vibration": False}}), "unknown"),
        (lambda: save_file(tensors, path) or path, "no card"),
        (lambda: path.write_bytes(path.read_bytes()[:2000]) and path, "damaged"),
        (lambda: path.write_bytes(pickle.dumps({"a": 1})) and path, "pickle"),
        (lambda: torch.save(other.state_dict(), path) or path, "pickle"),
        (lambda: tmp_path / "nowhere.safetensors", "No such file"),
        (lambda: tmp_path, "Is a directory"),
    ]
    for make, text in cases:
        where = make()
        with pytest.raises(WeightsError, match=text) as caught:
            load_weights(where)
        assert "\n" not in str(caught.value) and str(tmp_path) not in str(caught.value)


def test_the_bundled_weights_are_small_whole_and_say_what_they_are():
    weights = load_weights()
    assert weights.card["sha256"] and weights.card["truth_in_training"] is False
    assert weights.card["licence"] == "Apache-2.0" and weights.card["calibrated_on"]["seeds"]
    assert not set(weights.card["calibrated_on"]["seeds"]) & set(weights.card["data"]["seeds"])
    assert (weights.method.config.name, weights.method.config.vibration) == ("gyro-correlation", True)
    assert weights.method.config.fusion.strategy == "fourier"
    from learned.weights import bundled_path

    assert bundled_path().stat().st_size < 16e6
    uncertainty_from_dict(weights.card["uncertainty"])


def test_prediction_is_whole_and_the_same_at_any_batch_size(file, ball, tmp_path):
    unit_m = float(np.exp(load_weights(file).card["scale_log_mean"])) / 1000  # an untrained scale is far off
    one, many = (learned.predict(ball, file, batch_size=size, depth_dir=tmp_path / str(size), depth_unit_m=unit_m)
                 for size in (1, 5))
    np.testing.assert_allclose(one.T_i_j, many.T_i_j, atol=1e-6)
    np.testing.assert_allclose(one.cov, many.cov, rtol=1e-3)
    assert len(one) == len(ball) - 1 and len(one.depth) == len(ball) and (one.snr > 0).all()
    assert one.meta["rotation"] == "network" and len(one.meta["predictor"]["sha256"]) == 64
    depth = cv2.imread(str(one.depth[3]), cv2.IMREAD_UNCHANGED)
    assert depth.shape == (64, 64) and (depth > 0).mean() > 0.9
    assert (np.linalg.eigvalsh(one.cov) > 0).all()


def test_the_gyro_takes_over_where_it_knows_better(file, ball):
    alone, corrected = (learned.predict(ball, file, rotation=rotation) for rotation in ("network", "gyro"))
    truth = ball.truth_at_frames()
    T_world_camera = truth.T_world_body @ ball.calibration.T_body_camera
    true = se3.inverse(T_world_camera[:-1]) @ T_world_camera[1:]

    def angle(T):
        return np.linalg.norm(se3.so3_log(np.swapaxes(T[:, :3, :3], 1, 2) @ true[:, :3, :3]), axis=1)
    assert angle(corrected.T_i_j).mean() < 0.05 * angle(alone.T_i_j).mean()
    assert (np.diagonal(corrected.cov, axis1=1, axis2=2)[:, :3] < np.diagonal(alone.cov, axis1=1, axis2=2)[:, :3]).all()
    assert corrected.meta["rotation"] == "gyro" and corrected.meta["pairs_without_gyro"] == 0
    with pytest.raises(ConfigError, match="rotation 'both'"):
        learned.predict(ball, file, rotation="both")


def test_recordings_that_do_not_fit_are_refused_by_name(file, ball, tmp_path):
    def of(camera=None, imu=None):
        calibration = ball.calibration if camera is None else replace(ball.calibration, camera=camera)
        return replace(ball, calibration=calibration, imu=ball.imu if imu is None else imu)
    nothing = ImuSamples(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
    with pytest.raises(ImuError, match=r"ball: 0 inertial samples.*small\.safetensors look at vibration"):
        learned.predict(of(imu=nothing), file)
    with pytest.raises(CameraError, match="focal length is 120 \\(limit: 34 to 5"):
        learned.predict(of(replace(CAMERA, fx=120, fy=120)), file)
    with pytest.raises(CameraError, match="squeezed"):
        learned.predict(of(replace(CAMERA, fx=60)), file)
    with pytest.raises(CameraError, match="no camera is calibrated"):
        learned.predict(replace(ball, calibration=replace(ball.calibration, camera=None)), file)
    broken = [tmp_path / f"{k}.png" for k in range(len(ball))]
    for path, whole in zip(broken, ball.frame_paths, strict=True):
        path.write_bytes(whole.read_bytes()[:300])
    with pytest.raises(RecordingError, match="no two frames to compare can be read; frame 0"):
        learned.predict(replace(ball, frame_paths=tuple(broken)), file)
    save_weights(tmp_path / "raw.safetensors", small(), CARD)
    with pytest.raises(WeightsError, match="never calibrated"):
        learned.predict(ball, tmp_path / "raw.safetensors")


def test_frames_of_another_size_bring_their_intrinsics_along(file, ball, tmp_path):
    paths = []
    for k, path in enumerate(ball.frame_paths):
        image = cv2.resize(cv2.imread(str(path)), (128, 128), interpolation=cv2.INTER_NEAREST)
        paths.append(tmp_path / f"{k}.png")
        cv2.imwrite(str(paths[-1]), image)
    large = replace(ball, frame_paths=tuple(paths),
                    calibration=replace(ball.calibration, camera=CAMERA.resized(128, 128)))
    np.testing.assert_allclose(learned.predict(large, file).T_i_j, learned.predict(ball, file).T_i_j, atol=1e-6)


# ---------------------------------------------------------------- uncertainty


def heteroscedastic(count: int, seed: int):
    """Errors whose size follows the first of three signals, correlated between rotation y and translation x."""
    rng = np.random.default_rng(seed)
    signals = rng.normal(0, 1, (count, 3))
    correlation = np.eye(6)
    correlation[1, 3] = correlation[3, 1] = 0.6
    sd = np.exp(np.array([-5, -5, -5.5, -4, -4, -3.5]) + 0.7 * signals[:, [0]])
    return sd * (rng.normal(0, 1, (count, 6)) @ np.linalg.cholesky(correlation).T), signals, sd, correlation


def test_the_fit_finds_the_law_that_made_the_errors():
    errors, signals, sd, correlation = heteroscedastic(4000, 1)
    names = ("a", "b", "c")
    recording = np.arange(4000) // 400
    assert choose_signals(errors, signals, names, recording) == ["a"]
    model = fit_uncertainty(errors, signals, names, ["a"])
    np.testing.assert_allclose(model.correlation, correlation, atol=0.05)
    inside = np.abs(signals[:, 0]) < 2
    np.testing.assert_allclose(model.deviations(signals, names)[inside], sd[inside], rtol=0.1)
    fresh, new_signals, *_ = heteroscedastic(4000, 2)
    assert motion_nees(fresh, model.covariance(new_signals, names)).mean() == pytest.approx(1, abs=0.06)
    flat = fit_uncertainty(errors, signals, names, [])
    assert motion_nees(errors, flat.covariance(signals, names)).mean() == pytest.approx(1, abs=0.02)
    again = uncertainty_from_dict(json.loads(json.dumps(model.to_dict())))
    np.testing.assert_array_equal(again.covariance(signals, names), model.covariance(signals, names))
    with pytest.raises(WeightsError, match="incomplete"):
        uncertainty_from_dict({"signals": []})
    with pytest.raises(WeightsError, match="parts of shapes"):
        uncertainty_from_dict(model.to_dict() | {"signals": ["a", "b"]})


def test_signals_of_noise_are_not_chosen():
    errors, signals, *_ = heteroscedastic(600, 3)
    rng = np.random.default_rng(4)
    assert choose_signals(errors, rng.normal(0, 1, signals.shape), ("x", "y", "z"), np.arange(600) // 60) == []


def test_the_update_is_the_joint_estimate_of_motions_and_bias():
    # N motions and one bias, all Gaussian: the dense joint solution against bias first, then motion by motion.
    rng = np.random.default_rng(5)
    n, noise_sd, prior_sd, dt = 7, 0.003, 0.009, 0.4
    root = rng.normal(0, 0.02, (n, 6, 6))
    cov = root @ np.swapaxes(root, 1, 2) + 1e-6 * np.eye(6)
    T = se3.exp(rng.normal(0, 0.1, (n, 6)))
    turn = rng.normal(0, 1e-4, (n, 3))  # small, so that the manifold is flat
    prior = np.zeros((6 * n + 3, 6 * n + 3))
    prior[-3:, -3:] = prior_sd**2 * np.eye(3)
    H = np.zeros((3 * n, 6 * n + 3))
    for k in range(n):
        prior[6 * k:6 * k + 6, 6 * k:6 * k + 6] = cov[k]
        H[3 * k:3 * k + 3, 6 * k:6 * k + 3], H[3 * k:3 * k + 3, -3:] = np.eye(3), dt * np.eye(3)
    gain = prior @ H.T @ np.linalg.inv(H @ prior @ H.T + noise_sd**2 * np.eye(3 * n))
    mean, joint = gain @ turn.ravel(), prior - gain @ H @ prior
    bias, bias_cov = mean[-3:], joint[-3:, -3:]

    R_gyro = T[:, :3, :3] @ se3.so3_exp(turn - dt * bias)
    new, after = with_gyro(T, cov, R_gyro, np.full(n, noise_sd**2), np.broadcast_to(dt**2 * bias_cov, (n, 3, 3)))
    np.testing.assert_allclose(se3.log(se3.inverse(T) @ new), mean[:-3].reshape(n, 6), rtol=1e-3, atol=1e-9)
    for k in range(n):
        np.testing.assert_allclose(after[k], joint[6 * k:6 * k + 6, 6 * k:6 * k + 6], rtol=1e-6, atol=1e-12)


# ---------------------------------------------------------------- evaluation


def perfect(m: Measured, unit_m: float = 0.02) -> Measured:
    """True predictions for the ball shrunk to the size of a gut."""
    T, T_true, depth = m.T_true_m.copy(), m.T_true_m.copy(), m.depth_true_m * np.float32(0.04)
    T_true[:, :3, 3] *= 0.04
    T[:, :3, 3] = T_true[:, :3, 3] / unit_m
    return replace(m, T_i_j=T, T_true_m=T_true, depth_true_m=depth, depth=depth / np.float32(unit_m))


def test_truth_scores_best_and_in_any_unit(ball):
    m = measure(small(), "range", ball)
    true = perfect(m)
    score = depth_score([true.depth], [true])
    assert score.abs_rel_image < 1e-5 and score.acc_sequence == 1 and score.scale_sd < 1e-5
    motion = motion_score([true.T_i_j], [true])
    assert motion.rotation_deg < 1e-6 and motion.direction_deg < 1e-3 and motion.step_mm < 1e-9
    assert true.log_scale == pytest.approx(np.log(0.02)) and np.abs(true.errors(true.log_scale)).max() < 1e-9
    tilted = depth_score([true.depth * np.linspace(0.5, 1.5, 64, dtype=np.float32)], [true])
    assert tilted.abs_rel_image == pytest.approx(0.25, abs=0.03)  # |k - 1| averaged over 0.5 … 1.5
    guesses = trivial_depths([true], [np.ones((64, 64), np.float32)])
    assert all(depth_score(maps, [true]).abs_rel_image > 0.01 for maps in guesses.values())
    rest = motion_score(trivial_motions([true])["identity"], [true])
    assert rest.direction_deg == pytest.approx(90)
    assert rest.rotation_deg == pytest.approx(np.degrees(np.linalg.norm(se3.so3_log(
        true.T_true_m[:, :3, :3]), axis=1)).mean())


def test_evaluation_and_calibration_of_a_recording(file, ball):
    weights = load_weights(file)
    found = evaluate([ball], weights)
    assert 0.5 < found.nees < 1.1  # calibrated on this recording's like, which turns about one axis only
    assert found.motion["network with gyro"].rotation_deg < found.motion["network"].rotation_deg
    text = format_evaluation(found)
    assert "geometric mean" in text and "NEES" in text
    json.dumps(found.to_dict(), allow_nan=False)
    with pytest.raises(TrainingError, match="14 pairs with truth in 1 recordings"):
        calibrated([measure(weights.method, "range", ball)])


def test_both_orders_are_averaged_and_no_pair_sees_another(ball):
    method = small()
    m = measure(method, "range", ball)
    from learned.camera_rays import camera_batch
    from learned.training_source import SourceSettings, TrainingSource

    source = TrainingSource(ball, SourceSettings(64, 64))
    frames = source.frames(np.array([5, 6]))[None].float() / 255
    windows = torch.from_numpy(source.vibration(np.array([5]))).float().transpose(1, 2)
    alone = estimate_pairs(method, frames, windows, camera_batch([source.camera]), "range")
    np.testing.assert_allclose(alone.T_i_j[0], m.T_i_j[5], atol=1e-5)
    assert alone.signals.shape == (1, len(SIGNALS)) and torch.isfinite(alone.signals).all()


def test_a_header_whose_length_looks_like_a_pickle_is_read(tmp_path):
    path, method, starts = tmp_path / "weights.safetensors", small(), set()
    for k in range(0, 257, 8):  # headers are padded to eight bytes; the lowest byte of their length comes first
        save_weights(path, method, CARD | {"remark": "x" * k})
        starts.add(path.read_bytes()[0])
        load_weights(path)
    assert 0x80 in starts


def test_frames_that_two_pairs_share_are_shown_once():
    frame = torch.rand(6, 3, 8, 8)
    pairs = torch.stack([torch.stack([frame[a], frame[b]]) for a, b in ((0, 1), (1, 2), (3, 4), (4, 5))])
    shots = distinct(pairs)
    assert len(shots.frames) == 6 and shots.pair == [0, 1, 1, 2, 3, 3]
    for k in range(4):
        assert torch.equal(torch.stack([shots.frames[shots.i[k]], shots.frames[shots.j[k]]]), pairs[k])
    assert [shots.pair[i] for i in shots.i] == [0, 1, 2, 3] and all(np.array(shots.i) < shots.j)
