"""Lengths of refined steps teach depth: through depth alone, only where they are known, and it works."""

import json

import numpy as np
import pytest
import torch

from fusion.cli import main
from fusion.teaching import teaching_trajectories
from learned.dataset import TripletDataset
from learned.errors import CheckpointError, TrainingError
from learned.losses.step_lengths import UNIT_M, depth_from_steps
from learned.measured import measure
from learned.methods import method_config
from learned.train_config import MEASURED_STEP_LENGTH_WEIGHT, train_config
from learned.training import Trainer, train
from learned.training_source import SourceSettings
from vio import se3
from vio.camera import Camera
from vio.errors import ConfigError, TrajectoryError, UsageError
from vio.formats.asl import read_asl
from vio.formats.tum import write_tum
from vio.trajectory import Trajectory

CAMERA = Camera("pinhole", 64, 64, 42, 44, 30.5, 33.0)
SMALL = SourceSettings(height=32, width=32)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("recording")


@pytest.fixture
def ball(folder, written):
    return read_asl(folder / "ball") if (folder / "ball").is_dir() else written(folder, CAMERA)


def tiny(**options):
    method = method_config("gyro-correlation", width=0.125, image_size=(64, 64), branch={"dropout": 0.0})
    return train_config(method, **{"steps": 2, "batch_size": 2, "validate_every": 2, "precision": "float32",
                                   "light_start_steps": 0, "step_length_weight": 1.0} | options)


def steps_of(share: torch.Tensor, depth: torch.Tensor) -> torch.Tensor:
    """`T_i_j` whose translation is `share` (N, 3) of the typical depth."""
    T = torch.eye(4, dtype=depth.dtype).repeat(len(share), 1, 1)
    return torch.cat([torch.cat([T[:, :3, :3], (share * depth.log().mean((1, 2, 3)).exp()[:, None])[..., None]], 2),
                      T[:, 3:]], 1)


def test_the_loss_is_the_log_ratio_and_its_gradient_is_depths_alone():
    rng = torch.Generator().manual_seed(3)
    depth = (0.3 * torch.randn(5, 1, 8, 8, generator=rng, dtype=torch.float64)).exp().requires_grad_()
    share = (0.1 * torch.randn(5, 3, generator=rng, dtype=torch.float64)).requires_grad_()
    T = steps_of(share, depth)
    right = UNIT_M * T[:, :3, 3].norm(dim=1).detach()
    assert depth_from_steps(depth, T, right).item() < 1e-12
    assert depth_from_steps(depth, T, 1.5 * right).item() == pytest.approx(np.log(1.5))
    depth_from_steps(depth, T, 1.5 * right).backward()
    assert share.grad is None or not share.grad.any()
    assert (depth.grad < 0).all()  # deeper is nearer to what the longer step says
    scaled = depth.detach() * 1.5
    assert depth_from_steps(scaled, steps_of(share.detach(), scaled), 1.5 * right).item() < 1e-12


def test_unknown_and_vanishing_steps_count_for_nothing():
    depth = torch.full((3, 1, 4, 4), 0.7, requires_grad=True)
    T = steps_of(torch.tensor([[0.1, 0, 0], [0.1, 0, 0], [0.0, 0, 0]]), depth)
    loss = depth_from_steps(depth, T, torch.tensor([0.0021, torch.nan, 0.004]))
    assert loss.item() == pytest.approx(abs(np.log(0.0021 / UNIT_M / 0.07)), rel=1e-4)
    loss.backward()
    assert torch.isfinite(depth.grad).all() and not depth.grad[1:].any()
    none = depth_from_steps(depth, T, torch.full((3,), torch.nan))
    assert none.item() == 0
    short = depth_from_steps(depth, T, torch.tensor([0.0021, 1e-5, torch.nan]))
    assert short.item() == pytest.approx(loss.item(), rel=1e-2)  # a hundredth of a millimetre says nothing


