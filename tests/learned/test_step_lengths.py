"""Lengths of refined steps in the warp and beside it: only where they are known, and depth becomes metric."""

import json

import numpy as np
import pytest
import torch

from fusion.cli import main
from fusion.teaching import teaching_trajectories
from learned.dataset import TripletDataset
from learned.errors import CheckpointError, TrainingError
from learned.losses.step_lengths import length_difference, with_length
from learned.measured import measure
from learned.methods import assemble, method_config
from learned.objective import Objective
from learned.train_config import train_config
from learned.training import Trainer, train
from learned.training_source import SourceSettings
from vio import se3
from vio.camera import Camera
from vio.errors import ConfigError, TrajectoryError, UsageError
from vio.formats.tum import write_tum
from vio.trajectory import Trajectory

CAMERA = Camera("pinhole", 64, 64, 42, 44, 30.5, 33.0)
SMALL = SourceSettings(height=32, width=32)
UNIT_M = 0.02


def tiny(**options):
    method = method_config("gyro-correlation", width=0.125, image_size=(64, 64), branch={"dropout": 0.0})
    return train_config(method, **{"steps": 2, "batch_size": 2, "validate_every": 2, "precision": "float32",
                                   "light_start_steps": 0, "length_from": "refined", "length_weight": 1.0} | options)


def motions(rng: torch.Generator, count: int) -> torch.Tensor:
    T = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    T[:, :3, 3] = 0.1 * torch.randn(count, 3, generator=rng, dtype=torch.float64)
    return T


def test_a_known_length_takes_the_networks_place_and_leaves_the_direction():
    T = motions(torch.Generator().manual_seed(1), 4).requires_grad_()
    step_m = torch.tensor([0.004, 0.001, torch.nan, 0.0])
    out = with_length(T, step_m, UNIT_M)
    length = out[:, :3, 3].norm(dim=1)
    torch.testing.assert_close(length[:2], step_m[:2].double() / UNIT_M)
    torch.testing.assert_close(out[2], T[2])
    assert length[3] == 0
    cosine = (out[:2, :3, 3] * T[:2, :3, 3]).sum(1) / length[:2] / T[:2, :3, 3].norm(dim=1)
    torch.testing.assert_close(cosine, torch.ones(2, dtype=torch.float64))
    out.sum().backward()
    along = (T.grad[:2, :3, 3] * T[:2, :3, 3]).sum(1)  # a longer step of the network changes nothing
    torch.testing.assert_close(along, torch.zeros(2, dtype=torch.float64), atol=1e-9, rtol=0)
    still = with_length(torch.eye(4)[None].requires_grad_(), torch.tensor([0.004]), UNIT_M)
    assert torch.isfinite(still).all()


def test_the_loss_is_the_log_ratio_of_lengths_and_leaves_depth_alone():
    rng = torch.Generator().manual_seed(3)
    depth = (0.3 * torch.randn(5, 1, 8, 8, generator=rng, dtype=torch.float64)).exp().requires_grad_()
    share = motions(rng, 5)[:, :3, 3].requires_grad_()
    T = torch.eye(4, dtype=torch.float64).repeat(5, 1, 1)
    shift = share * depth.log().mean((1, 2, 3)).exp()[:, None]
    T = torch.cat([T[:, :, :3], torch.cat([shift, torch.ones(5, 1)], 1)[..., None]], 2)
    known = UNIT_M * shift.norm(dim=1).detach()
    assert length_difference(T, known, UNIT_M, depth).item() < 1e-12
    loss = length_difference(T, 1.5 * known, UNIT_M, depth)
    assert loss.item() == pytest.approx(np.log(1.5))
    loss.backward()
    assert depth.grad.abs().max() < 1e-12
    assert ((share.grad * share).sum(1) < 0).all()  # longer is better


def test_unknown_and_vanishing_steps_count_for_nothing():
    T = torch.eye(4).repeat(3, 1, 1)
    T[:2, 0, 3] = 0.07
    T.requires_grad_()
    loss = length_difference(T, torch.tensor([0.0021, torch.nan, 0.004]), UNIT_M, None)
    assert loss.item() == pytest.approx(abs(np.log(0.0021 / UNIT_M / 0.07)), rel=1e-4)
    loss.backward()
    assert torch.isfinite(T.grad).all() and not T.grad[1:].any()
    assert length_difference(T, torch.full((3,), torch.nan), UNIT_M, None).item() == 0
    short = length_difference(T, torch.tensor([0.0021, 1e-5, torch.nan]), UNIT_M, None)
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
    """The same film of a ball of half a unit and of three: only the lengths of the walk tell them apart."""
    depths = []
    for size in (0.01, 0.06):
        T_world_camera = ball.truth.T_world_body @ ball.calibration.T_body_camera
        T_world_camera[:, :3, 3] *= size
        path = Trajectory(ball.truth.t_s, T_world_camera @ se3.inverse(ball.calibration.T_body_camera))
        config = tiny(steps=60, learning_rate=3e-3, validate_every=60, warm_up_steps=0, ema_decay=0.0)
        run = train([ball], config, tmp_path / str(size), trajectories=[path], alone=True)
        depths.append(measure(run.method, config.depth_kind, ball).depth)
    assert np.log(np.median(depths[1]) / np.median(depths[0])) > 0.2


def test_teaching_without_a_teacher_is_refused(ball, tmp_path):
    with pytest.raises(TrainingError, match="no recording has one"):
        Trainer([ball], tiny(), tmp_path)
    method = method_config("af-sfmlearner", width=0.125, image_size=(64, 64))
    with pytest.raises(ConfigError, match="do not go with the loss of af-sfmlearner"):
        Objective(assemble(method), train_config(method, length_weight=0.3))


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


def test_the_command_line_teaches_and_goes_on_from_weights(written, tmp_path, capsys):
    film = written(tmp_path, CAMERA)
    free = run_folder(tmp_path / "free", film.truth, "free")
    chosen = tmp_path / "c.yaml"
    chosen.write_text("unit_depth_weight: 0.07\nprecision: float32\n")
    command = ["train", str(tmp_path / "ball"), "--width", "0.125", "--image-size", "64", "64", "--steps", "1",
               "--batch-size", "2", "--device", "cpu", "--config", str(chosen), "--refined", str(free)]

    def trained(name: str, *more: str) -> torch.Tensor:
        out = tmp_path / name
        main([*command, "--out", str(out), *more])
        decided = json.loads((out / "config.json").read_text())
        assert decided["length_from"] == "refined" and decided["unit_depth_weight"] == 0.07
        assert {"step_lengths", "nearness"} <= set((out / "train.csv").read_text().splitlines()[0].split(","))
        stem: torch.Tensor = torch.load(out / "checkpoint.pt", weights_only=True)["model"]["depth.encoder.conv1.weight"]
        return stem

    first = trained("one")
    seeded, went_on = (trained(f"two{len(more)}", "--seed", "9", *more)
                       for more in ((), ("--start-from", str(tmp_path / "one" / "weights.safetensors"))))
    assert (went_on - first).abs().max() < 0.01 < 0.1 < (seeded - first).abs().max()
    capsys.readouterr()
    assert main([*command, str(free), "--out", str(tmp_path / "three")]) == UsageError("").exit_code
    assert "2 runs for 1 recordings" in capsys.readouterr().err
