"""Methods frozen for prediction say what the methods say, and leave them as they were."""

from functools import partial

import pytest
import torch
from torch import nn

from learned.frozen import frozen
from learned.methods import CONFIGS, build_method
from learned.networks.correlation import local_correlation
from learned.networks.frozen_correlation import pair_correlation
from learned.vibration_fusion import FusionConfig

FRAMES, PAIRS = 3, ((0, 1), (2, 1), (1, 0))


def lived_in(method):
    """The method as after training: no norm is the identity, no kernel a delta, no coarser map silent."""
    rng = torch.Generator().manual_seed(3)
    for name, value in method.state_dict().items():
        if "running_var" in name:
            value.mul_(1.5).add_(torch.rand(value.shape, generator=rng))
        elif "running_mean" in name or name.endswith("kernel") or "coarser" in name:
            value.add_(0.1 * torch.randn(value.shape, generator=rng))
    return method.eval()


@pytest.mark.parametrize(("name", "more"), [
    *((name, {}) for name in CONFIGS),
    ("gyro-correlation", {"vibration": False}),
    ("gyro-correlation", {"correlation_maps": 1, "fusion": FusionConfig(kernel="identity")}),
    ("gyro-correlation", {"radius": 3, "fusion": FusionConfig(kernel="shared", snr_per="channel", edge_padding=2)}),
])
def test_a_frozen_method_says_the_same_and_leaves_the_method_alone(name, more):
    torch.manual_seed(11)
    method = lived_in(build_method(name, width=1 / 8, **more))
    before = {key: value.clone() for key, value in method.state_dict().items()}
    frames = torch.rand(2, FRAMES, 3, 64, 96)
    windows = torch.randn(2, FRAMES, 6, 40) if method.config.vibration else None
    ask = partial(torch.no_grad()(nn.Module.__call__), depth_frames=range(FRAMES), pairs=PAIRS)
    ready = frozen(method)
    expected, found = ask(method, frames, windows), ask(ready, frames, windows)
    again = ask(ready, frames, windows)
    for k in range(FRAMES):
        torch.testing.assert_close(found.depth[k].depth[0], expected.depth[k].depth[0], rtol=1e-4, atol=0)
    for pair in PAIRS:
        step = expected.T_i_j[pair][:, :3, 3].norm(dim=1).min()
        assert step > 1e-6
        torch.testing.assert_close(found.T_i_j[pair], expected.T_i_j[pair], rtol=0, atol=1e-3 * float(step))
        assert torch.equal(found.T_i_j[pair], again.T_i_j[pair])
    assert found.snr_pose.keys() == expected.snr_pose.keys()
    assert not any(isinstance(part, nn.BatchNorm2d) for part in ready.modules())
    assert not any(value.requires_grad for value in ready.parameters())
    after = method.state_dict()
    assert before.keys() == after.keys() and all(torch.equal(before[key], after[key]) for key in before)


@pytest.mark.parametrize("size", [(6, 9), (2, 3)])
def test_correlation_of_chosen_pairs_is_the_local_correlation(size):
    maps = torch.randn(4, 5, *size, dtype=torch.float64)
    first, second = [0, 3, 1], [1, 2, 1]
    cells = maps.permute(0, 2, 3, 1).contiguous()
    found = pair_correlation(cells, cells, first, second, 2)
    torch.testing.assert_close(found.permute(0, 3, 1, 2), local_correlation(maps[first], maps[second], 2))
