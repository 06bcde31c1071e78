"""View synthesis against ray tracing: at the truth the images agree, and nothing but the truth makes them agree."""

import numpy as np
import pytest
import torch

from learned.camera_rays import camera_batch
from learned.lie import so3_exp, transform
from learned.losses.geometry import depth_difference
from learned.losses.photometric import Photometric, compare
from learned.losses.terms import masked_mean
from learned.warping import depth_rays, project_depth, sample, synthesise, to_z_depth
from vio import se3
from vio.camera import Camera

KINDS = ["z", "range"]
IDENTITY = torch.eye(4, dtype=torch.float64)[None]


def residual(scene, kind, T, source=2, target=1, **options):
    """Mean absolute difference, difference of depth and share of valid pixels when `source` becomes `target`."""
    depth = scene.depth(kind)
    seen = synthesise(scene.images[[source]], depth[[source]], depth[[target]], T, scene.cameras, kind, **options)
    apart = depth_difference(seen.computed_depth, seen.sampled_depth)
    return (float(masked_mean((seen.image - scene.images[[target]]).abs(), seen.valid)),
            float(masked_mean(apart, seen.valid)), float(seen.valid.double().mean()))


@pytest.mark.parametrize("kind", KINDS)
def test_only_true_depth_and_motion_explain_the_images(scene, kind):
    true, apart, valid = residual(scene, kind, scene.T(1, 2))
    still, _, _ = residual(scene, kind, IDENTITY)
    assert valid > 0.8 and true < 0.002 and still > 30 * true and apart < 0.003
    backward = scene.T(1, 2).clone()
    backward[:, :3, 3] *= -1
    assert residual(scene, kind, backward)[0] > 6 * true
    unturned = scene.T(1, 2).clone()
    unturned[:, :3, :3] = torch.eye(3)
    assert residual(scene, kind, unturned)[0] > 6 * true
    assert residual(scene, kind, scene.T(2, 1))[0] > 6 * true  # the inverse motion is not the motion
    assert residual(scene, kind, scene.T(1, 2), mismatched_corners=True)[0] > 3 * true
    assert residual(scene, "range" if kind == "z" else "z", scene.T(1, 2))[2] > 0.5


