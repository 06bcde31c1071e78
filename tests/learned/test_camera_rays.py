"""Cameras in torch against the numpy cameras, which are tested against OpenCV; their gradients against differences."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from learned.camera_rays import camera_batch
from learned.lie import halfway, inverse, so3_exp, so3_log, transform
from vio import se3
from vio.camera import Camera
from vio.errors import CameraError

EUROC = Camera("pinhole", 96, 64, 58.5, 61, 46.9, 33.1, (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05))
TANGENTIAL = Camera("pinhole", 96, 64, 60, 62, 49, 31, (-0.2, 0.05, 0.01, -0.008, 0.003))
FOLDING = Camera("pinhole", 96, 64, 28, 28, 48.5, 32.1, (0.2345, -0.7908, 0, 0))
FISHEYE = Camera("equidistant", 96, 64, 30, 30.5, 48.2, 31.5, (-0.02, 0.003, -0.001, 0.0002))
WIDE = Camera("equidistant", 96, 64, 17, 17, 47.5, 31.5)
PLAIN = Camera("pinhole", 96, 64, 40, 41, 47, 33)
ALL = (EUROC, TANGENTIAL, FOLDING, FISHEYE, WIDE, PLAIN)
BATCH = camera_batch(ALL, torch.float64)


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1e-3, 1.0, 1e3]))
def test_every_camera_of_a_mixed_batch_projects_like_its_numpy_twin(seed, unit):
    points = unit * np.random.default_rng(seed).normal([0, 0, 0.5], 1, (len(ALL), 40, 3))
    points[:, 0], points[:, 1], points[:, 2] = 0, [0, 0, unit], [0, 0, -unit]
    pixels, valid = BATCH.project(torch.from_numpy(points).permute(0, 2, 1))
    assert torch.isfinite(pixels).all()
    for camera, p, uv, seen in zip(ALL, points, pixels, valid, strict=True):
        expected, expected_seen = camera.project(p)
        np.testing.assert_array_equal(seen.numpy(), expected_seen)
        np.testing.assert_allclose(uv.T[seen].numpy(), expected[expected_seen], atol=1e-5, rtol=1e-9)


@pytest.mark.parametrize("size", [(96, 64), (48, 32), (33, 40)])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_rays_of_all_pixels_are_those_of_the_numpy_camera(size, dtype):
    cameras = [camera.resized(*size) for camera in ALL]
    batch = BATCH.resized(*size).to(dtype=dtype)
    rays, valid = batch.pixel_rays
    grid = np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1])), -1).astype(float)
    for k, camera in enumerate(cameras):
        expected = camera.unproject(grid)
        reached = np.isfinite(expected).all(-1)
        differs = valid[k].numpy() != reached
        assert differs.mean() <= (0 if dtype == torch.float64 else 2e-3), camera  # float32 at the fold itself
        seen = reached & ~differs
        back = rays[k].permute(1, 2, 0).numpy().astype(float)
        at, _ = camera.project(back[seen])
        steady = 1e-5 if dtype == torch.float64 else 2e-3
        far = np.abs(at - grid[seen]).max(-1)
        assert np.quantile(far, 0.99) < steady and far.max() < 100 * steady, camera
        np.testing.assert_allclose(np.linalg.norm(back, axis=-1), 1, atol=1e-6)
        if dtype == torch.float64:
            np.testing.assert_allclose(back[seen], expected[seen], atol=1e-7)


def test_resizing_cropping_repeating_and_selecting_are_what_the_numpy_camera_says():
    small = BATCH.resized(40, 30)
    for k, camera in enumerate(ALL):
        twin = camera.resized(40, 30)
        np.testing.assert_allclose(small.intrinsics[k], [twin.fx, twin.fy, twin.cx, twin.cy], atol=1e-12)
    point = torch.tensor([0.1, -0.2, 1.0], dtype=torch.float64).expand(len(ALL), 3)
    shift = torch.arange(len(ALL), dtype=torch.float64)
    moved = BATCH.cropped(shift, 2 * shift, 50, 40).project(point)[0]
    np.testing.assert_allclose(BATCH.project(point)[0] - moved, torch.stack([shift, 2 * shift], 1), atol=1e-12)
    twice, picked = BATCH.repeated(2), BATCH.select([3, 3, 0])
    torch.testing.assert_close(twice.pixel_rays[0][len(ALL) + 1], BATCH.pixel_rays[0][1])
    torch.testing.assert_close(twice.unproject(twice.pixel_grid.expand(12, -1, -1, -1))[0], twice.pixel_rays[0])
    torch.testing.assert_close(picked.pixel_rays[0][1], BATCH.pixel_rays[0][3])


def test_gradients_of_points_pixels_and_intrinsics_match_differences():
    rng = torch.Generator().manual_seed(0)
    points = torch.rand(len(ALL), 3, 5, generator=rng, dtype=torch.float64) - torch.tensor([0.5, 0.5, -0.8])[:, None]
    points[:, :2, 0] = 0  # on the axis
    points.requires_grad_()
    assert torch.autograd.gradcheck(lambda p: BATCH.project(p)[0], points)
    pixels = 20 + 20 * torch.rand(len(ALL), 2, 4, generator=rng, dtype=torch.float64)
    pixels[:, :, 0] = BATCH.intrinsics[:, 2:]  # on the axis
    assert torch.autograd.gradcheck(lambda uv: BATCH.unproject(uv)[0], pixels.clone().requires_grad_())
    assert torch.autograd.gradcheck(lambda k: BATCH.with_intrinsics(k).unproject(pixels[:, :, 1:])[0],
                                    BATCH.intrinsics.clone().requires_grad_())


def test_points_that_cannot_be_seen_have_no_gradient_and_no_nan():
    points = torch.tensor([[0.0, 0, 0], [0, 0, -1], [1, 0, -2], [torch.nan, 0, 1], [torch.inf, 0, 1], [300, 0, 1],
                           [1, 0, 1e-30]]).T.expand(len(ALL), 3, 7).clone().requires_grad_()
    pixels, valid = BATCH.to(dtype=torch.float32).project(points)
    pixels.sum().backward()
    assert torch.isfinite(pixels).all() and torch.isfinite(points.grad[:, :, [0, 1, 2, 4, 5, 6]]).all()
    assert not valid[:, [0, 1, 3, 4]].any() and not valid[0, 2] and valid[4, 2]  # the wide fisheye sees behind itself


def test_a_batch_of_cameras_needs_one_size():
    with pytest.raises(CameraError, match="48 x 32 and 96 x 64"):
        camera_batch([PLAIN, PLAIN.resized(48, 32)])
    with pytest.raises(CameraError, match="at least one"):
        camera_batch([])


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3), st.sampled_from([0.0, 1e-9, 1e-5, 1e-3, 0.1, 1.7]))
def test_rotations_agree_with_numpy_near_and_at_rest(direction, size):
    w = size * np.array(direction)
    R = so3_exp(torch.from_numpy(w))
    np.testing.assert_allclose(R, se3.so3_exp(w), atol=1e-14)
    np.testing.assert_allclose(so3_log(R), w, atol=1e-12)
    T = transform(R, torch.from_numpy(w + 1))
    np.testing.assert_allclose(inverse(T) @ T, np.eye(4), atol=1e-14)


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3), st.sampled_from([0.0, 1e-9, 1e-5, 1e-3, 0.1, 1.2]))
def test_halfway_is_as_far_from_either_motion_and_keeps_equal_ones(direction, size):
    w = torch.from_numpy(size * np.array(direction))
    a, b = transform(so3_exp(-w), w), transform(so3_exp(0.5 * w), 3 * w + 1)
    middle = halfway(a, b)
    np.testing.assert_allclose(halfway(a, a), a, atol=1e-14)
    np.testing.assert_allclose(middle, halfway(b, a), atol=1e-12)
    np.testing.assert_allclose(so3_log(middle[:3, :3]), -0.25 * w, atol=1e-12)
    np.testing.assert_allclose(middle[:3, 3], 2 * w + 0.5, atol=1e-14)


@pytest.mark.parametrize("size", [0.0, 1e-8, 9e-4, 1.1e-3, 0.5, 2.5])
def test_gradients_of_rotations_match_differences_near_and_at_rest(size):
    w = (size * torch.tensor([[0.6, -0.64, 0.48]], dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(so3_exp, w)
    assert torch.autograd.gradcheck(lambda v: so3_log(so3_exp(v)), w, atol=1e-6)
