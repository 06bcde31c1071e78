"""`capsule-vio train` and `evaluate`, from files to weights that `predict` takes."""

import json

import pytest

from fusion.cli import main
from learned.train_command import config_of
from learned.weights import load_weights
from vio.camera import Camera
from vio.errors import ConfigError

CAMERA = Camera("pinhole", 64, 64, 42, 44, 30.5, 33.0)
TINY = ["--width", "0.125", "--image-size", "64", "64", "--steps", "2", "--batch-size", "2", "--device", "cpu"]


def test_train_calibrate_evaluate_predict(written, tmp_path, capsys):
    train_on, *others = (written(tmp_path, CAMERA, name) for name in ("a", "b", "c", "d", "e", "f"))
    assert len(train_on) == 15
    decisions = tmp_path / "c.yaml"
    decisions.write_text("precision: float32\nvalidate_every: 2\n")
    calibrate = [str(tmp_path / recording.name) for recording in others]
    command = ["train", str(tmp_path / "a"), *TINY, "--config", str(decisions), "--out", str(tmp_path / "RUN")]
    assert main([*command, "--calibrate", *calibrate]) == 0
    assert "2 steps" in capsys.readouterr().out
    weights = tmp_path / "RUN" / "weights.safetensors"
    card = load_weights(weights).card
    assert card["steps"] == 2 and card["calibration"]["pairs"] == 70 and card["training"]["precision"] == "float32"
    assert main(["evaluate", str(tmp_path / "b"), "--weights", str(weights), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["pairs"] == 14
    assert main(["predict", str(tmp_path / "a"), "--weights", str(weights), "--rotation", "gyro",
                 "--out", str(tmp_path / "m.npz")]) == 0
    assert main([*command[:-1], str(tmp_path / "RUN"), "--seed", "7"]) == 3
    assert "another seed" in capsys.readouterr().err


def test_options_become_decisions(tmp_path):
    config = config_of({"method": "ra-depth", "vision_only": True, "steps": 9, "loss": "paper"})
    assert (config.method.name, config.method.vibration, config.steps, config.loss) == ("ra-depth", False, 9, "paper")
    ours = config_of({})
    assert ours.learning_rate == 1e-3 and ours.method.fusion.snr_floor == 1.0 and ours.method.branch.dropout == 0.0
    path = tmp_path / "c.yaml"
    for text, complaint in (("method: ra-depth\n", "decided by --method"), ("colour: 1\n", "unknown option 'colour'")):
        path.write_text(text)
        with pytest.raises(ConfigError, match=complaint):
            config_of({"config": path})
