"""Depth-aligned motions: exact where depth is exact, honest where it is not, and refused in one line."""

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

import learned
from fusion.cli import main
from learned.aligned_calibration import Aligned, align, aligned_nees, measured_noise, network_correlation, tracks_of
from learned.calibration import write_calibrated
from learned.depth_aligned import aligned_model_from_dict, depth_aligned_motions
from learned.errors import WeightsError
from learned.inference import SIGNALS
from learned.measured import measure
from learned.methods import build_method
from learned.network_predictor import NetworkPredictor, predictor_for
from learned.train_config import train_config
from learned.training import TrainedRun
from learned.uncertainty import UncertaintyModel
from learned.weights import load_weights, rewrite_card
from vio import se3
from vio.camera import Camera
from vio.errors import ConfigError, RecordingError, TrackingError
from vio.formats.asl import read_asl
from vio.motions import load_motions

CAMERA = Camera("pinhole", 64, 64, 42, 44, 30.5, 33.0, (-0.1, 0.02, 0.004, -0.003))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("aligned")


@pytest.fixture
def ball(folder, written):
    return read_asl(folder / "ball") if (folder / "ball").is_dir() else written(folder, CAMERA)


@pytest.fixture
def file(folder, ball):
    path = folder / "small.safetensors"
    if not path.is_file():
        method = build_method("gyro-correlation", width=0.125, image_size=(64, 64), seed=3).eval()
        write_calibrated(TrainedRun(method, train_config(method.config, steps=1), 1, False, 0, {"loss": 1.0}), [ball],
                         [replace(ball, name=f"again {k}") for k in range(5)], path)
    return path


@dataclass(frozen=True)
class Knowing(NetworkPredictor):
    """Takes the depth from the recording; frames come in order, each once."""

    truth: tuple = ()

    def depth(self, frames, imu_windows):
        """True depth of the next frames."""
        first = len(asked)
        asked.extend(range(len(frames)))
        return torch.from_numpy(np.stack(self.truth[first : first + len(frames)]))


asked: list[int] = []


def true_motions(recording):
    T = recording.truth_at_frames().T_world_body @ recording.calibration.T_body_camera
    return se3.inverse(T[:-1]) @ T[1:]


def test_exact_depth_gives_exact_motions(file, ball):
    weights = load_weights(file)
    weights.card["depth_aligned"] |= {"pixel_px": 0.3, "depth_relative": 0.01}  # of true depth, not of the network's
    predictor = predictor_for(ball, weights)
    knowing = Knowing(**{name: getattr(predictor, name) for name in predictor.__dataclass_fields__},
                      truth=tuple(ball.depth_m(k) for k in range(len(ball))))
    asked.clear()
    motions = depth_aligned_motions(ball, knowing, batch_size=4)
    assert len(asked) == len(ball) and len(motions) == len(ball) - 1 and motions.meta["pairs_left_out"] == 0
    xi = se3.log(se3.inverse(motions.T_i_j) @ true_motions(ball))
    step = np.linalg.norm(true_motions(ball)[:, :3, 3], axis=1)
    assert np.degrees(np.median(np.linalg.norm(xi[:, :3], axis=1))) < 0.5  # of turns of 4 to 5 degrees
    assert np.median(np.linalg.norm(xi[:, 3:], axis=1) / step) < 0.1


def test_any_batch_size_gives_the_same_and_progress_is_told(file, ball):
    seen = []
    one = depth_aligned_motions(ball, file, batch_size=4, progress=lambda done, total: seen.append((done, total)))
    other = depth_aligned_motions(ball, file, batch_size=15)
    np.testing.assert_allclose(one.T_i_j, other.T_i_j, atol=1e-4)
    np.testing.assert_allclose(one.cov, other.cov, rtol=1e-2)
    assert seen == [(4, 15), (8, 15), (12, 15), (15, 15)]
    card = load_weights(file).card["depth_aligned"]
    assert (one.scale_log_mean, one.scale_log_sd) == (card["scale_log_mean"], card["scale_log_sd"])
    assert one.meta["network_correlation"] == card["network_correlation"]


def test_calibration_measures_noise_and_makes_honest_covariances(file, ball):
    weights = load_weights(file)
    model, m = aligned_model_from_dict(weights.card["depth_aligned"]), measure(
        weights.method, weights.card["depth_kind"], ball)
    tracks = tracks_of(m)
    rng = np.random.default_rng(1)
    for sd_px, sd_depth in ((0.0, 0.05), (0.8, 0.2)):
        noisy = replace(tracks, pixel=tracks.pixel + rng.normal(0, sd_px, tracks.pixel.shape))
        maps = (m.depth_true_m * np.exp(rng.normal(0, sd_depth, m.depth.shape))).astype(np.float32)
        noise = measured_noise([(replace(m, depth=maps), noisy)])
        assert noise.depth_relative == pytest.approx(sd_depth, rel=0.15)
        assert noise.pixel_px < 0.3 if sd_px == 0 else noise.pixel_px > 0.9
    nees = aligned_nees([align(m, tracks, model.noise)], model)
    assert 0.5 < nees.mean() < 2
    assert measured_noise([]) is None and tracks_of(replace(m, images=np.zeros_like(m.images))) is None


