"""Whole methods: published sizes and motions' conventions, every fusion, refusals, seeds, configurations in files."""

import json
from functools import partial

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from learned.errors import NetworkInputError
from learned.methods import (
    CONFIGS,
    assemble,
    build_method,
    config_from_dict,
    config_to_dict,
    method_config,
    snr_summary,
)
from learned.methods.parametrisation import typical_depth
from learned.vibration_fusion import STRATEGIES, FusionConfig
from vio.errors import ConfigError, VioError

NAMES = tuple(CONFIGS)
small = partial(build_method, width=1 / 12)


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(11)


def size(module, trainable=False):
    return sum(p.numel() for p in module.parameters() if p.requires_grad or not trainable)


def loss_of(out):
    """Something that every output takes part in."""
    parts = [x.log().square().mean() for p in out.depth.values() for x in p.depth]
    parts += [(T[:, :3] ** 2).mean() + T[:, :3].mean() for T in out.T_i_j.values()]
    return sum(parts + [K.mean() * 1e-3 for K in out.intrinsics.values()])


@pytest.mark.parametrize(("name", "depth", "pose"), [
    ("endosfmlearner", 14_329_236, 12_499_478), ("af-sfmlearner", 14_329_236, 12_500_492),
    ("ra-depth", 9_978_849, 12_500_492), ("endodac", 99_091_748, 12_500_492),
    ("gyro-correlation", 3_585_169 + 512 + 1, 2_520_134 + (9 * 81 + 1) * (64 + 128)),
    ("measured", 3_585_169, 2_520_134),
])
def test_sizes_are_the_published_ones(name, depth, pose):
    with torch.device("meta"):
        method = (build_method("gyro-correlation", vibration=False, correlation_maps=1, whole_image=False)
                  if name == "measured" else build_method(name, vibration=False))
    assert (size(method.depth), size(method.pose)) == (depth, pose)
    if name in ("af-sfmlearner", "endodac"):
        assert (size(method.optical_flow), size(method.appearance_flow)) == (14_340_808, 14_342_972)
    if name == "endodac":
        assert size(method.depth, trainable=True) == 1_667_076 and size(method.intrinsics) == 132_352
    else:
        assert size(method.depth, trainable=True) == depth and method.intrinsics is None


@pytest.mark.parametrize(("name", "nearest", "farthest"), [
    ("endosfmlearner", 0.0999, 100.0), ("af-sfmlearner", 0.1, 150.0), ("ra-depth", 0.1, 100.0), ("endodac", 0.1, 150.0),
    ("gyro-correlation", 0.1, 4.0),
])
def test_depth_ranges_are_the_published_ones(name, nearest, farthest):
    reach = method_config(name).depth_range.depth(torch.tensor([1.0, 0.0])).tolist()
    np.testing.assert_allclose(reach, [nearest, farthest], rtol=1e-4)


def published(name, P_first, P_second):
    """Six raw numbers by the publication's own convention, for images of cameras posed at P in the world."""
    target_to_source = np.linalg.inv(P_first) @ P_second
    backward = name in ("endosfmlearner", "ra-depth")
    T = np.linalg.inv(target_to_source) if backward else target_to_source
    turn = Rotation.from_matrix(T[:3, :3])
    if name == "endosfmlearner":  # sees target, then reference
        return np.concatenate([T[:3, 3], turn.as_euler("XYZ")]) / 0.01
    scale = {"ra-depth": 0.01, "gyro-correlation": 0.01}.get(name, 0.001)
    return np.concatenate([turn.as_rotvec(), T[:3, 3]]) / scale


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("pair", [(0, 1), (1, 0), (2, 1), (1, 2), (0, 2)])
def test_motions_are_poses_of_camera_j_in_camera_i(name, pair):
    rng = np.random.default_rng(4)
    poses = []
    for _ in range(3):
        P = np.eye(4)
        P[:3, :3], P[:3, 3] = Rotation.from_rotvec(rng.normal(0, 0.4, 3)).as_matrix(), rng.normal(0, 2, 3)
        poses.append(P)
    pose = method_config(name).pose
    first, second = pose.images(*pair)
    assert name != "ra-depth" or first < second
    raw = torch.tensor(published(name, poses[first], poses[second]))[None]
    if pose.in_depths:
        raw[:, 3:] /= 2.5
    typical = typical_depth(torch.tensor([1.25, 5.0], dtype=raw.dtype).view(1, 1, 1, 2))
    T = pose.motions(raw[:, None], [pair], {pair[0]: typical})[0, 0].numpy()
    np.testing.assert_allclose(T, np.linalg.inv(poses[pair[0]]) @ poses[pair[1]], atol=1e-9)


