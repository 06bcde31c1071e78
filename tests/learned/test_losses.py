"""The small terms against independent numpy, and what each must and must not notice."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from learned.losses.geometry import depth_difference
from learned.losses.masks import moving, visible_from, whole_windows, without_highlights
from learned.losses.photometric import Photometric, compare, match_brightness, photometric_map, ssim
from learned.losses.priors import depth_from_light, depth_like_light, rotation_from_gyro, unit_depth
from learned.losses.smoothness import edge_aware_smoothness, mean_normalised
from learned.losses.terms import masked_mean
from vio import se3


def images(seed, *shape):
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def numpy_ssim(a, b):
    """Window by window, by the definition."""
    out = np.zeros_like(a)
    a, b = (np.pad(image, ((0, 0), (1, 1), (1, 1)), mode="reflect") for image in (a, b))
    for c, y, x in np.ndindex(out.shape):
        u, v = a[c, y:y + 3, x:x + 3].ravel(), b[c, y:y + 3, x:x + 3].ravel()
        cov = np.cov(u, v, bias=True)
        light = (2 * u.mean() * v.mean() + 1e-4) / (u.mean() ** 2 + v.mean() ** 2 + 1e-4)
        out[c, y, x] = light * (2 * cov[0, 1] + 9e-4) / (cov[0, 0] + cov[1, 1] + 9e-4)
    return out


@settings(max_examples=10)
@given(st.integers(0, 10_000), st.floats(0, 1))
def test_ssim_is_the_definition(seed, mix):
    a, b = images(seed, 1, 2, 7, 9), images(seed + 1, 1, 2, 7, 9)
    b = mix * a + (1 - mix) * b
    got = ssim(a, b)
    np.testing.assert_allclose(got[0], numpy_ssim(a[0].numpy(), b[0].numpy()), atol=1e-10)
    torch.testing.assert_close(got, ssim(b, a))
    torch.testing.assert_close(ssim(a, a), torch.ones_like(a))


def test_photometric_difference_is_the_papers_mixture():
    a, b = images(1, 2, 3, 8, 8), images(2, 2, 3, 8, 8)
    structure = np.clip((1 - ssim(a, b).numpy()) / 2, 0, 1).mean(1, keepdims=True)
    l1, l2 = (a - b).abs().numpy().mean(1, keepdims=True), np.sqrt(((a - b) ** 2).numpy().mean(1, keepdims=True))
    np.testing.assert_allclose(photometric_map(a, b, Photometric()), 0.85 * structure + 0.15 * l1, atol=1e-12)
    np.testing.assert_allclose(photometric_map(a, b, Photometric(norm="l2")), 0.85 * structure + 0.15 * l2, atol=1e-6)
    assert (photometric_map(a, a, Photometric()) == 0).all()


@given(st.integers(0, 10_000), st.lists(st.tuples(st.floats(0.2, 5), st.floats(-0.5, 0.5)), min_size=2, max_size=2))
def test_a_known_gain_and_offset_is_undone_exactly_per_image_inside_the_mask(seed, light):
    target, mask = images(seed, 2, 3, 9, 11), images(seed + 1, 2, 1, 9, 11) > 0.3
    gain, offset = (torch.tensor(v, dtype=torch.float64).view(2, 1, 1, 1) for v in zip(*light, strict=True))
    warped = torch.where(mask, (target - offset) / gain, 77.0)  # what lies outside the mask is not looked at
    undone = match_brightness(warped, target, mask, Photometric())
    torch.testing.assert_close(torch.where(mask, undone, target), target, atol=1e-9, rtol=0)
    different, _ = compare(torch.where(mask, warped, (target - offset) / gain), target, mask, Photometric())
    assert masked_mean(different, mask) < 1e-6


def test_per_channel_light_needs_per_channel_gains_and_parity_goes_the_wrong_way():
    target, mask = images(3, 1, 3, 16, 16), torch.ones(1, 1, 16, 16, dtype=torch.bool)
    tinted = target * torch.tensor([0.5, 0.8, 0.3], dtype=torch.float64).view(1, 3, 1, 1)
    undone = match_brightness(tinted, target, mask, Photometric(per_channel=True))
    torch.testing.assert_close(undone, target, atol=1e-9, rtol=0)
    assert (match_brightness(tinted, target, mask, Photometric()) - target).abs().max() > 0.1
    dull = 0.5 + (target - target.mean()) / 4  # the published ratio makes a dull image duller by its square
    assert match_brightness(dull, target, mask, Photometric(inverted_gain=True)).std() == pytest.approx(
        float(target.std()) / 16, rel=1e-6)
    pair, both = torch.cat([target, 0.2 * target]), torch.cat([mask, mask])
    wrong = match_brightness(torch.cat([target, target]), pair, both, Photometric(whole_batch=True))
    assert (wrong - pair).abs().max() > 0.05 and (match_brightness(torch.cat([target, target]), pair, both,
                                                                   Photometric()) - pair).abs().max() < 1e-9


def test_half_precision_of_a_network_does_not_reach_the_terms():
    a, b = images(8, 1, 3, 8, 8), images(9, 1, 3, 8, 8)
    half_a, half_b = a.bfloat16(), b.bfloat16()
    exact = half_a.float(), half_b.float()
    mask = torch.ones(1, 1, 8, 8, dtype=torch.bool)
    for term in (lambda x, y: photometric_map(x, y, Photometric()), lambda x, y: compare(x, y, mask, Photometric())[0],
                 lambda x, y: edge_aware_smoothness(mean_normalised(x[:, :1]), y), lambda x, y: unit_depth(x[:, :1]),
                 depth_like_light, lambda x, y: depth_from_light(y)):
        torch.testing.assert_close(term(half_a, half_b), term(*exact), atol=0, rtol=0)


def test_a_flat_or_empty_image_gives_no_nan():
    flat, target = torch.full((1, 3, 6, 6), 0.3, requires_grad=True), images(4, 1, 3, 6, 6).float()
    for mask in (torch.ones(1, 1, 6, 6, dtype=torch.bool), torch.zeros(1, 1, 6, 6, dtype=torch.bool)):
        for norm in ("l1", "l2"):
            different, counted = compare(flat, target, mask, Photometric(norm=norm))
            (grad,) = torch.autograd.grad(masked_mean(different, counted), flat)
            assert torch.isfinite(grad).all()
    assert masked_mean(target, torch.zeros(1, 1, 6, 6)) == 0


def test_windows_with_an_invalid_pixel_do_not_count_unless_asked_to():
    a, b = images(5, 1, 3, 10, 10), images(5, 1, 3, 10, 10)
    a[..., 4, 4] = 1 - a[..., 4, 4]
    mask = torch.ones(1, 1, 10, 10, dtype=torch.bool)
    mask[..., 4, 4] = False
    plain = Photometric(match_brightness=False)
    different, counted = compare(a, b, mask, plain)
    assert masked_mean(different, counted) == 0 and (~counted).sum() == 9
    different, counted = compare(a, b, mask, Photometric(match_brightness=False, only_whole_windows=False))
    assert masked_mean(different, counted) > 0 and (~counted).sum() == 1


@given(st.floats(0.01, 100), st.floats(0.01, 100))
def test_depths_that_agree_differ_by_nothing_and_else_by_their_relative_gap(a, b):
    got = depth_difference(torch.full((1, 1, 2, 2), a), torch.full((1, 1, 2, 2), b))
    np.testing.assert_allclose(got, abs(a - b) / (a + b), atol=1e-6)


def test_smoothness_is_the_papers_sum_blind_to_scale_and_forgiving_at_edges():
    depth, guide = 0.5 + images(6, 2, 1, 8, 9), images(7, 2, 3, 8, 9)
    d, g = mean_normalised(depth).numpy(), guide.numpy()
    expected = sum((np.abs(np.diff(d, axis=k)) * np.exp(-np.abs(np.diff(g, axis=k)).mean(1, keepdims=True))).mean()
                   for k in (2, 3))
    got = edge_aware_smoothness(mean_normalised(depth), guide)
    assert float(got) == pytest.approx(expected, rel=1e-9)
    torch.testing.assert_close(got, edge_aware_smoothness(mean_normalised(31 * depth), guide))
    assert edge_aware_smoothness(torch.ones(1, 1, 5, 5), torch.rand(1, 3, 5, 5)) == 0
    step = torch.ones(1, 1, 6, 6)
    step[..., 3:] = 2
    assert edge_aware_smoothness(step, step) < 0.4 * edge_aware_smoothness(step, torch.ones(1, 1, 6, 6))
    usable = torch.ones(1, 1, 6, 6, dtype=torch.bool)
    usable[..., 3] = False
    assert edge_aware_smoothness(step, torch.ones(1, 1, 6, 6), usable) == 0


def test_masks_leave_out_what_they_say():
    image = torch.full((1, 3, 9, 9), 0.5)
    image[..., 4, 4], image[:, 0, 0, 0] = 1.0, 1.0  # a highlight, and a saturated red, which is none
    clear = without_highlights(image, margin=1)
    assert (~clear).sum() == 9 and not clear[..., 3:6, 3:6].any()
    assert whole_windows(torch.ones(1, 1, 4, 4, dtype=torch.bool)).all()
    assert (moving(torch.tensor([0.1, 0.2, 0.3]), torch.tensor([0.2, 0.2, 0.2])) == torch.tensor([1, 0, 0])).all()


def test_pixels_that_no_source_pixel_reaches_are_occluded():
    still = torch.zeros(2, 2, 12, 15)
    assert visible_from(still).all()
    right = still.clone()
    right[:, 0] = 3.0
    assert not visible_from(right)[..., :3].any() and visible_from(right)[..., 3:].all()
    half = still.clone()
    half[:, 1, 6:] = 2.25  # the lower half moves down by 2.25 pixels and opens a hole
    seen = visible_from(half)
    assert seen[..., :6, :].all() and not seen[..., 6:9, :].any() and seen[..., 9:, :].all()
    outside = still + 1000
    assert not visible_from(outside).any()


def test_rotation_supervision_is_the_l1_distance_and_skips_unknown_ones():
    w = np.array([[0.1, -0.2, 0.05], [0.0, 0, 0], [0.3, 0.1, 0]])
    R = torch.from_numpy(se3.so3_exp(w))
    guess = torch.from_numpy(w + np.array([[0.01, 0, -0.02], [0, 0, 0], [9, 9, 9]])).requires_grad_()
    loss = rotation_from_gyro(guess, R, torch.tensor([True, True, False]))
    assert float(loss.detach()) == pytest.approx(0.015, rel=1e-9)
    (grad,) = torch.autograd.grad(loss, guess)
    assert (grad[2] == 0).all() and torch.isfinite(grad).all()
    assert rotation_from_gyro(guess, R, torch.zeros(3, dtype=torch.bool)) == 0


def test_depth_priors_pull_to_one_unit_and_to_the_light():
    assert unit_depth(torch.ones(2, 1, 4, 4)) == 0
    assert float(unit_depth(torch.full((2, 1, 4, 4), np.e**2))) == pytest.approx(4, rel=1e-5)
    depth = 0.5 + 1.5 * torch.linspace(0, 1, 40).view(1, 1, 1, 40).expand(1, 1, 40, 40)
    lit = (0.2 * depth**-2).clamp(max=1) ** (1 / 2.2)  # inverse square, then the camera's gamma
    found = depth_from_light(lit.expand(1, 3, 40, 40))
    ratio = (found / depth)[..., 5:-5]
    assert ratio.std() / ratio.mean() < 0.05
    assert depth_like_light(found, lit.expand(1, 3, 40, 40)) < 1e-6 < depth_like_light(2 * found, lit)
