"""Standard deviations of predicted depth: right where the truth is known, honest on disk, and absent where unknown."""

import json
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import learned
from learned.calibration import extend_card, write_calibrated
from learned.depth_calibration import depth_coverage
from learned.depth_uncertainty import (
    PixelErrors,
    choose_pixel_signals,
    depth_uncertainty_from_dict,
    fit_depth_uncertainty,
)
from learned.errors import NetworkInputError, TrainingError, WeightsError
from learned.measured import measure
from learned.methods import build_method
from learned.network_predictor import NetworkPredictor, predictor_for
from learned.pixel_signals import PIXEL_SIGNALS, off_axis_angle, pixel_signals
from learned.train_config import train_config
from learned.training import TrainedRun
from learned.weights import load_weights, rewrite_card
from vio.camera import Camera
from vio.formats.asl import read_asl

CAMERA = Camera("pinhole", 64, 64, 42, 44, 30.5, 33.0, (-0.1, 0.02, 0.004, -0.003))


def pixels_with(weights: dict[str, float], seed: int, count: int = 20_000, dof: float = np.inf) -> tuple:
    """Pixels whose errors have a known sd: ln sd = -2 + Σ weight · signal."""
    rng = np.random.default_rng(seed)
    signals = rng.normal(0, 1, (count, len(PIXEL_SIGNALS)))
    used = np.clip(signals, -2.4, 2.4)
    sd = np.exp(-2 + sum(w * used[:, PIXEL_SIGNALS.index(name)] for name, w in weights.items()))
    draws = rng.standard_normal(count) if np.isinf(dof) else rng.standard_t(dof, count) / np.sqrt(dof / (dof - 2))
    common = rng.normal(0, 0.3, 200).repeat(count // 200)
    return PixelErrors(sd * draws, common, 0.5 * common, signals, np.arange(count) * 6 // count), sd


WEIGHTS = st.dictionaries(st.sampled_from(PIXEL_SIGNALS), st.sampled_from([-0.5, -0.25, 0.25, 0.5]), min_size=1,
                          max_size=3)


@settings(max_examples=4)
@given(WEIGHTS, st.integers(0, 99))
def test_known_deviations_are_found_again(weights, seed):
    pixels, sd = pixels_with(weights, seed)
    chosen, gains = choose_pixel_signals(pixels)
    assert set(chosen) == set(weights) and set(gains) == set(PIXEL_SIGNALS)
    model = fit_depth_uncertainty(pixels, chosen)
    found = model.of_rows(pixels.signals)
    inside = (np.abs(pixels.signals) < 2.4).all(axis=1)
    assert np.abs(np.log(found / sd))[inside].max() < 0.15
    assert model.interval_95 == pytest.approx(1.96, abs=0.06)
    assert model.common_log_sd == pytest.approx(0.3, rel=0.15)
    assert model.image_log_sd == pytest.approx(0.5 * model.common_log_sd)
    fresh, sd_fresh = pixels_with(weights, seed + 1000)
    within = np.abs(fresh.error) <= model.interval_95 * model.of_rows(fresh.signals)
    assert within.mean() == pytest.approx(0.95, abs=0.01)
    assert np.sqrt(np.mean((fresh.error / sd_fresh) ** 2)) == pytest.approx(1, abs=0.03)


def test_heavy_tails_widen_the_interval_not_the_deviation():
    heavy, sd = pixels_with({"depth": 0.3}, 5, 100_000, dof=3.5)
    model = fit_depth_uncertainty(heavy, ["depth"])
    assert np.median(model.of_rows(heavy.signals) / sd) == pytest.approx(1, abs=0.1)
    fresh, _ = pixels_with({"depth": 0.3}, 6, 100_000, dof=3.5)
    within = np.abs(fresh.error) <= model.interval_95 * model.of_rows(fresh.signals)
    assert within.mean() == pytest.approx(0.95, abs=0.01)


def test_one_recording_chooses_nothing_and_no_errors_fit_nothing():
    pixels, _ = pixels_with({"depth": 0.5}, 1)
    alone = replace(pixels, recording=np.zeros_like(pixels.recording))
    assert choose_pixel_signals(alone) == ([], {})
    with pytest.raises(TrainingError, match="not made by the predictor"):
        fit_depth_uncertainty(replace(pixels, error=np.zeros_like(pixels.error)), [])


def maps(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    rng = torch.Generator().manual_seed(seed)
    depth = torch.exp(0.3 * torch.randn(2, 64, 64, generator=rng))
    return torch.rand(2, 3, 64, 64, generator=rng), depth, torch.from_numpy(off_axis_angle(CAMERA))


def test_maps_and_rows_agree():
    pixels, _ = pixels_with({"depth": 0.5, "luminance": -0.3}, 3)
    model = fit_depth_uncertainty(pixels, ["luminance", "depth"])
    signals = pixel_signals(*maps())
    rows = signals.permute(0, 2, 3, 1).reshape(-1, len(PIXEL_SIGNALS)).double().numpy()
    np.testing.assert_allclose(model.deviations(signals).numpy().ravel(), model.of_rows(rows), rtol=1e-4)


@given(st.floats(0.1, 10), st.integers(0, 50))
@settings(max_examples=10)
def test_only_the_depth_signal_knows_the_unit(factor, seed):
    frames, depth, angle = maps(seed)
    before, after = pixel_signals(frames, depth, angle), pixel_signals(frames, factor * depth, angle)
    expected = before.clone()
    expected[:, 0] += np.log(factor)
    torch.testing.assert_close(after, expected, atol=2e-4, rtol=1e-4)
    flipped = pixel_signals(frames.flip(-1), depth.flip(-1), angle.flip(-1))
    torch.testing.assert_close(flipped.flip(-1), before, atol=1e-5, rtol=1e-5)


def test_a_ramp_has_its_slope_and_unknown_pixels_have_no_edge():
    ramp = torch.exp(0.07 * torch.arange(64.0)).expand(1, 64, 64).clone()
    frames, _, angle = maps()
    edge = pixel_signals(frames[:1], ramp, angle)[0, PIXEL_SIGNALS.index("edge")]
    torch.testing.assert_close(edge[:, 1:-1].exp(), torch.full((64, 62), 0.08), atol=1e-5, rtol=1e-4)
    flat = torch.ones(1, 64, 64)
    flat[:, 20:30] = 0
    signals = pixel_signals(frames[:1], flat, angle)
    assert torch.isfinite(signals).all() and (signals[0, :3].abs() < 1e-6).all()
    assert torch.isfinite(pixel_signals(frames[:1], torch.zeros(1, 64, 64), angle)).all()
    with pytest.raises(NetworkInputError, match="not of one size"):
        pixel_signals(frames, flat, angle)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("depth_sd")


@pytest.fixture
def ball(folder, written):
    return read_asl(folder / "ball") if (folder / "ball").is_dir() else written(folder, CAMERA)


def others(ball):
    return [replace(ball, name=f"again {k}") for k in range(5)]


@pytest.fixture
def file(folder, ball):
    """Weights of an untrained network, calibrated: its depth is bad, and it must say so."""
    path = folder / "small.safetensors"
    if not path.is_file():
        method = build_method("gyro-correlation", width=0.125, image_size=(64, 64), seed=3).eval()
        write_calibrated(TrainedRun(method, train_config(method.config, steps=1), 1, False, 0, {"loss": 1.0}), [ball],
                         others(ball), path)
    return path


def test_sd_maps_lie_beside_the_depth_and_hold_what_they_promise(file, ball, tmp_path):
    card = load_weights(file).card
    unit_m = float(np.exp(card["scale_log_mean"])) / 1000
    found = learned.predict(ball, file, depth_dir=tmp_path / "d", depth_unit_m=unit_m)
    said = json.loads((tmp_path / "d" / "prediction.json").read_text())["depth_uncertainty"]
    assert said["interval_95"] == card["depth_uncertainty"]["interval_95"] and len(found.depth_sd) == len(ball)
    within, at_prior = [], []
    for k in range(len(ball)):
        depth, sd = (cv2.imread(str(f[k]), cv2.IMREAD_UNCHANGED) for f in (found.depth, found.depth_sd))
        assert sd.dtype == np.uint16 and sd.shape == depth.shape and ((sd == 0) == (depth == 0)).all()
        true, known = ball.depth_m(k), depth > 0
        known &= true > 0
        off, log_sd = np.log(true[known] / (depth[known] * unit_m)), sd[known] * 1e-4
        within.append(np.abs(off - np.median(off)) <= said["interval_95"] * log_sd)
        at_prior.append(np.abs(off) <= said["prior_interval_95"] * np.hypot(log_sd, said["common_log_sd"]))
    assert np.mean(np.concatenate(within)) == pytest.approx(0.95, abs=0.03)
    assert np.mean(np.concatenate(at_prior)) == pytest.approx(0.95, abs=0.03)


def test_weights_that_cannot_say_write_no_sd_and_tell(file, ball, tmp_path):
    old = tmp_path / "old.safetensors"
    rewrite_card(file, old, {"depth_uncertainty": None})
    found = learned.predict(ball, old, depth_dir=tmp_path / "d")
    assert found.depth_sd is None and not (tmp_path / "d" / "sd").exists()
    assert "never calibrated" in json.loads((tmp_path / "d" / "prediction.json").read_text())["depth_uncertainty"]
    assert "log_depth_sd_unit" not in (tmp_path / "d" / "sensor.yaml").read_text()
    assert learned.predict(ball, old).depth_sd is None


@pytest.mark.parametrize("wrong", [lambda sd: sd * torch.nan, lambda sd: -sd, lambda sd: sd[:, 1:]])
def test_a_predictor_that_breaks_its_word_about_depth_leaves_nothing(file, ball, tmp_path, wrong):
    class Broken(NetworkPredictor):
        def log_depth_sd(self, frames, z_depth):
            return wrong(super().log_depth_sd(frames, z_depth))
    whole = predictor_for(ball, load_weights(file))
    broken = Broken(**{name: getattr(whole, name) for name in whole.__dataclass_fields__})
    with pytest.raises(learned.PredictionError, match="log_depth_sd of frames 0 to 7"):
        learned.predict(ball, broken, depth_dir=tmp_path / "d")
    assert not (tmp_path / "d").exists()


def test_sd_maps_survive_an_interruption(file, ball, tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules["learned.prediction_run"], "PAIRS_KEPT", 4)  # the name is the function's too
    whole = predictor_for(ball, load_weights(file))
    calls = []

    class Stopped(NetworkPredictor):
        def log_depth_sd(self, frames, z_depth):
            calls.append(len(frames))
            if len(calls) == 3:
                raise KeyboardInterrupt
            return super().log_depth_sd(frames, z_depth)
    stopped = Stopped(**{name: getattr(whole, name) for name in whole.__dataclass_fields__})
    options = {"batch_size": 4, "unfinished": tmp_path / "unfinished"}
    with pytest.raises(KeyboardInterrupt):
        learned.predict(ball, stopped, depth_dir=tmp_path / "d", **options)
    again = learned.predict(ball, stopped, depth_dir=tmp_path / "d", **options)
    assert len(calls) == 5  # two batches were kept
    once = learned.predict(ball, whole, depth_dir=tmp_path / "once", batch_size=4)
    for name in ("depth", "depth_sd"):
        assert [f.read_bytes() for f in getattr(again, name)] == [f.read_bytes() for f in getattr(once, name)]


def test_a_card_is_extended_without_touching_the_weights(file, ball, tmp_path):
    whole, old = load_weights(file), tmp_path / "old.safetensors"
    rewrite_card(file, old, {"depth_uncertainty": None, "depth_aligned": None})
    card = extend_card(old, old, others(ball))
    again = load_weights(old)
    assert again.card == card and card["sha256"] == whole.card["sha256"]
    for name in ("depth_uncertainty", "depth_aligned"):
        assert card[name]["signals" if name == "depth_uncertainty" else "pairs"] == whole.card[name][
            "signals" if name == "depth_uncertainty" else "pairs"]
    assert {k: v for k, v in card.items() if not k.startswith("depth_")} == {
        k: v for k, v in whole.card.items() if not k.startswith("depth_")}
    with pytest.raises(WeightsError, match="sha256 describes the tensors"):
        rewrite_card(file, tmp_path / "x.safetensors", {"sha256": "0"})
    with pytest.raises(TrainingError, match="do not suffice for depth_uncertainty and depth_aligned"):
        extend_card(old, tmp_path / "x.safetensors", [replace(ball, depth_paths=())])
    rewrite_card(old, old, {"uncertainty": None})
    with pytest.raises(WeightsError, match="motions were never calibrated"):
        extend_card(old, old, [ball])


@pytest.mark.parametrize("change", [
    {"interval_95": None}, {"interval_95": -1.0}, {"signals": ["colour"], "mean": [0.0], "sd": [1.0], "log_sd": [0, 1]},
    {"mean": [1.0] * 9}, {"log_sd": [float("nan")]}, {"common_log_sd": 0.0},
    {"image_log_sd": -0.1}])
def test_broken_cards_are_refused_in_one_line(change):
    pixels, _ = pixels_with({"depth": 0.5}, 3)
    values = fit_depth_uncertainty(pixels, ["depth"]).to_dict()
    assert depth_uncertainty_from_dict(json.loads(json.dumps(values))).to_dict() == values
    with pytest.raises(WeightsError, match="calibrate again") as caught:
        depth_uncertainty_from_dict(values | change)
    assert "\n" not in str(caught.value)
    with pytest.raises(WeightsError, match="incomplete"):
        depth_uncertainty_from_dict({"signals": []})


def test_coverage_counts_what_is_wrong(file, ball):
    weights = load_weights(file)
    measured, scale = measure(weights.method, weights.card["depth_kind"], ball), weights.card["scale_log_mean"]
    model = depth_uncertainty_from_dict(weights.card["depth_uncertainty"])
    honest = depth_coverage([measured], model, scale)
    assert honest.image == pytest.approx(0.95, abs=0.03) and honest.rms_over_sd == pytest.approx(1, abs=0.15)
    smaller = replace(model, log_sd=model.log_sd - [np.log(4), *[0] * len(model.signals)])
    boast = depth_coverage([measured], smaller, scale)
    assert boast.image < 0.75 and boast.rms_over_sd == pytest.approx(4 * honest.rms_over_sd, rel=1e-6)
    assert depth_coverage([replace(measured, depth_true_m=None)], model, scale) is None
