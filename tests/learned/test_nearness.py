"""The factor that brings a depth map to known steps: found by trying, and learned by one number per image."""

from dataclasses import replace

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from learned.losses.consistency import Consistency
from learned.losses.nearness import KNOWN_SD, SMALL, FoundNearness, nearness_difference, search_nearness
from learned.losses.step_lengths import told_by
from learned.methods import assemble, method_config
from learned.objective import Objective
from learned.train_config import train_config
from vio.camera import Camera
from vio.errors import ConfigError

CAMERAS = (Camera("pinhole", 64, 64, 42, 44, 30.5, 33.0), Camera("equidistant", 64, 64, 23, 23, 32.0, 30.5))
RANGE = Consistency(depth_kind="range", luminance=True)
KNOWN = torch.ones(1, dtype=torch.float64)


def search(snippet, known=KNOWN):
    return search_nearness(snippet, dict.fromkeys(snippet.motions, known), RANGE)


@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.floats(-1.4, 0.3), st.floats(-1.4, 0.3), st.sampled_from(CAMERAS), st.integers(0, 5))
def test_every_frames_factor_is_found_whatever_the_others_are(scene_of, one, other, camera, seed):
    scene = scene_of(camera, seed, step=0.1)
    wrong = torch.tensor([one, other, 0.0], dtype=torch.float64)
    snippet = scene.snippet("range")
    found = search(replace(snippet, depth=snippet.depth * (-wrong).exp().view(1, 3, 1, 1, 1)))
    sure = found.weight > 0.5
    assert sure.any()
    assert (found.log_factor - wrong)[sure].abs().max() < 0.1


def test_what_cannot_tell_counts_for_nothing(scene):
    snippet = scene.snippet("range")
    assert search(snippet).weight.min() > 0.5
    assert not search(snippet, 0 * KNOWN).weight.any()  # no length is known
    plain = search(replace(snippet, images=torch.full_like(snippet.images, 0.5)))
    assert plain.weight.max() < KNOWN_SD
    still = search(replace(snippet, motions=dict.fromkeys(snippet.motions, torch.eye(4, dtype=torch.float64)[None])))
    assert still.weight.max() < KNOWN_SD  # a camera that only turns shows no depth
    far = search(replace(snippet, depth=snippet.depth * 20))  # beyond the factors that are tried
    assert far.weight.max() < 0.5
    assert told_by(torch.tensor([torch.nan, 0.0, 1e-3, 1.0])).tolist() == pytest.approx([0, 0, 0.5, 1], abs=1e-5)


def test_the_number_learns_what_was_found_and_nothing_else_does():
    nearness = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)
    found = FoundNearness(torch.tensor([[-0.5, 0.2, 0.7], [0.0, 0.0, -0.1]]), torch.tensor([[1, 0.5, 0], [0, 0, 1]]))
    loss = nearness_difference(nearness, found)
    half = SMALL / 2
    assert loss.item() == pytest.approx((0.5 - half + 0.5 * (0.2 - half) + 0.1**2 / (2 * SMALL)) / 2.5)
    loss.backward()
    nearer = -nearness.grad.sign()  # where descent goes: nearer where depth wants to be smaller
    assert nearer.tolist() == [[1, -1, 0], [0, 0, 1]]
    assert nearness_difference(nearness, replace(found, weight=torch.zeros(2, 3))).item() == 0


def test_a_number_more_is_as_much_less_depth():
    method = assemble(method_config("gyro-correlation", vibration=False, width=0.125, image_size=(64, 64)), seed=1)
    images = torch.rand(2, 2, 3, 64, 64, generator=torch.Generator().manual_seed(3))
    before = method(images, depth_frames=(0,), pairs=()).depth[0]
    torch.nn.init.constant_(method.depth.nearness.bias, 0.1)
    after = method(images, depth_frames=(0,), pairs=()).depth[0]
    torch.testing.assert_close(after.nearness - before.nearness, torch.full_like(after.nearness, 0.1))
    change = (after.depth[0] / before.depth[0]).log().mean()
    assert -0.1 <= change.item() < -0.05  # less than the number where the range ends


def test_it_needs_known_lengths_and_a_network_with_the_number():
    ours = train_config("gyro-correlation", nearness_weight=1.0)
    with pytest.raises(ConfigError, match="nearness_weight needs steps of known length"):
        Objective(assemble(ours.method), ours)
    other = train_config("endosfmlearner", nearness_weight=1.0, length_from="refined", loss="paper")
    with pytest.raises(ConfigError, match="one number per image"):
        Objective(assemble(other.method), other)