def test_correlation_is_that_of_the_errors(file, ball):
    weights = load_weights(file)
    m, rng = measure(weights.method, weights.card["depth_kind"], ball), np.random.default_rng(2)
    model = aligned_model_from_dict(weights.card["depth_aligned"])
    one = align(m, tracks_of(m), model.noise)
    flat = UncertaintyModel((), np.zeros(0), np.zeros(0), np.log([[0.02]] * 3 + [[0.05]] * 3), np.eye(6))
    flat_model = replace(model, uncertainty=flat)

    def pair(share: float) -> Aligned:
        """Both sources off by normal errors with a known share in common, at scale 1."""
        n = 4000
        rows = rng.integers(0, len(one.fits.frame), n)
        a = rng.normal(0, 1, (n, 6))
        b = share * a + np.sqrt(1 - share**2) * rng.normal(0, 1, (n, 6))
        true = one.pairs.T_true_m[rows]
        scale = np.array([0.02] * 3 + [0.05] * 3) * 0.1
        parts = {key: getattr(one.pairs, key)[rows] for key in ("images", "depth", "signals", "step_s")}
        pairs = replace(one.pairs, T_true_m=true, T_i_j=true @ se3.inverse(se3.exp(b * scale)), gyro=None,
                        depth_true_m=None, **parts)
        fits = replace(one.fits, frame=np.arange(n), T_i_j=true @ se3.inverse(se3.exp(a * scale)),
                       cov=one.fits.cov[rows], points=one.fits.points[rows], middle=one.fits.middle[rows])
        return Aligned(pairs, fits)

    assert len(SIGNALS) == m.signals.shape[1]
    for share in (0.0, 0.6, 1.0):
        found = network_correlation([pair(share)], flat_model, flat)
        np.testing.assert_allclose(found["per_axis"], share, atol=0.06)
        assert found["rotation"] == pytest.approx(np.mean(found["per_axis"][:3]))


def test_the_command_writes_motions_and_refuses_what_it_cannot_do(file, ball, folder, tmp_path, capsys):
    command = ["predict", str(folder / "ball"), "--method", "depth-aligned", "--weights", str(file),
               "--out", str(tmp_path / "m.npz")]
    assert main(command) == 0
    written = load_motions(tmp_path / "m.npz")
    assert len(written) == len(ball) - 1 and written.meta["method"].startswith("depth-aligned")
    for more in (["--depth", str(tmp_path / "d")], ["--rotation", "gyro"]):
        assert main([*command, *more]) == 2
        assert "belong to --method learned" in capsys.readouterr().err
    assert not (tmp_path / "d").exists()


def test_what_cannot_be_measured_is_refused_in_one_line(file, ball, tmp_path):
    old = tmp_path / "old.safetensors"
    rewrite_card(file, old, {"depth_aligned": None})
    dark = tmp_path / "dark.png"
    dark.write_bytes((ball.frame_paths[0]).read_bytes())
    import cv2

    cv2.imwrite(str(dark), np.zeros((64, 64, 3), np.uint8))
    cases = [
        (lambda: depth_aligned_motions(ball, old), WeightsError, "never calibrated for depth-aligned"),
        (lambda: depth_aligned_motions(replace(ball, frame_paths=(dark,) * len(ball)), file), TrackingError, "texture"),
        (lambda: depth_aligned_motions(replace(ball, frame_paths=()), file), RecordingError, "images missing"),
        (lambda: depth_aligned_motions(ball, file, batch_size=0), ConfigError, "batch_size is 0"),
        (lambda: aligned_model_from_dict({"pixel_px": 1}), WeightsError, "incomplete"),
        (lambda: aligned_model_from_dict(json.loads(json.dumps(load_weights(file).card["depth_aligned"]))
                                         | {"depth_relative": -1}), WeightsError, "finite and positive"),
    ]
    for call, kind, text in cases:
        with pytest.raises(kind, match=text) as caught:
            call()
        assert "\n" not in str(caught.value)
    broken = tmp_path / "cut.png"
    broken.write_bytes(ball.frame_paths[3].read_bytes()[:100])
    paths = (*ball.frame_paths[:3], broken, *ball.frame_paths[4:])
    with pytest.raises(RecordingError, match="frame 3"):
        depth_aligned_motions(replace(ball, frame_paths=paths), file)


def test_it_is_public():
    assert learned.depth_aligned_motions is depth_aligned_motions
