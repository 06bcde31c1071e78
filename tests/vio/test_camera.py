"""Camera models against OpenCV, and there and back again over the whole image and beyond 90 degrees."""

import cv2
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from vio.camera import Camera
from vio.errors import CameraError

EUROC = Camera("pinhole", 752, 480, 458.654, 457.296, 367.215, 248.375,
               (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05))
TANGENTIAL = Camera("pinhole", 640, 480, 400, 410, 330, 235, (-0.2, 0.05, 0.01, -0.008, 0.003))
PILLCAM = Camera("pinhole", 256, 256, 74.2002, 74.4184, 129.9724, 129.1209, (0.2345, -0.7908, 0, 0))  # folds at 49 px
FISHEYE = Camera("equidistant", 320, 320, 100, 101, 160.5, 158.0, (-0.02, 0.003, -0.001, 0.0002))
PLAIN_FISHEYE = Camera("equidistant", 480, 480, 120, 120, 239.5, 239.5)
ALL = (EUROC, TANGENTIAL, PILLCAM, FISHEYE, PLAIN_FISHEYE)


@pytest.mark.parametrize("camera", ALL)
def test_projection_agrees_with_opencv(camera):
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.3, -0.3, 0.7], [0.3, 0.3, 1.3], (500, 3))
    pixels, valid = camera.project(points)
    assert valid.all()
    zero, k = np.zeros(3), np.array(camera.distortion)
    if camera.model == "pinhole":
        oracle = cv2.projectPoints(points, zero, zero, camera.K, k)[0][:, 0]
    else:
        oracle = cv2.fisheye.projectPoints(points[:, None], zero, zero, camera.K, k)[0][:, 0]
    np.testing.assert_allclose(pixels, oracle, atol=1e-9)


@pytest.mark.parametrize("camera", ALL)
def test_every_pixel_goes_out_and_comes_back(camera):
    grid = np.stack(np.meshgrid(np.arange(0, camera.width, 7.0), np.arange(0, camera.height, 7.0)), axis=-1)
    rays = camera.unproject(grid)
    assert rays.shape == (*grid.shape[:2], 3)
    reached = np.isfinite(rays).all(axis=-1)
    assert reached.mean() == (1 if camera is not PILLCAM else pytest.approx(0.11, abs=0.03))
    np.testing.assert_allclose(np.linalg.norm(rays[reached], axis=-1), 1, atol=1e-14)
    pixels, valid = camera.project(5.0 * rays[reached])
    assert valid.all()
    np.testing.assert_allclose(pixels, grid[reached], atol=1e-7)


@given(st.sampled_from(ALL), st.floats(0, np.pi), st.floats(-np.pi, np.pi), st.floats(1e-6, 1e6))
@example(EUROC, 1.5, 3.0, 1.0)
@example(PLAIN_FISHEYE, float(np.nextafter(np.pi, 0)), 0.03125, 1.0)
def test_every_ray_that_is_seen_comes_back_and_no_other_does(camera, angle, around, distance):
    ray = np.array([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)])
    pixel, valid = camera.project(distance * ray)
    if not valid:
        assert np.isnan(pixel).all()
        assert angle > (0.6 if camera is PILLCAM else 1.5)
        return
    back = camera.unproject(pixel)
    # A pinhole 89 degrees aside has 1e4 pixels per radian there; near its fold two pixels lie close together.
    np.testing.assert_allclose(back, ray, atol=1e-6)


def test_the_fisheye_sees_behind_itself():
    pixel, valid = PLAIN_FISHEYE.project([np.sin(1.9), 0.0, np.cos(1.9)])  # 109 degrees off axis, z < 0
    assert valid
    np.testing.assert_allclose(pixel, [239.5 + 120 * 1.9, 239.5])
    np.testing.assert_allclose(PLAIN_FISHEYE.unproject(pixel), [np.sin(1.9), 0, np.cos(1.9)], atol=1e-12)


@pytest.mark.parametrize("camera", ALL)
def test_pixels_move_outward_as_long_as_points_are_seen(camera):
    angle = np.linspace(1e-3, np.pi - 1e-3, 2000)
    pixels, valid = camera.project(np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=-1))
    seen = int(valid.sum())
    assert seen > 100 and valid[:seen].all() and not valid[seen:].any()
    if camera is not TANGENTIAL:
        assert (np.diff(pixels[:seen, 0]) > 0).all()


@pytest.mark.parametrize("point", [[0, 0, 0], [0, 0, -1.0], [np.nan, 0, 1], [0, 0, np.inf], [1.0, 0, 1e-9]])
@pytest.mark.parametrize("camera", [EUROC, TANGENTIAL])
def test_points_no_pinhole_can_see(camera, point):
    pixel, valid = camera.project(point)
    assert not valid and np.isnan(pixel).all()


def test_the_optical_axis_hits_the_principal_point():
    for camera in ALL:
        pixel, valid = camera.project([0.0, 0.0, 2.0])
        assert valid
        np.testing.assert_allclose(pixel, [camera.cx, camera.cy])
        np.testing.assert_allclose(camera.unproject([camera.cx, camera.cy]), [0, 0, 1], atol=1e-15)


@given(st.sampled_from(ALL), st.integers(1, 2000), st.integers(1, 2000))
def test_resizing_keeps_every_point_at_its_place_in_the_image(camera, width, height):
    points = np.array([[0.1, -0.2, 1.0], [-0.3, 0.1, 1.0]])
    small, _ = camera.resized(width, height).project(points)
    full, _ = camera.project(points)
    size, new = np.array([camera.width, camera.height]), np.array([width, height])
    np.testing.assert_allclose((small + 0.5) / new, (full + 0.5) / size, atol=1e-12)


def test_resizing_agrees_with_opencv_on_an_image():
    image = np.zeros((480, 640), np.float32)
    image[100:108, 200:208] = 1  # centre of mass 203.5, 103.5
    small = cv2.resize(image, (160, 120), interpolation=cv2.INTER_AREA)
    v, u = np.nonzero(small)
    camera = Camera("pinhole", 640, 480, 500, 500, 203.5, 103.5).resized(160, 120)
    np.testing.assert_allclose([camera.cx, camera.cy], [u.mean(), v.mean()])


def test_contains_reaches_half_a_pixel_beyond_the_outer_centres():
    corners = [[-0.5, -0.5], [-0.51, 0], [751.49, 479.49], [751.5, 0], [0, 479.5], [np.nan, 3]]
    np.testing.assert_array_equal(EUROC.contains(corners), [True, False, True, False, False, False])


@pytest.mark.parametrize(("change", "words"), [
    ({"model": "omni"}, "model 'omni'.*pinhole, equidistant"),
    ({"width": 0}, "width is 0"),
    ({"height": 10.5}, "height is 10.5"),
    ({"fx": -400.0}, "positive"),
    ({"fy": float("nan")}, "not finite"),
    ({"cx": 2000.0}, "cx is 2000 in an image of 640 x 480"),
    ({"distortion": (0.1, 0.2)}, "2 distortion coefficients"),
    ({"model": "equidistant"}, "5 distortion coefficients for model 'equidistant', expected 4"),
])
def test_impossible_intrinsics_are_named(change, words):
    values = {**TANGENTIAL.__dict__, **change}
    values = {key: value for key, value in values.items() if not key.startswith("_")}
    with pytest.raises(CameraError, match=words):
        Camera(**values)
