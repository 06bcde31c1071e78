"""The parts of the methods: published sizes, oracles, weights from files."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save_file
from scipy.spatial.transform import Rotation

from learned.errors import NetworkInputError, WeightsError
from learned.lie import inverse, rotation_from_euler_xyz, so3_exp, transform
from learned.networks.correlation import local_correlation, locally_normalised
from learned.networks.correlation_pose import CorrelationPoseNetwork
from learned.networks.dpt_head import DptHead
from learned.networks.fusion_decoder import FusionDecoder
from learned.networks.hrnet import HRNetEncoder
from learned.networks.intrinsics_head import IntrinsicsHead
from learned.networks.pair_network import FlowNetwork
from learned.networks.pose_decoder import PoseDecoder
from learned.networks.pretrained import load_encoder
from learned.networks.resnet import ResNetEncoder
from learned.networks.spatial_attention import SpatialAttention
from learned.networks.unet_decoder import UNetDecoder
from learned.networks.vibration_branch import BranchConfig, VibrationBranch
from vio.errors import ConfigError

RESNET18 = (64, 64, 128, 256, 512)


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(7)


def size(module):
    return sum(p.numel() for p in module.parameters())


@pytest.mark.parametrize(("build", "parameters"), [
    (lambda: ResNetEncoder(18), 11_176_512),
    (lambda: ResNetEncoder(18, images=2), 11_185_920),
    (lambda: ResNetEncoder(34), 21_284_672),
    (lambda: ResNetEncoder(50), 23_508_032),
    (lambda: HRNetEncoder(), 9_562_260),
    (lambda: UNetDecoder(RESNET18, 1), 3_152_724),
    (lambda: UNetDecoder(RESNET18, 2), 3_154_888),
    (lambda: UNetDecoder(RESNET18, 3), 3_157_052),
    (lambda: FusionDecoder((64, 18, 36, 72, 144)), 416_589),
    (lambda: PoseDecoder(512, 6), 1_313_030),
    (lambda: PoseDecoder(512, 12), 1_314_572),
    (lambda: SpatialAttention(64), 528),
    (lambda: FlowNetwork(2), 14_340_808),
    (lambda: FlowNetwork(3), 14_342_972),
    (lambda: IntrinsicsHead(512), 132_352),
])
def test_sizes_are_the_published_ones(build, parameters):
    with torch.device("meta"):
        assert size(build()) == parameters


def test_the_branch_has_the_articles_size():
    branch = VibrationBranch()
    assert size(branch) - size(branch.lstm) == 280_064 and size(branch.lstm) == 1_600 and branch.features == 136
    for config, lstm in ((BranchConfig(hidden=64), 27_136), (BranchConfig(hidden=128), 87_040),
                         (BranchConfig(shuffle=False), 512)):
        assert size(VibrationBranch(config).lstm) == lstm


@pytest.mark.parametrize(("encoder", "tensors", "some"), [
    (ResNetEncoder(18), 120, {"conv1.weight", "bn1.running_var", "layer2.0.downsample.0.weight", "layer4.1.bn2.bias"}),
    (ResNetEncoder(50, width=0.1), 318, {"layer3.5.conv3.weight", "layer1.0.downsample.1.num_batches_tracked"}),
    (HRNetEncoder(0.1), None, {"stage2.0.branches.1.3.conv2.weight", "stage3.3.fuse_layers.2.0.0.0.weight",
                               "stage4.2.fuse_layers.0.3.1.bias", "transition3.3.0.0.weight", "layer1.0.bn3.weight"}),
])
def test_names_are_those_of_imagenet_files(encoder, tensors, some):
    names = set(encoder.state_dict())
    assert some <= names and len(names) == (tensors or len(names))


@pytest.mark.parametrize("encoder", [ResNetEncoder(18, width=0.1), ResNetEncoder(50, width=0.1), HRNetEncoder(0.1)])
def test_every_block_can_be_fused_and_feeds_what_comes_after(encoder):
    encoder.eval()
    images = torch.rand(1, 3, 64, 96)
    plain = encoder(images)
    strides = [images.shape[-1] // x.shape[-1] for x in plain]
    assert strides == [2, 4, 8, 16, 32] and tuple(x.shape[1] for x in plain) == encoder.channels
    seen = []
    encoder(images, lambda block, x: seen.append(block) or x)
    assert seen == [0, 1, 2, 3, 4]
    shifted = encoder(images, lambda block, x: x + 1 if block == 0 else x)
    assert torch.equal(shifted[0], plain[0] + 1) and all((a != b).any() for a, b in zip(shifted, plain, strict=True))


def test_weights_of_one_image_serve_a_pair(tmp_path):
    single, pair = ResNetEncoder(18).eval(), ResNetEncoder(18, images=2).eval()
    classifier = {"fc.weight": torch.zeros(1000, 512), "fc.bias": torch.zeros(1000)}
    save_file({**single.state_dict(), **classifier}, tmp_path / "resnet18.safetensors")
    load_encoder(pair, tmp_path / "resnet18.safetensors")
    image = torch.rand(1, 3, 64, 64)
    for a, b in zip(single(image), pair(torch.cat([image, image], 1)), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)


def test_wrong_weights_are_refused_in_one_line(tmp_path):
    encoder = ResNetEncoder(18, width=0.1)
    state = encoder.state_dict()
    files = {
        "pickle.pth": (lambda p: torch.save(state, p), "pickle"),
        "damaged.safetensors": (lambda p: p.write_bytes(b"\xff" * 100), "cannot be read"),
        "short.safetensors": (lambda p: save_file({k: v for k, v in state.items() if "layer4" not in k}, p), "layer4"),
        "wide.safetensors": (lambda p: save_file(ResNetEncoder(18, width=0.2).state_dict(), p), "expected"),
        "more.safetensors": (lambda p: save_file({**state, "head": torch.ones(1)}, p), "'head'"),
        "missing.safetensors": (lambda p: None, "no such file"),
    }
    before = state["conv1.weight"].clone()
    for name, (write, says) in files.items():
        write(tmp_path / name)
        with pytest.raises(WeightsError, match=says) as error:
            load_encoder(encoder, tmp_path / name)
        assert name in str(error.value) and "\n" not in str(error.value)
    assert torch.equal(encoder.state_dict()["conv1.weight"], before)


def naive_correlation(first, second, radius):
    n, _, height, width = first.shape
    side = 2 * radius + 1
    out = torch.zeros(n, side * side, height, width, dtype=first.dtype)
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            for y in range(height):
                for x in range(width):
                    if 0 <= y + dy < height and 0 <= x + dx < width:
                        channel = (dy + radius) * side + dx + radius
                        out[:, channel, y, x] = (first[:, :, y, x] * second[:, :, y + dy, x + dx]).sum(1)
    return out


@settings(max_examples=12, deadline=None)
@given(st.integers(1, 5), st.integers(1, 6), st.integers(0, 3))
def test_local_correlation_is_the_loop(height, width, radius):
    first, second = torch.randn(2, 2, 3, height, width, dtype=torch.float64)
    torch.testing.assert_close(local_correlation(first, second, radius), naive_correlation(first, second, radius))


def test_local_correlation_has_the_right_gradient():
    first, second = torch.randn(2, 1, 2, 3, 4, dtype=torch.float64, requires_grad=True).unbind(0)
    assert torch.autograd.gradcheck(lambda a, b: local_correlation(a, b, 2), (first, second))


def test_matches_point_where_things_went_whatever_the_light():
    network = CorrelationPoseNetwork(16).eval()
    image = F.interpolate(torch.rand(1, 3, 24, 24), (96, 96), mode="bicubic").clamp(0, 1)
    moved = 0.7 * torch.roll(image, (8, -4), (2, 3)) + 0.1  # two cells down, one left, in other light
    seen = (locally_normalised(network.features(each)) for each in (image, moved))
    matches = network.matches(*seen)[0, :81]
    dy, dx = matches[:, 8:16, 8:16].argmax(0) // 9 - 4, matches[:, 8:16, 8:16].argmax(0) % 9 - 4
    assert (dy == 2).float().mean() > 0.9 and (dx == -1).float().mean() > 0.9
    torch.testing.assert_close(matches.sum(0), torch.full((24, 24), 4.0))


def test_coarser_maps_find_what_moves_out_of_the_finest_ones_reach():
    network = CorrelationPoseNetwork(16, maps=3).eval()
    image = F.interpolate(torch.rand(1, 3, 16, 16), (128, 128), mode="bicubic").clamp(0, 1)
    moved = torch.roll(image, (24, -16), (2, 3))  # six cells of 4 px down, out of reach; three of 8 px, two left
    told = []
    network.coarser[0].register_forward_hook(lambda module, inputs, output: told.append(inputs[0]))
    network.coarser_matches(network.features(image), network.features(moved))
    best = told[0][0, :, 4:12, 4:12].argmax(0)
    assert (best // 9 - 4 == 3).float().mean() > 0.9 and (best % 9 - 4 == -2).float().mean() > 0.9


def test_coarser_maps_say_nothing_before_they_have_learned():
    plain, reaching = CorrelationPoseNetwork(16).eval(), CorrelationPoseNetwork(16, maps=3).eval()
    missing = reaching.load_state_dict(plain.state_dict(), strict=False)
    assert missing.missing_keys == [f"coarser.{k}.{part}" for k in (0, 1) for part in ("weight", "bias")]
    frames = torch.rand(1, 2, 3, 72, 104)
    torch.testing.assert_close(plain(frames, [(0, 1)], None).raw, reaching(frames, [(0, 1)], None).raw)
    reaching(frames, [(0, 1)], None).raw.sum().backward()
    assert all(layer.weight.grad.abs().max() > 0 for layer in reaching.coarser)
    with pytest.raises(ConfigError, match="4 correlation maps"):
        CorrelationPoseNetwork(16, maps=4)


def test_normalised_features_are_finite_on_a_blank_map():
    blank = torch.full((1, 4, 12, 12), 3.0, requires_grad=True)
    out = locally_normalised(blank)
    out.sum().backward()
    assert torch.isfinite(blank.grad).all() and out.abs().max() < 1e-2


def test_fusion_decoder_convolves_before_enlarging_what_others_enlarge_first():
    channels = (16, 4, 8, 12, 20)
    decoder = FusionDecoder(channels, 0.5)
    maps = [torch.randn(1, c, 32 >> k, 64 >> k) for k, c in enumerate(channels)]
    held = dict(enumerate(maps))
    for turn, levels in enumerate(([1, 2, 3, 4], [1, 2, 3], [1, 2], [0, 1])):
        own = {k: F.elu(decoder.same[f"{turn}_{k}"](held[k])) for k in levels}
        for k in levels[:-1]:
            held[k] = own[k] + sum(
                F.elu(decoder.join[f"{turn}_{other}_{k}"](F.interpolate(own[other], scale_factor=2.0 ** (other - k))))
                for other in levels if other > k)
    x = F.interpolate(F.elu(decoder.at_half(held[0])), scale_factor=2.0)
    wanted = decoder.head(F.elu(decoder.at_full(x)))
    torch.testing.assert_close(decoder(maps)[0], wanted, rtol=1e-4, atol=1e-5)
    assert wanted.shape == (1, 1, 64, 128)


def test_decoders_keep_to_their_scales():
    maps = [torch.randn(1, c, 32 >> k, 48 >> k) for k, c in enumerate((6, 6, 12, 25, 51))]
    for scales in ((0, 1, 2, 3), (1,), (2, 3)):
        raw = UNetDecoder((6, 6, 12, 25, 51), 2, scales, 0.1)(maps)
        assert [tuple(x.shape) for x in raw] == [(1, 2, 64 >> s, 96 >> s) for s in scales]
    head = DptHead(24, 8, (4, 6, 8, 10))
    raw = head([torch.randn(1, 24, 3, 5) for _ in range(4)])
    assert [tuple(x.shape[2:]) for x in raw] == [(48, 80), (24, 40), (12, 20), (6, 10)]
    with pytest.raises(ConfigError, match="scales"):
        UNetDecoder(RESNET18, 1, (5,))


def test_spatial_attention_relates_rows():
    block, x = SpatialAttention(32), torch.randn(2, 32, 16, 24)
    pooled = F.max_pool2d(block.reduce(x), 4)
    affinity = torch.einsum("ncik,ncjk->ncij", pooled, pooled)
    weights = block.mix(affinity.relu()).softmax(1)
    wanted = block.restore(torch.einsum("ncij,ncjk->ncik", weights, pooled))
    torch.testing.assert_close(block(x), x + wanted.repeat_interleave(4, 2).repeat_interleave(4, 3))
    published = SpatialAttention(32, "reshape")
    published.load_state_dict(block.state_dict())
    assert not torch.allclose(published(x), block(x))


def test_an_empty_intrinsics_head_guesses_a_centred_camera():
    head = IntrinsicsHead(8)
    for layer in (head.focal, head.offset):
        torch.nn.init.zeros_(layer.weight)
    K = head(torch.randn(2, 8, 3, 4), (200, 300))
    focal = np.log(2) + 0.5
    np.testing.assert_allclose(K[1].detach(), [[300 * focal, 0, 150], [0, 200 * focal, 100], [0, 0, 1]], rtol=1e-6)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3), st.sampled_from([1.0, 1e-4, 1e-9, 0.0]))
def test_rotations_agree_with_scipy(numbers, factor):
    w = torch.tensor([numbers], dtype=torch.float64) * factor
    np.testing.assert_allclose(so3_exp(w)[0], Rotation.from_rotvec(w[0]).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(rotation_from_euler_xyz(w)[0], Rotation.from_euler("XYZ", w[0]).as_matrix(), atol=1e-12)
    T = transform(so3_exp(w), torch.ones(1, 3, dtype=torch.float64))
    np.testing.assert_allclose((inverse(T) @ T)[0], np.eye(4), atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-5, 1.2])
def test_rotations_have_gradients_at_rest_too(angle):
    w = torch.tensor([[angle, -angle, 0.5 * angle]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(so3_exp, (w,))


def test_the_branch_carries_its_normalisation_in_its_weights():
    windows = torch.randn(30, 6, 40, dtype=torch.float64)
    unit, scale = torch.tensor([1, 5, 0.2, 9, 9, 9.0])[:, None].double(), torch.tensor([0, 0, 3, 9.81, 0, -1])[:, None]
    one, other = VibrationBranch().double().eval(), VibrationBranch().double().eval()
    other.load_state_dict(one.state_dict())
    one.fit_normalisation(windows)
    other.fit_normalisation(windows * unit + scale)
    torch.testing.assert_close(one(windows), other(windows * unit + scale))
    fresh = VibrationBranch().double().eval()
    fresh.load_state_dict(one.state_dict())
    assert torch.equal(fresh(windows), one(windows))
    np.testing.assert_allclose(fresh.sd, windows.numpy().std((0, 2)))


def test_the_branch_refuses_what_it_cannot_take():
    branch = VibrationBranch()
    with pytest.raises(NetworkInputError, match=r"\(2, 40, 6\)"):
        branch(torch.zeros(2, 40, 6))
    flat = torch.randn(4, 6, 40)
    flat[:, 4] = 1.0
    with pytest.raises(ConfigError, match="channel 4"):
        branch.fit_normalisation(flat)


def test_the_branch_hears_every_channel_and_works_on_one_window():
    branch = VibrationBranch().train()
    windows = torch.randn(1, 6, 40, requires_grad=True)
    branch(windows).square().sum().backward()
    assert (windows.grad.abs().amax(2) > 0).all() and torch.isfinite(windows.grad).all()