@pytest.mark.parametrize(("name", "strategy"), [
    *(("gyro-correlation", s) for s in STRATEGIES), ("endosfmlearner", "fourier"), ("af-sfmlearner", "iaff"),
    ("ra-depth", "fourier"), ("ra-depth", "aff"), ("endodac", "fourier"), ("endodac", "butd"),
])
def test_every_part_trains_with_one_triplet(name, strategy):
    method = small(name, fusion=strategy, **({"train_transformer": True} if name == "endodac" else {}))
    frames = torch.rand(1, 3, 3, 64, 96)
    out = method(frames, torch.randn(1, 6, 40))
    loss_of(out).backward()
    for k, pyramid in out.depth.items():
        assert k in method.config.depth_frames and pyramid.depth[0].shape == (1, 1, 64, 96)
    for T in out.T_i_j.values():
        assert torch.linalg.det(T).allclose(torch.ones(1)) and T.shape == (1, 4, 4)
    for part in (method.depth, method.pose, method.branch, *([method.intrinsics] if method.intrinsics else [])):
        gradients = {n: p.grad for n, p in part.named_parameters() if p.requires_grad}
        assert all(g is not None and torch.isfinite(g).all() for g in gradients.values())
    assert any((p.grad != 0).any() for p in method.branch.parameters())
    assert bool(out.snr_depth) == bool(out.snr_pose) == (strategy == "fourier")


@pytest.mark.parametrize("name", NAMES)
def test_vision_alone_is_the_same_network_without_the_rest(name):
    fused, other, alone = small(name, seed=5), small(name, seed=5, fusion="gated"), small(name, seed=5, vibration=False)
    added = ("branch.", "depth.fusion.", "pose.fusion.")
    weights = {n: value for n, value in fused.state_dict().items() if not n.startswith(added)}
    for method in (other, alone):
        same = {n: value for n, value in method.state_dict().items() if not n.startswith(added)}
        assert same.keys() == weights.keys() and all(torch.equal(weights[n], value) for n, value in same.items())
    assert alone.state_dict().keys() == weights.keys() < fused.state_dict().keys()
    frames, vibration = torch.rand(2, 3, 3, 64, 64), torch.randn(2, 6, 40)
    plain = alone.eval()(frames)
    for block in fused.modules():  # a filter that lets everything through
        if hasattr(block, "snr_head"):
            torch.nn.init.zeros_(block.snr_head.weight)
            torch.nn.init.constant_(block.snr_head.bias, 1e4)
    same = fused.eval()(frames, vibration)
    for k, pyramid in plain.depth.items():
        torch.testing.assert_close(same.depth[k].disparity[0], pyramid.disparity[0], atol=2e-3, rtol=0)
    assert plain.snr_depth == {} and snr_summary(plain) == {}


