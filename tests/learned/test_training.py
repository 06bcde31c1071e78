"""Training: resumed to the bit, the same in several processes, blind to truth, and going downhill."""

import csv
import dataclasses
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from learned.averaging import WeightAverage
from learned.checkpoints import load_checkpoint, save_checkpoint
from learned.dataset import TripletDataset, collate
from learned.errors import CheckpointError, NetworkInputError, TrainingError, WeightsError
from learned.lie import inverse, so3_exp, transform
from learned.methods import method_config
from learned.objective import Objective, tied
from learned.train_config import (
    BOOKKEEPING,
    TrainConfig,
    different_decisions,
    train_config,
    train_config_from_dict,
    train_config_to_dict,
)
from learned.train_log import TrainLog
from learned.training import Trainer, rate, source_settings, train
from vio.camera import Camera
from vio.errors import ConfigError
from vio.formats.asl import read_asl

ROOT = Path(__file__).resolve().parents[2]
CAMERA = Camera("pinhole", 64, 64, 42, 44, 30.5, 33.0, (-0.1, 0.02, 0.004, -0.003))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("recording")


@pytest.fixture
def ball(folder, written):
    """One recording of the ball, written once."""
    return read_asl(folder / "ball") if (folder / "ball").is_dir() else written(folder, CAMERA)


def tiny(name: str = "gyro-correlation", dropout: float = 0.8, **options) -> TrainConfig:
    extra = {"layers": 18} if name != "endodac" else {"transformer": "small", "train_transformer": True}
    method = method_config(name, width=0.125, image_size=(64, 64), branch={"dropout": dropout}, **extra)
    return train_config(method, **{"steps": 6, "batch_size": 2, "log_every": 1, "validate_every": 3,
                                   "checkpoint_every": 1, "precision": "float32", "light_start_steps": 2} | options)


def weights(trainer_or_path) -> dict[str, torch.Tensor]:
    return torch.load(trainer_or_path, weights_only=True)["average"]


SCRIPT = """
import sys, json
from pathlib import Path
import torch
from learned.train_config import train_config_from_dict
from learned.training import train
from vio.formats.asl import read_asl
torch.set_num_threads(1)
config = train_config_from_dict(json.loads(sys.argv[3]))
train([read_asl(Path(sys.argv[1]))], config, sys.argv[2], device="cpu")
"""