def test_items_carry_the_cameras_steps_lever_arm_included(ball):
    dataset = TripletDataset([ball, ball], SMALL, "all", trajectories=[ball.truth, None])
    T_i_j = dataset.truth(4).T_i_j
    np.testing.assert_allclose(dataset[4].step_m, T_i_j[:, :3, 3].norm(dim=1), rtol=1e-5)
    assert torch.isnan(dataset[len(dataset) // 2 + 4].step_m).all()
    part = Trajectory(ball.truth.t_s[6:], ball.truth.T_world_body[6:])
    steps = TripletDataset([ball], SMALL, "all", trajectories=[part])
    assert torch.isnan(steps[5].step_m).tolist() == [True, False]
    with pytest.raises(TrajectoryError, match="give its own refinement"):
        TripletDataset([ball], SMALL, "all", trajectories=[Trajectory(ball.truth.t_s + 900, ball.truth.T_world_body)])
    with pytest.raises(ConfigError, match="1 trajectories for 2 recordings"):
        TripletDataset([ball, ball], SMALL, "all", trajectories=[None])


def test_taught_depth_takes_the_size_of_the_world(ball, tmp_path):
    """The same film from a walk of centimetres and of metres: an untrained network sees shorter steps than the walker
    of the one takes, and longer than the other's."""
    depths = []
    for size in (1e-3, 1.0):
        T_world_camera = ball.truth.T_world_body @ ball.calibration.T_body_camera
        T_world_camera[:, :3, 3] *= size
        path = Trajectory(ball.truth.t_s, T_world_camera @ se3.inverse(ball.calibration.T_body_camera))
        config = tiny(steps=25, learning_rate=3e-3, validate_every=25, warm_up_steps=0, ema_decay=0.0)
        run = train([ball], config, tmp_path / str(size), trajectories=[path], alone=True)
        depths.append(measure(run.method, config.depth_kind, ball).depth)
    assert np.log(np.median(depths[1]) / np.median(depths[0])) > 0.2


def test_teaching_without_a_teacher_is_refused(ball, tmp_path):
    with pytest.raises(TrainingError, match="no recording has a refined trajectory"):
        Trainer([ball], tiny(), tmp_path)
    with pytest.raises(ConfigError, match="does not tell translations in depths"):
        train_config("af-sfmlearner", step_length_weight=0.3)


def test_another_teacher_is_another_run(ball, tmp_path):
    train([ball], tiny(), tmp_path, trajectories=[ball.truth], alone=True)
    other = Trajectory(ball.truth.t_s, se3.exp([0, 0, 0, 1, 0, 0]) @ ball.truth.T_world_body)
    other.T_world_body[3, :3, 3] += 0.01
    with pytest.raises(CheckpointError):
        train([ball], tiny(), tmp_path, trajectories=[other], alone=True)


def run_folder(folder, trajectory: Trajectory, policy: str):
    """As much of a refined run as teaching reads."""
    folder.mkdir()
    for name in ("trajectory.tum", "motions_only.tum"):
        write_tum(trajectory, folder / name)
    (folder / "summary.json").write_text(json.dumps({"schema": 1, "scale": {"policy": policy}}))
    return folder


def test_only_runs_with_measured_scale_teach(ball, tmp_path):
    free = run_folder(tmp_path / "free", ball.truth, "free")
    prior = run_folder(tmp_path / "prior", ball.truth, "prior")
    later = run_folder(tmp_path / "later", Trajectory(ball.truth.t_s + 900, ball.truth.T_world_body), "free")
    taught, untaught = teaching_trajectories([ball, ball], [free, prior])
    assert untaught is None
    np.testing.assert_allclose(taught.T_world_body, ball.truth.T_world_body, atol=1e-6)
    for runs, complaint in (([free], "1 runs for 2 recordings"), ([prior, prior], "no run has the scale policy"),
                            ([free, later], "later is not a refinement of ball")):
        with pytest.raises(UsageError, match=complaint):
            teaching_trajectories([ball, ball], runs)


def test_the_command_line_teaches(ball, folder, tmp_path, capsys):
    free = run_folder(tmp_path / "free", ball.truth, "free")
    out = tmp_path / "out"
    command = ["train", str(folder / "ball"), "--width", "0.125", "--image-size", "64", "64", "--steps", "1",
               "--batch-size", "2", "--device", "cpu", "--out", str(out), "--calibrate", str(folder / "ball"),
               "--refined", str(free)]
    main(command)
    assert json.loads((out / "config.json").read_text())["step_length_weight"] == MEASURED_STEP_LENGTH_WEIGHT
    assert "step_lengths" in (out / "train.csv").read_text().splitlines()[0]
    capsys.readouterr()
    assert main([*command, str(free)]) == UsageError("").exit_code
    assert "2 runs for 1 recordings" in capsys.readouterr().err
