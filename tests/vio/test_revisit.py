"""Two looks at one place: the pose is found despite wrong matches and depth of another scale; nothing is imagined."""

import cv2
import numpy as np
import pytest

from vio import se3
from vio.camera import Camera
from vio.keypoints import Keypoints, find_keypoints, match_keypoints
from vio.rays import rays_from_pixels
from vio.revisit import REASONS, Revisit, View, compare_views

CAMERAS = {"pinhole": Camera("pinhole", 160, 160, 75, 75, 79.5, 79.5, (0.0, 0.0, 0.0, 0.0)),
           "fisheye": Camera("equidistant", 160, 160, 62, 62, 79.5, 79.5, (0.0, 0.0, 0.0, 0.0))}
PIXEL_PX, DEPTH_LOG_SD = 0.8, 0.1


def texture(seed, size=400):
    """Blobs of many sizes, as contrasty as mucosa."""
    rng = np.random.default_rng(seed)
    layers = [cv2.GaussianBlur(rng.standard_normal((size, size)), (0, 0), s) * s for s in (2, 4, 8, 16)]
    image = sum(layers)
    return np.uint8(np.clip(120 + 25 * image / image.std(), 1, 240))


def turned(image, degrees, scale, size=200):
    """A square part of an image, turned and enlarged about its middle; and where its pixels come from."""
    A = cv2.getRotationMatrix2D((image.shape[1] / 2, image.shape[0] / 2), degrees, scale)
    A[:, 2] += (size - image.shape[0]) / 2
    return cv2.warpAffine(image, A, (size, size)), A


@pytest.mark.parametrize(("degrees", "scale", "gain"), [(0, 1.0, 0.7), (25, 1.0, 1.0), (170, 1.2, 1.0)])
def test_matches_lie_where_the_image_went(degrees, scale, gain):
    first, A = turned(texture(1), 0, 1.0)
    second, B = turned(texture(1), degrees, scale)
    a, b = find_keypoints(first), find_keypoints(np.uint8(second * gain))
    pairs = match_keypoints(a, b)
    back = lambda A, p: np.linalg.solve(A[:, :2], (p - A[:, 2]).T).T  # noqa: E731
    off = np.linalg.norm(back(A, a.pixel[pairs[:, 0]]) - back(B, b.pixel[pairs[:, 1]]), axis=1)
    assert len(pairs) > 40 and np.mean(off < 1.5) > 0.95
    assert len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])) == len(pairs)


def test_other_textures_hardly_match():
    a, b = (find_keypoints(turned(texture(seed), 0, 1.0)[0]) for seed in (2, 3))
    assert min(len(a), len(b)) > 100 and len(match_keypoints(a, b)) < 0.05 * len(a)
    nothing = find_keypoints(np.full((64, 64), 90, np.uint8))
    assert len(nothing) == 0 and match_keypoints(nothing, a).shape == (0, 2)


def views(camera, T_i_j, rng, count=60, wrong=0.3, scales=(0.0, 0.0)):
    """Two views of points on a bumpy wall; a share of the matches is wrong, and each depth has a scale of its own."""
    pixel = rng.uniform(15, 145, (4 * count, 2))
    ray = camera.unproject(pixel)
    points = ray * rng.uniform(0.6, 1.6, (len(ray), 1))
    there = (points - T_i_j[:3, 3]) @ T_i_j[:3, :3]
    seen, valid = camera.project(there)
    good = np.flatnonzero(valid & camera.contains(seen) & (there[:, 2] > 0.05))[:count]
    assert len(good) == count
    sides = [(pixel[good], points[good]), (seen[good], there[good])]
    descriptor = np.linalg.qr(rng.standard_normal((128, 128)))[0][:count].astype(np.float32)
    mixed = np.arange(count)
    bad = rng.permutation(count)[:round(wrong * count)]
    mixed[bad] = np.roll(bad, 1)
    out = []
    for order, (pixels, at), scale in zip((np.arange(count), mixed), sides, scales, strict=True):
        noisy = pixels[order] + rng.normal(0, PIXEL_PX, (count, 2))
        rays, _ = rays_from_pixels(camera, noisy)
        distance = np.linalg.norm(at[order], axis=1) * np.exp(scale + rng.normal(0, DEPTH_LOG_SD, count))
        out.append(View(Keypoints(noisy, descriptor, np.zeros(count)), rays, distance, camera.width))
    return out


@pytest.mark.parametrize("name", CAMERAS)
def test_the_pose_survives_wrong_matches_and_depths_of_two_scales(name):
    rng, chi2, shift = np.random.default_rng(4), [], []
    for _ in range(25):
        T = se3.exp(np.r_[rng.normal(0, 0.15, 3), rng.normal(0, 0.12, 3)])
        first, second = views(CAMERAS[name], T, rng, scales=(0.15, -0.15))
        found = compare_views(first, second)
        assert isinstance(found, Revisit) and found.inliers > 30
        off = se3.log(se3.inverse(T) @ found.T_i_j)
        chi2.append(off @ np.linalg.solve(found.cov, off))
        shift.append(np.linalg.norm(off[3:]))
        assert found.log_scale_ratio == pytest.approx(0.3, abs=0.2)
    assert np.median(shift) < 0.05  # of a wall at 0.6 to 1.6; 3D-3D alignment would be off by 0.3
    assert 0.1 < np.mean(chi2) / 6 < 2.0


def test_matches_without_a_common_pose_are_refused():
    rng = np.random.default_rng(6)
    results = []
    for _ in range(40):
        first, second = views(CAMERAS["pinhole"], np.eye(4), rng, wrong=1.0)
        results.append(compare_views(first, second))
    assert set(results) <= set(REASONS)


def test_reasons():
    rng = np.random.default_rng(7)
    first, second = views(CAMERAS["pinhole"], se3.exp(np.r_[0, 0, 0.1, 0.05, 0, 0]), rng, wrong=0.0)
    few = View(first.keypoints.select(np.arange(6)), first.rays.select(np.arange(6)), first.distance[:6], 160)
    assert compare_views(few, second) == "few matches"
    blind = View(first.keypoints, first.rays, np.zeros(len(first.keypoints)), 160)
    assert compare_views(blind, second) == "few matches"
    near = View(first.keypoints, first.rays, first.distance * np.exp(-3.0), 160)
    assert compare_views(near, second) == "depths contradict"