def start(ball, out, config, *launcher) -> subprocess.Popen:
    import json

    script = out.parent / f"{out.name}.py"
    script.write_text(SCRIPT)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    return subprocess.Popen([sys.executable, *launcher, str(script), str(ball_folder(ball)), str(out),
                             json.dumps(train_config_to_dict(config))], env=environment, cwd=ROOT,
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def ball_folder(ball) -> Path:
    return ball.frame_paths[0].parents[3]


def test_a_killed_run_ends_with_the_weights_of_an_uninterrupted_one(ball, tmp_path):
    config = tiny(steps=9, ema_decay=0.9, log_every=2)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        process = start(ball, tmp_path / "killed", config)
        deadline = time.monotonic() + 120
        while process.poll() is None and time.monotonic() < deadline:
            rows = (tmp_path / "killed" / "train.csv")
            if rows.is_file() and rows.read_text().count("\n") >= 4:
                break
            time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        reached = torch.load(tmp_path / "killed" / "checkpoint.pt", weights_only=True)["step"]
        assert 0 < reached < 9
        resumed = train([ball], config, tmp_path / "killed", device="cpu")
        whole = train([ball], config, tmp_path / "whole", device="cpu")
    finally:
        torch.set_num_threads(threads)
    assert resumed.step == whole.step == 9
    for one, other in ((resumed.method.state_dict(), whole.method.state_dict()),
                       (weights(tmp_path / "killed" / "checkpoint.pt"), weights(tmp_path / "whole" / "checkpoint.pt"))):
        assert list(one) == list(other) and all(torch.equal(one[name], other[name]) for name in one)
    for log in ("train.csv", "validation.csv"):
        assert (tmp_path / "killed" / log).read_bytes() == (tmp_path / "whole" / log).read_bytes()


def test_two_processes_take_the_mean_gradient(ball, tmp_path):
    config = tiny(steps=1, batch_size=1, ema_decay=0.0, validate_every=9, light_start_steps=0, dropout=0.0)
    process = start(ball, tmp_path / "two", config, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node",
                    "2")
    _, errors = process.communicate(timeout=200)
    assert process.returncode == 0, errors.decode()[-2000:]
    found = torch.load(tmp_path / "two" / "checkpoint.pt", weights_only=True)
    assert found["world"] == 2 and len(found["rng"]) == 2

    trainer, each = Trainer([ball], config, tmp_path / "alone"), []
    initial = {name: value.clone() for name, value in trainer.method.state_dict().items()}
    for rank in range(2):
        trainer.method.load_state_dict(initial)
        trainer.optimiser.zero_grad(set_to_none=True)
        chosen = list(torch.utils.data.DistributedSampler(trainer.data, 2, rank, seed=0, drop_last=True))[:1]
        trainer.objective(collate([trainer.data[k] for k in chosen]), 0)[0].backward()
        each.append({name: value.grad.clone() for name, value in trainer.method.named_parameters()})
    steps = {name: found["model"][name] - initial[name] for name in each[0]}
    mean = {name: 0.5 * (each[0][name] + each[1][name]) for name in each[0]}
    size = config.learning_rate * rate(config, 0)  # of Adam's first step, which goes against the gradient's sign

    def agreement(gradient):
        return torch.cat([(steps[name] + size * torch.sign(gradient[name])).abs()[mean[name].abs() > 1e-4] < 0.1 * size
                          for name in mean])
    assert len(agreement(mean)) > 1000 and agreement(mean).float().mean() > 0.99
    assert all(agreement(alone).float().mean() < 0.95 for alone in each)


@pytest.mark.parametrize("name", ["endosfmlearner", "af-sfmlearner", "ra-depth", "endodac", "gyro-correlation"])
@pytest.mark.parametrize("loss", ["native", "paper"])
def test_every_method_steps_and_every_trained_weight_moves(ball, tmp_path, name, loss):
    if name == "endodac":
        pytest.importorskip("transformers")
    trainer = Trainer([ball], tiny(name, loss=loss, learning_rate=1e-3, batch_size=1, light_start_steps=0), tmp_path)
    before = {key: value.clone() for key, value in trainer.method.named_parameters()}
    parts = trainer._one_step(trainer.objective, next(trainer._batches()))
    assert all(torch.isfinite(value).all() for value in parts.values()) and trainer.skipped == 0
    moved = {key for key, value in trainer.method.named_parameters() if not torch.equal(value, before[key])}
    stages = {"depth", "pose"} | ({"optical_flow", "appearance_flow"} if trainer.objective.with_flows else set())
    for part in stages:
        mine = [key for key in before if key.startswith(part + ".") and before[key].requires_grad]
        assert len(moved & set(mine)) > 0.5 * len(mine), part


def test_training_goes_downhill_and_the_snr_is_logged(ball, tmp_path):
    config = tiny(steps=30, light_start_steps=0, warm_up_steps=0, validate_every=15, ema_decay=0.0)
    run = train([ball], config, tmp_path)
    with (tmp_path / "train.csv").open() as file:
        rows = list(csv.DictReader(file))
    loss = np.array([float(row["loss"]) for row in rows])
    assert len(rows) == 30 and loss[-8:].mean() < 0.9 * loss[:8].mean()
    snr = np.array([[float(row[f"snr_{net}_{block}_mean"]) for net in ("depth", "pose") for block in range(5)]
                    for row in rows])
    assert (np.abs(snr[-1] - snr[0]) > 1e-3).all()
    assert all(float(row[f"snr_depth_{block}_sd"]) > 0 for row in rows for block in range(5))
    assert run.validation["loss"] > 0 and len((tmp_path / "validation.csv").read_text().splitlines()) == 3


def test_no_truth_enters_training(ball, tmp_path):
    blind = dataclasses.replace(ball, truth=None, truth_state=None, depth_paths=())
    seen, unseen = (train([recording], tiny(steps=2), tmp_path / name).method.state_dict()
                    for recording, name in ((ball, "seen"), (blind, "unseen")))
    assert all(torch.equal(seen[name], unseen[name]) for name in seen)


def test_the_gyros_rotation_warps_and_teaches(ball):
    config = tiny(batch_size=1)
    data = TripletDataset([ball], source_settings(config), "train", augment=False)
    batch = collate([data[2]])
    trainer_method = Trainer([ball], config, Path("unused")).method
    objective = Objective(trainer_method.eval(), config).eval()
    with torch.no_grad():
        wrong = dataclasses.replace(batch, R_i_j_gyro=batch.R_i_j_gyro.transpose(2, 3))
        right, turned = objective(batch, 0)[1], objective(wrong, 0)[1]
        assert right["photometric"] < turned["photometric"]
        assert right["gyro_rotation"] > 0.01
        with pytest.raises(NetworkInputError, match="no inertial samples"):
            objective(dataclasses.replace(batch, R_i_j_gyro=None), 0)


def test_one_motion_a_pair_holds_the_scale_of_both_directions(ball):
    turn = so3_exp(torch.tensor([[0.1, -0.2, 0.05]]))
    there, back = (transform(turn, length * torch.tensor([[1.0, 2.0, -1.0]])) for length in (1.0, 1.6))
    one = tied({(0, 1): there, (1, 0): inverse(back)})
    torch.testing.assert_close(one[0, 1], transform(turn, 1.3 * torch.tensor([[1.0, 2.0, -1.0]])))
    torch.testing.assert_close(one[0, 1] @ one[1, 0], torch.eye(4)[None])
    torch.testing.assert_close(tied(one)[1, 0], one[1, 0])

    batch = collate([TripletDataset([ball], source_settings(tiny()), "train", augment=False)[2]])
    method = Trainer([ball], tiny(), Path("unused")).method.eval()
    losses = []
    for ties in (True, False):
        method.zero_grad()
        loss = Objective(method, tiny(tied_motions=ties)).eval()(batch)[0]
        loss.backward()
        losses.append(loss.item())
        assert all(p.grad.isfinite().all() for p in method.parameters() if p.grad is not None)
    assert losses[0] != losses[1]


def test_validation_leaves_the_run_as_it_was(ball, tmp_path):
    often, never = (train([ball], tiny(steps=4, validate_every=every), tmp_path / str(every)).method.state_dict()
                    for every in (1, 100))
    assert all(torch.equal(often[name], never[name]) for name in often)


def test_frozen_batch_norms_train_as_they_are_used(ball, tmp_path):
    warm = train([ball], tiny(steps=3, ema_decay=0.0), tmp_path / "warm").method.state_dict()
    config = tiny(freeze_batch_norm=True, dropout=0.0, light_start_steps=0, ema_decay=0.0)
    trainer = Trainer([ball], config, tmp_path, start_from=warm)
    assert all(torch.equal(value, warm[name]) for name, value in trainer.method.state_dict().items())
    for start, says in (({"a": torch.zeros(1)}, "they lack"), (warm | {"a": torch.zeros(1)}, "unknown a"),
                        ({name: value[..., None] for name, value in warm.items()}, "another shape")):
        with pytest.raises(WeightsError, match=f"^start weights: .*{says}"):
            Trainer([ball], config, tmp_path, start_from=start)
    batch = next(trainer._batches())
    with torch.no_grad():
        training, use = trainer.objective(batch, 0)[0], trainer.objective.eval()(batch, 0)[0]
    torch.testing.assert_close(training, use)
    trainer._one_step(trainer.objective.train(), batch)
    after = trainer.method.state_dict()
    assert all(torch.equal(after[name], warm[name]) for name in warm if "running" in name)
    assert not torch.equal(after["pose.rotation.weight"], warm["pose.rotation.weight"])


def test_it_stops_when_validation_no_longer_improves(ball, tmp_path):
    run = train([ball], tiny(steps=50, validate_every=1, patience=2, learning_rate=1e-12, ema_decay=0.0,
                             light_start_steps=0), tmp_path)
    assert run.stopped_early and run.step < 50
    again = train([ball], tiny(steps=50, validate_every=1, patience=2, learning_rate=1e-12, ema_decay=0.0,
                               light_start_steps=0), tmp_path)
    assert again.step == run.step


def test_losses_that_stay_infinite_end_the_run(ball, tmp_path, monkeypatch):
    trainer = Trainer([ball], tiny(batch_size=1), tmp_path)
    before = {name: value.clone() for name, value in trainer.method.named_parameters()}

    def broken(batch, step, stage):
        bad = sum(p.sum() for p in trainer.method.parameters()) * float("nan")
        return bad, {"photometric": bad.detach()}
    monkeypatch.setattr("learned.training.MOST_LOST", 3)
    batch = next(trainer._batches())
    trainer._one_step(broken, batch)
    assert trainer.skipped == 1
    assert all(torch.equal(value, before[name]) for name, value in trainer.method.named_parameters())
    trainer._one_step(broken, batch)
    with pytest.raises(TrainingError, match=r"3 steps.*photometric"):
        trainer._one_step(broken, batch)


def test_a_checkpoint_of_another_run_is_refused(ball, tmp_path):
    config = tiny(steps=1, validate_every=9)
    train([ball], config, tmp_path)
    with pytest.raises(CheckpointError, match="another learning_rate"):
        train([ball], dataclasses.replace(config, learning_rate=5e-4), tmp_path)
    assert ball.name.encode() not in (tmp_path / "checkpoint.pt").read_bytes()  # a name may be a patient's
    with pytest.raises(CheckpointError, match="other recordings"):
        train([dataclasses.replace(ball, name="another")], config, tmp_path)
    with pytest.raises(CheckpointError, match="1 process"):
        load_checkpoint(tmp_path / "checkpoint.pt", config, 2, [])
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(CheckpointError, match="damaged"):
        train([ball], config, tmp_path)
    save_checkpoint(path, config, {"step": 1})
    with pytest.raises(CheckpointError, match="not written by this version"):
        train([ball], config, tmp_path)


def test_decisions_survive_their_file_and_bookkeeping_does_not_count():
    config = train_config("gyro-correlation", steps=77, workers=2)
    import json

    again = train_config_from_dict(json.loads(json.dumps(train_config_to_dict(config))))
    assert again == config
    assert (config.learning_rate, config.batch_size, config.rotation_from) == (1e-3, 4, "gyro")
    for name in ("endosfmlearner", "af-sfmlearner", "ra-depth", "endodac"):
        paper = train_config(name)
        assert (paper.learning_rate, paper.batch_size, paper.schedule, paper.rotation_from) == (
            1e-4, 4, "constant", "network")
    assert different_decisions(config, dataclasses.replace(config, steps=5, workers=0)) == []
    assert different_decisions(config, dataclasses.replace(config, seed=5)) == ["seed"]
    assert set(BOOKKEEPING) <= set(train_config_to_dict(config))
    for options, text in (({"steps": 0}, "steps is 0"), ({"loss": "mine"}, "loss 'mine'"), ({"colour": 1}, "colour"),
                          ({"ema_decay": 1.0}, "ema_decay"), ({"clip_norm": -1.0}, "clip_norm")):
        with pytest.raises(ConfigError, match=text):
            train_config("gyro-correlation", **options)


def test_the_schedule_warms_up_and_ends_low():
    config = train_config("gyro-correlation", steps=1000)
    rates = np.array([rate(config, step) for step in range(1000)])
    assert rates[0] == pytest.approx(1 / 50, rel=1e-3) and rates.argmax() in (49, 50)
    assert (np.diff(rates[60:]) < 0).all() and rates[-1] == pytest.approx(0.03, abs=1e-3)
    assert rate(train_config("ra-depth"), 12345) == 1.0


def test_the_average_is_the_weighted_mean():
    layer = torch.nn.BatchNorm1d(2)
    average, expected = WeightAverage(layer, 0.5), layer.weight.detach().clone()
    for k in range(1, 40):
        with torch.no_grad():
            layer.weight.fill_(float(k))
        layer.num_batches_tracked.fill_(k)
        stay = min(0.5, (1 + k) / (10 + k))
        expected = stay * expected + (1 - stay) * k
        average.update(layer)
    torch.testing.assert_close(average.values["weight"], expected)
    assert average.values["num_batches_tracked"] == 39


def test_a_log_drops_what_lies_after_the_checkpoint(tmp_path):
    log = TrainLog(tmp_path / "log.csv")
    for step in (1, 2, 3):
        log.write(step, {"loss": 1 / step, "other": 2.0})
    TrainLog(tmp_path / "log.csv", 2).write(3, {"loss": 9.0})
    assert (tmp_path / "log.csv").read_text().split() == ["step,loss,other", "1,1,2", "2,0.5,2", "3,9,"]


