"""The recording: clocks, images as they are asked for, depth, truth, and what is needed to refine."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from vio.calibration import Calibration
from vio.errors import ImuError, RecordingError
from vio.imu import ImuSamples
from vio.recording import Recording, TruthState, check_refinable
from vio.trajectory import Trajectory


def test_times_count_from_the_first_frame_on_the_cameras_clock(recording):
    np.testing.assert_allclose(recording.frame_t_s, np.arange(7) * 0.333333333, atol=1e-12)
    assert recording.duration_s == recording.frame_t_s[-1]
    # t_imu_clock = t_camera_clock + offset: an IMU clock that runs ahead is turned back.
    np.testing.assert_allclose(recording.imu_t_s, -0.05 + np.arange(100) * 0.025 - 0.0125, atol=1e-12)


def test_colour_frames_come_as_rgb_and_grey_ones_as_grey(recording, tmp_path: Path):
    image = recording.frame(3)
    assert image.dtype == np.uint8 and image.shape == (24, 32, 3)
    np.testing.assert_array_equal(image[5, 5], [200, 100, 10])
    np.testing.assert_array_equal(image[0, 0], [3, 3, 3])
    grey = tmp_path / "grey.png"
    cv2.imwrite(str(grey), np.arange(24 * 32, dtype=np.uint8).reshape(24, 32))
    paths = (grey, *recording.frame_paths[1:])
    np.testing.assert_array_equal(replace(recording, frame_paths=paths).frame(0).ravel(), np.arange(24 * 32) % 256)


def test_euroc_frames(shared_data):
    from vio import open_recording

    euroc = open_recording(shared_data / "euroc_v101")
    assert len(euroc) == 24 and euroc.has_images and not euroc.has_depth
    assert all(euroc.frame(k).shape == (480, 752) for k in (0, 23))
    oracle = cv2.imread(str(euroc.frame_paths[5]), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(euroc.frame(5), oracle)
    assert check_refinable(euroc) is euroc


def test_depth_in_metres_with_zero_for_unknown(recording):
    depth = recording.depth_m(4)
    assert depth.dtype == np.float32 and depth.shape == (24, 32)
    np.testing.assert_allclose(depth, 0.04)
    assert (recording.depth_m(0) == 0).all()
    assert recording.depth_m(2) is None


def test_truth_is_interpolated_where_it_reaches(recording):
    at_frames = recording.truth_at_frames()
    np.testing.assert_allclose(at_frames.t_s, recording.frame_t_s)
    between = recording.truth.positions_m[3] * (1 - 1 / 3) + recording.truth.positions_m[4] / 3
    np.testing.assert_allclose(at_frames.positions_m[1], between, atol=1e-8)
    late = replace(recording, truth=recording.truth.select(np.arange(10, 21)), truth_state=None)
    np.testing.assert_allclose(late.truth_at_frames().t_s, recording.frame_t_s[3:], atol=1e-12)


def test_truth_that_is_absent_or_elsewhere(recording):
    with pytest.raises(RecordingError, match="has no truth"):
        replace(recording, truth=None, truth_state=None).truth_at_frames()
    elsewhere = Trajectory(recording.truth.t_s + 1e6, recording.truth.T_world_body)
    with pytest.raises(RecordingError, match=r"covers none of the frames.*one clock"):
        replace(recording, truth=elsewhere, truth_state=None).truth_at_frames()


def cut_off(content: bytes) -> bytes:
    return content[: len(content) // 2]


@pytest.mark.parametrize(("damage", "words"), [
    (cut_off, "cut off"), (lambda content: b"", "not an image"), (lambda content: b"hello", "not an image"),
])
def test_damaged_images_are_refused(recording, damage, words):
    path = recording.frame_paths[2]
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(RecordingError, match=rf"^frame 2: images/2\.png .*{words}"):
        recording.frame(2)
    path = recording.depth_paths[3]
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(RecordingError, match=rf"^depth of frame 3: depths/3\.png .*{words}"):
        recording.depth_m(3)


def test_a_jpeg_that_is_cut_off_is_refused(recording, tmp_path: Path):
    file = tmp_path / "0.jpg"
    cv2.imwrite(str(file), np.random.default_rng(0).integers(0, 255, (24, 32, 3), dtype=np.uint8))
    whole = replace(recording, frame_paths=(file,) * 7)
    assert whole.frame(0).shape == (24, 32, 3)
    file.write_bytes(cut_off(file.read_bytes()))
    with pytest.raises(RecordingError, match="cut off"):
        whole.frame(0)


def test_images_that_are_missing_or_of_another_size(recording):
    recording.frame_paths[4].unlink()
    assert not recording.has_images and recording.has_any_image
    with pytest.raises(RecordingError, match=r"^frame 4: images/4\.png cannot be read"):
        recording.frame(4)
    cv2.imwrite(str(recording.frame_paths[5]), np.zeros((24, 30, 3), np.uint8))
    with pytest.raises(RecordingError, match=r"^frame 5 .*30 x 24 pixels but the camera 32 x 24"):
        recording.frame(5)
    bare = replace(recording, frame_paths=(), depth_paths=())
    assert not bare.has_images and not bare.has_any_image and bare.depth_m(0) is None
    with pytest.raises(RecordingError, match=r"frame 0: .*no images"):
        bare.frame(0)


@pytest.mark.parametrize("k", [-1, 7])
def test_frames_that_do_not_exist(recording, k):
    for read in (recording.frame, recording.depth_m):
        with pytest.raises(RecordingError, match=f"frame {k}: the recording has frames 0 to 6"):
            read(k)


def test_depth_must_be_16_bit(recording):
    cv2.imwrite(str(recording.depth_paths[0]), np.zeros((24, 32), np.uint8))
    with pytest.raises(RecordingError, match=r"depth of frame 0.*uint8.*16-bit"):
        recording.depth_m(0)


@pytest.mark.parametrize(("change", "words"), [
    ({"frame_t_ns": np.zeros(0, np.int64)}, "no frames"),
    ({"frame_t_ns": np.arange(7.0)}, "int64"),
    ({"frame_t_ns": np.array([0, 1, 2, 2, 3, 4, 5])}, "frame 3 at 2 ns does not follow 2 ns"),
    ({"frame_paths": (None,) * 6}, "7 frames but 6 frame_paths"),
    ({"depth_unit_m": 0.0}, "depth_unit_m"),
    ({"truth": None}, "truth has 0 poses but 21 velocities"),
])
def test_parts_that_do_not_fit_together(recording, change, words):
    with pytest.raises(RecordingError, match=f"^recording seven: .*{words}"):
        replace(recording, **change)


def test_truth_state_wants_three_columns():
    with pytest.raises(RecordingError, match="gyro_bias_rad_s"):
        TruthState(np.zeros((4, 3)), np.zeros((4, 2)), np.zeros((4, 3)))


def cut_imu(recording: Recording, part: slice) -> Recording:
    imu = recording.imu
    return replace(recording, imu=ImuSamples(imu.t_ns[part], imu.gyro_rad_s[part], imu.accel_m_s2[part]))


def test_what_refinement_needs(recording):
    assert check_refinable(recording) is recording
    one = Recording("one", recording.frame_t_ns[:1], recording.imu, Calibration())
    with pytest.raises(RecordingError, match="1 frame; motion needs at least 2"):
        check_refinable(one)
    for part in (slice(0), slice(1)):
        with pytest.raises(RecordingError, match=f"{part.stop} inertial samples"):
            check_refinable(cut_imu(recording, part))
    for part in (slice(10, None), slice(60)):
        with pytest.raises(ImuError, match=r"imu covers .* but frames run from 0\.000 to 2\.000"):
            check_refinable(cut_imu(recording, part))
