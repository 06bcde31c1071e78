"""Training items: what they hold is true of the recording, mirrored consistently, and the same in every process."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, DistributedSampler

from learned.camera_rays import camera_batch
from learned.dataset import Triplet, TripletDataset, collate, frames_of_split
from learned.dihedral import SYMMETRIES, UPRIGHT, Symmetry
from learned.losses.consistency import Consistency, consistency_loss
from learned.losses.terms import masked_mean
from learned.training_source import SourceSettings
from learned.truth import shrunk_depth
from learned.warping import synthesise
from vio import se3
from vio.camera import Camera
from vio.errors import ConfigError, ImuError, RecordingError, TrajectoryError
from vio.imu import ImuSamples
from vio.trajectory import Trajectory

SMALL = SourceSettings(height=32, width=32)


def same(one: Triplet, other: Triplet) -> bool:
    return all(torch.allclose(a, b, rtol=0, atol=0, equal_nan=True) if isinstance(a, torch.Tensor) else a == b
               for a, b in zip(vars(one).values(), vars(other).values(), strict=True))


def test_frames_times_and_camera_are_the_recordings(ball):
    dataset = TripletDataset([ball], SMALL, "all", augment=False)
    assert len(dataset) == len(ball) - 2 and not dataset.left_out
    item = dataset[4]
    assert item.index == (4, 5, 6) and item.camera == ball.calibration.camera.resized(32, 32)
    for k, frame in zip(item.index, item.frames, strict=True):
        area = cv2.resize(ball.frame(k), (32, 32), interpolation=cv2.INTER_AREA)
        np.testing.assert_array_equal(frame.permute(1, 2, 0), area)
    np.testing.assert_allclose(item.step_s, np.diff(ball.frame_t_s[4:7]), atol=1e-6)
    batch = collate([item, dataset[0]])
    assert batch.images.dtype == torch.float32 and batch.images.min() >= 0 and 0.5 < batch.images.max() <= 1
    torch.testing.assert_close(batch.images[0] * 255, item.frames.float())
    assert batch.vibration.shape == (2, 3, 6, 40) and batch.index.tolist() == [[4, 5, 6], [0, 1, 2]]


def test_gyro_rotations_are_the_true_ones_in_camera_axes(ball):
    for step in (1, 3):
        dataset = TripletDataset([ball], dataclasses.replace(SMALL, step=step), "all", augment=False)
        item = dataset[2]
        true = dataset.truth(2).T_i_j[:, :3, :3].numpy()
        apart = se3.so3_log(np.swapaxes(true, 1, 2) @ item.R_i_j_gyro.double().numpy())
        assert item.index == (2, 2 + step, 2 + 2 * step)
        assert np.abs(se3.so3_log(true)).max() > 0.05 and np.abs(apart).max() < 2e-3


def test_vibration_windows_are_the_samples_around_each_frame(ball):
    item = TripletDataset([ball], SMALL, "all", augment=False)[6]
    values = np.column_stack([ball.imu.gyro_rad_s, ball.imu.accel_m_s2])
    for k, window in zip(item.index, item.vibration, strict=True):
        t = ball.frame_t_s[k] + (np.arange(40) - 19.5) / 40
        expected = np.stack([np.interp(t, ball.imu_t_s, column) for column in values.T])
        np.testing.assert_allclose(window, expected, atol=2e-3)  # smooth signals: cell means are values


def explained(item, truth):
    """Difference of the last frame of an item from its middle one: warped by the truth, and as it is."""
    batch = collate([item])
    z = truth.depth_m[None]
    seen = synthesise(batch.images[:, 2], z[:, 2], z[:, 1], truth.T_i_j[[1]].float(), batch.cameras, "z",
                      batch.usable & (z[:, 1] > 0), batch.usable & (z[:, 2] > 0))
    return [float(masked_mean((image - batch.images[:, 1]).abs(), seen.valid))
            for image in (seen.image, batch.images[:, 2])], float(seen.valid.float().mean())


@pytest.mark.parametrize("symmetry", SYMMETRIES)
def test_a_mirrored_item_is_a_consistent_world(ball, symmetry, monkeypatch):
    dataset = TripletDataset([ball], SMALL, "all")
    monkeypatch.setattr(TripletDataset, "symmetry", lambda self, number: symmetry)
    item, truth = dataset[8], dataset.truth(8)
    (true, still), valid = explained(item, truth)
    assert valid > 0.6 and true < 0.25 * still
    gyro = item.R_i_j_gyro.double().numpy()
    assert np.abs(gyro - truth.T_i_j[:, :3, :3].numpy()).max() < 2e-3
    # The windows turn the body the way the images turn: integrate the middle frame's half second to either side.
    R_bc = ball.calibration.T_body_camera[:3, :3]
    turned = np.eye(3)
    for w in item.vibration[1, :3].double().numpy().T:
        turned = turned @ se3.so3_exp(w / 40)
    plain = TripletDataset([ball], SMALL, "all", augment=False)
    monkeypatch.setattr(TripletDataset, "symmetry", lambda self, number: Symmetry())
    original, unturned = plain[8], np.eye(3)
    for w in original.vibration[1, :3].double().numpy().T:
        unturned = unturned @ se3.so3_exp(w / 40)
    np.testing.assert_allclose(R_bc.T @ turned @ R_bc, symmetry.rotation(R_bc.T @ unturned @ R_bc), atol=1e-5)
    force = np.linalg.norm(item.vibration[:, 3:].numpy(), axis=1)
    np.testing.assert_allclose(force, np.linalg.norm(original.vibration[:, 3:].numpy(), axis=1), rtol=1e-5)


@pytest.mark.parametrize("symmetry", SYMMETRIES)
@pytest.mark.parametrize("camera", [
    Camera("pinhole", 40, 32, 30, 28, 18.2, 17.1, (-0.1, 0.02, 0.01, -0.02)),
    Camera("equidistant", 40, 32, 13, 14, 21.0, 14.4, (0.01, -0.002, 0, 0)),
])
def test_every_loss_is_blind_to_mirrors_and_quarter_turns(scene_of, camera, symmetry):
    """With wrong depth and motion, so that no term is zero for another reason; fx, fy, cx, cy, p1, p2 all differ."""
    scene = scene_of(camera, seed=2)
    recipe = Consistency(depth_kind="range")
    plain = scene.snippet("range", {(i, j): scene.T(j, i) for i, j in ((1, 0), (1, 2), (0, 1), (2, 1))})
    plain = dataclasses.replace(plain, depth=plain.depth * (0.5 + plain.images[:, :, :1]))
    Q4 = torch.from_numpy(symmetry.Q4)
    changed = dataclasses.replace(
        plain, images=symmetry.image(plain.images), depth=symmetry.image(plain.depth),
        cameras=camera_batch([symmetry.camera(camera)], torch.float64),
        motions={pair: Q4 @ T @ Q4.T for pair, T in plain.motions.items()})
    one, other = (consistency_loss(snippet, recipe) for snippet in (plain, changed))
    assert float(one.total) > 0.1
    torch.testing.assert_close(one.total, other.total, rtol=1e-9, atol=0)
    assert {k: pytest.approx(float(v), rel=1e-6) for k, v in one.parts.items()} == {
        k: float(v) for k, v in other.parts.items()}


def test_items_are_the_same_in_every_process_and_new_in_every_epoch(ball):
    def items(dataset, workers):
        loader = DataLoader(dataset, 4, num_workers=workers, collate_fn=collate, persistent_workers=workers > 0,
                            multiprocessing_context="fork" if workers else None)
        out = []
        for epoch in (0, 7):
            dataset.set_epoch(epoch)
            out.append(torch.cat([batch.frames for batch in loader]))
        return out
    alone, shared = (items(TripletDataset([ball, ball], SMALL, seed=3), workers) for workers in (0, 2))
    assert all(torch.equal(a, b) for a, b in zip(alone, shared, strict=True))
    assert not torch.equal(alone[0], alone[1])
    dataset, loaded, other = (TripletDataset([ball], dataclasses.replace(SMALL, preload=preload), seed=seed)
                              for preload, seed in ((False, 3), (True, 3), (False, 4)))
    assert all(same(dataset[k], loaded[k]) for k in range(len(dataset)))
    assert not all(same(dataset[k], other[k]) for k in range(len(dataset)))
    dataset.set_epoch(2)
    kinds = {dataset.symmetry(k) for k in range(10)}
    assert len(kinds) > 3
    sampler = DistributedSampler(dataset, 1, 0, seed=1)
    assert sorted(sampler) == list(range(len(dataset)))


def test_parts_share_no_frame_and_are_contiguous(ball):
    used = {}
    for part in ("train", "validation"):
        dataset = TripletDataset([ball], SMALL, part)
        used[part] = sorted({k for n in range(len(dataset)) for k in dataset[n].index})
    assert used["train"] == list(range(12)) and used["validation"] == [12, 13, 14]
    for frames in range(1, 60):
        (first, cut), (again, end) = frames_of_split(frames, "train"), frames_of_split(frames, "validation")
        assert (first, end) == (0, frames) and cut == again and abs(cut - 0.8 * frames) <= 0.5


def test_items_hold_no_truth_and_need_none(ball):
    blind = dataclasses.replace(ball, truth=None, depth_paths=())
    seeing, unseeing = (TripletDataset([r], SMALL, seed=1) for r in (ball, blind))
    assert all(same(seeing[k], unseeing[k]) for k in range(len(seeing)))
    with pytest.raises(RecordingError, match="has no truth"):
        unseeing.truth(0)
    short = dataclasses.replace(ball, truth=Trajectory(ball.truth.t_s[:2], ball.truth.T_world_body[:2]))
    with pytest.raises(TrajectoryError, match="nothing is extrapolated"):
        TripletDataset([short], SMALL).truth(5)
    nameless = dataclasses.replace(ball, depth_paths=())
    assert TripletDataset([nameless], SMALL).truth(0).depth_m is None


def test_cameras_of_different_kinds_meet_in_one_batch(tmp_path, written, ball):
    other = written(tmp_path, Camera("pinhole", 80, 64, 50, 50, 39.5, 31.5), "wide")
    batch = collate([TripletDataset([ball, other], SMALL, "all")[k] for k in (0, 20)])
    assert batch.recording.tolist() == [0, 1] and len(batch.cameras) == 2
    assert batch.cameras.fisheye.tolist() == [ball.calibration.camera.model == "equidistant", False]
    oblong = TripletDataset([other], SourceSettings(height=24, width=32), "all", seed=1)
    assert {oblong.symmetry(k) for k in range(len(oblong))} <= set(UPRIGHT)
    assert collate([oblong[k] for k in range(5)]).frames.shape == (5, 3, 3, 24, 32)


def test_the_vignette_and_what_the_lens_does_not_reach_are_masked(tmp_path, written):
    recording = written(tmp_path, Camera("equidistant", 64, 64, 23, 23, 31.5, 31.5), "round")
    for path in recording.frame_paths:
        image = cv2.imread(str(path))
        image[np.hypot(*np.meshgrid(np.arange(64) - 31.5, np.arange(64) - 31.5)) > 30] = 3
        image[30:34, 30:34] = 0  # a dark lumen is no vignette
        cv2.imwrite(str(path), image)
    item = TripletDataset([recording], SMALL, augment=False)[0]
    radius = 2 * np.hypot(*np.meshgrid(np.arange(32) - 15.5, np.arange(32) - 15.5))
    usable = item.usable[0].numpy()
    assert not usable[radius > 30].any() and usable[radius < 26].all()


def test_triplets_over_holes_and_long_steps_are_left_out_and_counted(tmp_path, written):
    camera = Camera("pinhole", 32, 32, 20, 20, 15.5, 15.5)
    holed = written(tmp_path, camera, "holed", imu_gap=(1.9, 2.6))
    dataset = TripletDataset([holed], SMALL, "all")
    kept = [dataset[k].index[1] for k in range(len(dataset))]
    t = holed.frame_t_s
    clear = [k for k in range(1, 14) if t[k + 1] + 0.5 < 1.9 or t[k - 1] - 0.5 > 2.58]
    assert kept == clear and dataset.left_out["hole in the imu"] == 13 - len(kept) > 0
    assert len(TripletDataset([holed], dataclasses.replace(SMALL, imu=False), "all")) == 13
    late = dataclasses.replace(holed, frame_t_ns=holed.frame_t_ns + 2_000_000_000 * (np.arange(15) >= 8))
    dataset = TripletDataset([late], dataclasses.replace(SMALL, imu=False, longest_step_s=0.5), "all")
    assert [dataset[k].index[1] for k in range(len(dataset))] == [1, 2, 3, 4, 5, 6, 9, 10, 11, 12, 13]
    assert dataset.left_out == {"too long a step": 2}


def test_a_recording_without_an_imu_trains_vision_only(ball):
    bare = dataclasses.replace(ball, imu=ImuSamples(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3))))
    with pytest.raises(ImuError, match=r"ball: 0 inertial samples.*vision-only"):
        TripletDataset([bare], SMALL)
    batch = collate([TripletDataset([bare], dataclasses.replace(SMALL, imu=False))[0]])
    assert batch.vibration is None and batch.R_i_j_gyro is None
    assert batch.to("cpu").vibration is None


def test_recordings_that_cannot_be_trained_on_are_named(tmp_path, written):
    recording = written(tmp_path, Camera("pinhole", 32, 32, 20, 20, 15.5, 15.5), "broken")
    blind = dataclasses.replace(recording, calibration=dataclasses.replace(recording.calibration, camera=None))
    with pytest.raises(RecordingError, match=r"broken: no camera.*intrinsics"):
        TripletDataset([blind], SMALL)
    with pytest.raises(RecordingError, match="images are missing"):
        TripletDataset([dataclasses.replace(recording, frame_paths=())], SMALL)
    with pytest.raises(RecordingError, match="no triplet in the validation part of 1 recordings"):
        TripletDataset([recording], dataclasses.replace(SMALL, step=4), "validation")
    with pytest.raises(ConfigError, match="split 'test'"):
        TripletDataset([recording], SMALL, "test")
    with pytest.raises(ConfigError, match="step is 0"):
        SourceSettings(step=0)
    path = recording.frame_paths[3]
    whole = path.read_bytes()
    dataset = TripletDataset([recording], SMALL, augment=False)
    path.write_bytes(whole[:len(whole) // 2])
    with pytest.raises(RecordingError, match=r"frame 3: .*cut off"):
        dataset[2]
    cv2.imwrite(str(path), np.zeros((40, 32, 3), np.uint8))
    with pytest.raises(RecordingError, match=r"frame 3 .* has 32 x 40 pixels but the camera 32 x 32"):
        dataset[2]
    for file in recording.frame_paths:
        cv2.imwrite(str(file), np.zeros((32, 32, 3), np.uint8))
    with pytest.raises(RecordingError, match="0 % of the image are usable"):
        TripletDataset([recording], SMALL)


def test_shrunk_depth_is_the_mean_inverse_and_unknown_where_any_part_is():
    depth = np.array([[1, 1, 2, 4], [1, 1, 4, 2], [0, 5, 3, 3], [5, 5, 3, 3]], np.float32)
    np.testing.assert_allclose(shrunk_depth(depth, 2, 2), [[1, 8 / 3], [0, 3]], rtol=1e-6)