def test_the_snr_moves_with_the_vibration_in_every_block_of_both_networks():
    method = small("gyro-correlation").eval()
    vibration = torch.randn(4, 6, 40) * torch.tensor([0.1, 1.0, 3.0, 10.0])[:, None, None]
    summary = snr_summary(method(torch.rand(1, 3, 3, 64, 64).expand(4, -1, -1, -1, -1), vibration))
    assert len(summary) == 20 and all(value > 0.01 for key, value in summary.items() if key.endswith("_sd"))
    assert all(5 < value < 20 for key, value in summary.items() if key.endswith("_mean"))


def test_a_seed_gives_one_network_and_leaves_the_random_state_alone():
    state = torch.get_rng_state()
    one, two, other = (small("gyro-correlation", seed=seed) for seed in (3, 3, 4))
    assert torch.equal(torch.get_rng_state(), state)
    assert all(torch.equal(a, b) for a, b in zip(one.state_dict().values(), two.state_dict().values(), strict=True))
    assert any(not torch.equal(a, b) for a, b in zip(one.parameters(), other.parameters(), strict=True))


def test_an_untrained_network_of_ours_starts_in_the_middle_and_at_rest():
    out = build_method("gyro-correlation", vibration=False, width=0.5)(torch.rand(2, 3, 3, 64, 64))
    for pyramid in out.depth.values():
        assert (pyramid.depth[0] - 1).abs().max() < 0.4
    for T in out.T_i_j.values():
        assert (T - torch.eye(4)).abs().max() < 0.02


def test_one_window_for_all_frames_is_the_same_window_for_each():
    method, frames, windows = small("gyro-correlation").eval(), torch.rand(2, 3, 3, 64, 64), torch.randn(2, 6, 40)
    shared, each = method(frames, windows), method(frames, windows[:, None].expand(-1, 3, -1, -1))
    later = windows[:, None].repeat(1, 3, 1, 1)
    later[:, 2] *= 5
    changed = method(frames, later)
    for pair, T in shared.T_i_j.items():
        torch.testing.assert_close(T, each.T_i_j[pair])
        torch.testing.assert_close(changed.T_i_j[pair], T)  # every pair uses its earlier frame's
    assert torch.equal(changed.depth[0].depth[0], each.depth[0].depth[0])
    assert not torch.equal(changed.depth[2].depth[0], each.depth[2].depth[0])


def test_what_is_asked_for_is_what_comes():
    method = small("endosfmlearner", vibration=False).eval()
    frames = torch.rand(1, 2, 3, 64, 64)
    with torch.inference_mode():
        out = method(frames, depth_frames=(0,), pairs=((0, 1),))
        assert set(out.depth) == {0} and set(out.T_i_j) == {(0, 1)}
        motions = method(frames, depth_frames=(), pairs=((0, 1), (1, 0)))
    assert motions.depth == {} and torch.allclose(motions.T_i_j[0, 1], out.T_i_j[0, 1], atol=1e-7)


def test_flows_come_at_four_scales_and_start_at_rest():
    method = small("af-sfmlearner", vibration=False)
    first, second = torch.rand(2, 1, 3, 64, 96)
    flow, appearance = method.optical_flow(first, second), method.appearance_flow(first, second)
    assert [tuple(x.shape) for x in flow] == [(1, 2, 64 >> s, 96 >> s) for s in range(4)] and flow[0].abs().max() < 1e-2
    assert [x.shape[1] for x in appearance] == [3] * 4 and 0 < appearance[0].abs().max() < 1


@pytest.mark.parametrize("name", NAMES)
def test_half_precision_changes_little_and_leaves_motions_and_filters_in_full(name):
    method = small(name).eval()
    frames, vibration = torch.rand(1, 3, 3, 64, 96), torch.randn(1, 6, 40)
    with torch.inference_mode():
        full = method(frames, vibration)
        with torch.autocast("cpu", torch.bfloat16):
            half = method(frames, vibration)
    for k, pyramid in full.depth.items():
        assert half.depth[k].depth[0].dtype == torch.float32
        torch.testing.assert_close(half.depth[k].disparity[0], pyramid.disparity[0], atol=0.03, rtol=0)
        torch.testing.assert_close(half.snr_depth[k], full.snr_depth[k])
    for pair, T in full.T_i_j.items():
        assert half.T_i_j[pair].dtype == torch.float32
        torch.testing.assert_close(half.T_i_j[pair], T, atol=0.03, rtol=0)