@pytest.mark.parametrize("kind", KINDS)
def test_pixels_and_depth_are_those_of_the_numpy_camera(scene, kind):
    got = project_depth(scene.depth(kind)[[0]], scene.T(0, 2), scene.cameras, kind)
    camera = scene.camera
    grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), -1).astype(float)
    points = camera.unproject(grid) * scene.range[0, 0].numpy()[..., None]
    T = np.linalg.inv(scene.T(0, 2)[0].numpy())
    there = points @ T[:3, :3].T + T[:3, 3]
    pixels, seen = camera.project(there)
    edge = [camera.width - 1, camera.height - 1]
    expected = seen & (pixels >= 0).all(-1) & (pixels <= edge).all(-1)
    if kind == "z":
        expected &= (camera.unproject(grid)[..., 2] > 0.01) & (there[..., 2] > 0)
    valid = got.valid[0, 0].numpy()
    np.testing.assert_array_equal(valid, expected)
    np.testing.assert_allclose(got.pixels[0].permute(1, 2, 0).numpy()[valid], pixels[valid], atol=1e-6)
    depth = there[..., 2] if kind == "z" else np.linalg.norm(there, axis=-1)
    np.testing.assert_allclose(got.depth[0, 0].numpy()[valid], depth[valid], atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("model", ["pinhole", "equidistant"])
def test_gradients_of_the_photometric_loss_match_differences(scene_of, model, kind):
    small = Camera(model, 12, 10, 9.0, 8.5, 5.7, 4.4, (-0.05, 0.01, 0.002, -0.003) if model == "pinhole" else ())
    scene = scene_of(small, seed=3)
    images = torch.nn.functional.avg_pool2d(scene.images, 3, 1, 1)  # smoother than a wave of the texture is here
    depth = scene.depth(kind)

    def loss(target_depth, source_depth, turn, step):
        T = transform(so3_exp(turn), step)
        seen = synthesise(images[[2]], source_depth, target_depth, T, scene.cameras, kind)
        different, mask = compare(seen.image, images[[1]], seen.valid, Photometric(match_brightness=False))
        return masked_mean(different * (1 - depth_difference(seen.computed_depth, seen.sampled_depth)), mask)

    xi = se3.log(scene.T(1, 2)[0].numpy())
    turn = torch.from_numpy(xi[None, :3] + 0.01).requires_grad_()
    step = (scene.T(1, 2)[:, :3, 3] + 0.013).requires_grad_()
    guesses = [(value * 1.07 + 1e-3).requires_grad_() for value in (depth[[1]], depth[[2]])]
    assert torch.autograd.gradcheck(loss, (*guesses, turn, step), eps=1e-7, atol=1e-6)


def test_translation_is_recovered_from_depth_and_gyro_by_descent(scene):
    """Also shows sign and order of T. Rotation is given: at nearly even distance it passes for translation."""
    true = scene.T(1, 2)
    step = torch.zeros(1, 3, dtype=torch.float64, requires_grad=True)
    adam = torch.optim.Adam([step], lr=0.01)
    decay = torch.optim.lr_scheduler.CosineAnnealingLR(adam, 60)
    for _ in range(60):
        T = transform(true[:, :3, :3], step)
        seen = synthesise(scene.images[[2]], scene.range[[2]], scene.range[[1]], T, scene.cameras, "range")
        different, mask = compare(seen.image, scene.images[[1]], seen.valid, Photometric())
        adam.zero_grad()
        masked_mean(different, mask).backward()
        adam.step()
        decay.step()
    size = float(true[0, :3, 3].norm())
    assert size > 0.05 and float((step.detach() - true[:, :3, 3]).norm()) < 0.03 * size


def test_what_a_fisheye_sees_sideways_is_masked_as_long_as_depth_means_z():
    wide = Camera("equidistant", 40, 40, 10, 10, 19.5, 19.5)  # 112 degrees to each side
    cameras = camera_batch([wide], torch.float64)
    beyond = np.hypot(*np.meshgrid(np.arange(40) - 19.5, np.arange(40) - 19.5)) / 10 > np.pi / 2
    ones = torch.ones(1, 1, 40, 40, dtype=torch.float64)
    z, along = (project_depth(ones, IDENTITY, cameras, kind) for kind in KINDS)
    assert beyond.any() and not z.valid.numpy()[0, 0][beyond].any() and along.valid.all()
    assert (to_z_depth(ones, cameras, "range").numpy()[0, 0][beyond] == 0).all()
    known = z.valid & depth_rays(cameras, "z")[1]
    torch.testing.assert_close(to_z_depth(ones, cameras, "range")[known],
                               cameras.pixel_rays[0][:, 2:][known])


def test_invalid_pixels_are_masked_and_carry_no_gradient(scene):
    depth = scene.range[[1]].clone()
    depth[..., 5, 5], depth[..., 6, 6], depth[..., 7, 7] = 0, -1, torch.nan
    depth.requires_grad_()
    usable = torch.ones_like(depth, dtype=torch.bool)
    usable[..., 30:34, 30:34] = False
    T = scene.T(1, 2).requires_grad_()
    seen = synthesise(scene.images[[2]], scene.range[[2]], depth, T, scene.cameras, "range", usable, usable)
    assert not seen.valid[..., [5, 6, 7], [5, 6, 7]].any() and not seen.valid[..., 30:34, 30:34].any()
    into_hole = seen.valid.logical_not() & usable
    hole = ((seen.pixels > 29) & (seen.pixels < 34)).all(1, keepdim=True) & usable
    assert hole.sum() > 4 and into_hole[hole].all()  # a source pixel in the hole is no use either
    masked_mean(seen.image * seen.computed_depth * seen.sampled_depth, seen.valid).backward()
    assert torch.isfinite(depth.grad).all() and torch.isfinite(T.grad).all() and depth.grad.abs().sum() > 0
    assert (depth.grad[~seen.valid] == 0).all()


def test_half_precision_of_a_network_does_not_reach_the_coordinates(scene):
    depth, T = scene.range[[1]].bfloat16(), scene.T(1, 2)
    single = scene.cameras.to(dtype=torch.float32)
    plain = synthesise(scene.images[[2]], scene.range[[2]], depth.float(), T, single, "range")
    with torch.autocast("cpu", torch.bfloat16):
        mixed = synthesise(scene.images[[2]].bfloat16(), scene.range[[2]].bfloat16(), depth, T, single, "range")
    assert mixed.pixels.dtype == torch.float32
    torch.testing.assert_close(mixed.pixels, plain.pixels, atol=0, rtol=0)
    assert (mixed.image - plain.image).abs().max() < 0.01


def test_samples_at_whole_pixels_are_the_pixels():
    image = torch.rand(2, 3, 7, 9, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    grid = torch.from_numpy(np.stack(np.meshgrid(np.arange(9.0), np.arange(7.0)))).expand(2, -1, -1, -1)
    torch.testing.assert_close(sample(image, grid), image)
    torch.testing.assert_close(sample(image, grid + 0.5)[..., :-1, :-1],
                               torch.nn.functional.avg_pool2d(image, 2, 1))