def test_what_a_network_cannot_take_is_refused_in_one_line():
    fused, alone = small("gyro-correlation"), small("gyro-correlation", vibration=False)
    frames, windows = torch.rand(1, 3, 3, 64, 64), torch.randn(1, 6, 40)
    for method, inputs, says in (
        (alone, (frames[0],), "B, F, 3, H, W"), (alone, ((frames * 255).byte(),), "floats"),
        (alone, (frames[..., :60],), "divisible by 32"), (alone, (frames[..., :32],), "at least 64"),
        (alone, (frames[:, :2],), "there are 2"), (alone, (frames, windows), "vision-only"),
        (fused, (frames,), "vibration is missing"), (fused, (frames, windows[0]), "B, 6, 40"),
        (fused, (frames, windows[..., :30]), "40"), (fused, (frames, windows[:, None]), "B, F, 6, 40"),
    ):
        with pytest.raises(NetworkInputError, match=says) as error:
            method(*inputs)
        assert "\n" not in str(error.value)
    with pytest.raises(NetworkInputError, match="vision-only"):
        alone.fit_vibration_normalisation(windows)


@pytest.mark.parametrize("name", NAMES)
def test_a_config_survives_a_file(name):
    fusion = FusionConfig("iaff", attention_reduction=2)
    config = method_config(name, width=0.25, fusion=fusion, shared_branch=False, branch={"hidden": 4},
                           pose={"scale": 0.5}, image_size=[96, 64])
    again = config_from_dict(json.loads(json.dumps(config_to_dict(config))), CONFIGS)
    assert again == config and again.branch.hidden == 4 and again.image_size == (96, 64)
    assert again.fusion == fusion


def test_wrong_choices_are_refused():
    for wrong, says in (({"name": "monodepth"}, "gyro-correlation"), ({"name": "ra-depth", "depth": 3}, "'depth'"),
                        ({"name": "ra-depth", "width": 0}, "width"), ({"name": "ra-depth", "layers": 20}, "50"),
                        ({"name": "ra-depth", "fusion": "sum"}, "summation"),
                        ({"name": "ra-depth", "pairs": ()}, "pairs"),
                        ({"name": "ra-depth", "image_size": (100, 64)}, "divisible"),
                        ({"name": "ra-depth", "pose": {"rotation": "quaternion"}}, "euler_xyz"),
                        ({"name": "ra-depth", "depth_range": {"nearest": 2.0, "farthest": 1.0}}, "nearest"),
                        ({"name": "endodac", "transformer": "giant"}, "small"),
                        ({"name": "endodac", "taps": (1, 2)}, "four"),
                        ({"name": "endosfmlearner", "attention": "all"}, "transpose"),
                        ({"name": "endosfmlearner", "pose_encoder_weights": "x.safetensors"}, "leave them out")):
        with pytest.raises(VioError, match=says) as error:
            build_method(**wrong)
        assert "\n" not in str(error.value)
    with pytest.raises(ConfigError, match="branch"):
        method_config("ra-depth", branch={"hidden": 0})


def test_branches_can_be_apart():
    method = assemble(method_config("gyro-correlation", width=0.1, shared_branch=False))
    method.fit_vibration_normalisation(torch.randn(9, 6, 40) * 3)
    assert torch.equal(method.branch.sd, method.pose_branch.sd) and method.branch.sd.min() > 2
    out = method(torch.rand(1, 3, 3, 64, 64), torch.randn(1, 6, 40))
    sum(snr.sum() for snr in out.snr_depth.values()).backward()
    assert all(p.grad is None for p in method.pose_branch.parameters())
