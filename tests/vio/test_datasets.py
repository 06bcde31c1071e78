"""Generated samples of every format: what is read is what was meant, and it survives the conversion to ASL."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from fusion.cli_parser import FORMATS
from tests.vio.samples import (
    CAMERA,
    IMU_S,
    PATIENT,
    SAMPLES,
    T_BODY_CAMERA,
    endoslam,
    imu_values,
    scared,
    simcol3d,
    vrcaps,
)
from vio import check_refinable, open_recording
from vio.conversion import convert_to_asl
from vio.errors import RecordingError
from vio.formats import READERS
from vio.formats.c3vd import ENDOSCOPE
from vio.formats.declared import Declared
from vio.formats.omnidirectional import fit_equidistant
from vio.formats.unity import read_unity_poses


@pytest.fixture(params=SAMPLES)
def sample(request, tmp_path):
    made = SAMPLES[request.param](tmp_path / "data")
    made.format = request.param.split()[0]
    return made


def test_a_folder_is_recognised_as_what_it_is_and_as_nothing_else(sample):
    assert [name for name, reader in READERS.items() if reader.matches(sample.root)] == [
        *([sample.format] if sample.format != "video" else ["video", "images"])]
    assert next(name for name, reader in READERS.items() if reader.matches(sample.root)) == sample.format
    assert set(FORMATS) == set(READERS)


def test_what_is_read_is_what_was_meant(sample):
    recording = open_recording(sample.root, declared=sample.declared)
    np.testing.assert_array_equal(recording.frame_t_ns - recording.frame_t_ns[0],
                                  np.round(np.array(sample.seconds) * 1e9).astype(np.int64))
    for k, image in enumerate(sample.images):
        np.testing.assert_array_equal(recording.frame(k), image)
    if sample.T_world_camera is None:
        assert recording.truth is None
    else:
        T_world_camera = recording.truth_at_frames().T_world_body @ recording.calibration.T_body_camera
        np.testing.assert_allclose(T_world_camera, sample.T_world_camera, atol=1e-10)
        np.testing.assert_allclose(recording.truth.t_s, sample.seconds, atol=1e-9)
    if sample.depth_m is not None:
        assert recording.has_depth
        there = [k for k in range(len(recording)) if recording.depth_paths[k] is not None]
        assert len(there) == (5 if sample.format == "tum-rgbd" else 6)
        for k in there:
            np.testing.assert_allclose(recording.depth_m(k), sample.depth_m[k], atol=sample.depth_tolerance_m)
            np.testing.assert_array_equal(recording.depth_m(k) == 0, sample.depth_m[k] == 0)


def test_a_recording_without_imu_can_be_predicted_on_and_not_refined(sample):
    recording = open_recording(sample.root, declared=sample.declared)
    assert recording.has_images
    if sample.format in ("images", "video"):
        assert check_refinable(recording) is recording
    else:
        with pytest.raises(RecordingError, match=r"0 inertial samples; refinement needs a stream"):
            check_refinable(recording)


def test_conversion_keeps_everything_and_tells_nothing_of_the_path(sample, tmp_path: Path):
    before = {file: (file.read_bytes(), file.stat().st_mtime_ns) for file in sample.root.rglob("*") if file.is_file()}
    source = convert_to_asl(sample.root, tmp_path / "REC", declared=sample.declared)
    back = open_recording(tmp_path / "REC")
    np.testing.assert_array_equal(back.frame_t_ns, source.frame_t_ns)
    for name in ("t_ns", "gyro_rad_s", "accel_m_s2"):
        np.testing.assert_array_equal(getattr(back.imu, name), getattr(source.imu, name))
    assert back.calibration.camera == source.calibration.camera and back.provenance == source.provenance
    np.testing.assert_allclose(back.calibration.T_body_camera, source.calibration.T_body_camera, atol=1e-15)
    if len(source.imu):
        assert back.calibration.imu_noise == source.calibration.imu_noise
        assert back.calibration.time_offset_s == source.calibration.time_offset_s
    assert (back.truth is None) == (source.truth is None)
    if source.truth is not None:
        np.testing.assert_allclose(back.truth.T_world_body, source.truth.T_world_body, atol=1e-14)
        np.testing.assert_allclose(back.truth.t_s, source.truth.t_s, atol=1e-9)
    assert (back.has_depth, back.has_depth_images) == (source.has_depth, source.has_depth_images)
    for k in range(len(source)):
        np.testing.assert_array_equal(back.frame(k), source.frame(k))
        if source.frame_paths[k] is not None:
            assert back.frame_paths[k].read_bytes() == source.frame_paths[k].read_bytes()
        if source.depth_paths[k] is None:
            assert back.depth_paths[k] is None
        elif source.has_depth:
            unit_m = source.stored_depth.unit_m
            np.testing.assert_allclose(back.depth_m(k), source.depth_m(k), atol=0.51 * unit_m)
        else:
            np.testing.assert_array_equal(back.relative_inverse_depth(k), source.relative_inverse_depth(k))
            assert back.depth_paths[k].read_bytes() == source.depth_paths[k].read_bytes()
    assert before == {file: (file.read_bytes(), file.stat().st_mtime_ns) for file in before}
    for file in (tmp_path / "REC").rglob("*"):
        assert PATIENT not in file.name
        assert not file.is_file() or PATIENT.encode() not in file.read_bytes()
    assert back.name == "REC"


def test_depth_files_that_are_plain_already_are_copied(tmp_path: Path):
    made = simcol3d(tmp_path)
    plain = cv2.imread(str(made.root / "Depth_0001.png"), cv2.IMREAD_UNCHANGED)
    plain[plain == 255 * 256] = 254 * 256
    cv2.imwrite(str(made.root / "Depth_0001.png"), plain)
    convert_to_asl(made.root, tmp_path / "REC", declared=made.declared)
    ours = tmp_path / "REC" / "mav0" / "depth0" / "data"
    assert (ours / "100000000.png").read_bytes() == (made.root / "Depth_0001.png").read_bytes()
    beyond = cv2.imread(str(ours / "0.png"), cv2.IMREAD_UNCHANGED)
    assert (beyond[3] == 0).all() and beyond.dtype == np.uint16


def test_an_imu_in_degrees_and_g_becomes_si(tmp_path: Path):
    recording = open_recording(SAMPLES["images"](tmp_path).root)
    gyro, accel = imu_values()
    np.testing.assert_array_equal(recording.imu.t_ns, np.round(IMU_S * 1e9).astype(np.int64))
    np.testing.assert_allclose(recording.imu.gyro_rad_s, gyro, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(recording.imu.accel_m_s2, accel, rtol=1e-10, atol=1e-12)
    assert recording.calibration.camera == CAMERA and recording.calibration.time_offset_s == 0.0125
    np.testing.assert_allclose(recording.calibration.T_body_camera, T_BODY_CAMERA, atol=1e-12)


def test_a_declared_camera_moves_the_body_and_not_the_camera(tmp_path: Path):
    made = scared(tmp_path)
    own = open_recording(made.root, declared=made.declared)
    declared = replace(made.declared, calibration=replace(own.calibration, T_body_camera=T_BODY_CAMERA))
    moved = open_recording(made.root, declared=declared)
    assert np.abs(moved.truth.T_world_body - own.truth.T_world_body).max() > 0.1
    np.testing.assert_allclose(moved.truth.T_world_body @ T_BODY_CAMERA, own.truth.T_world_body, atol=1e-12)


def test_unity_units_are_metres_only_when_somebody_says_so(tmp_path: Path):
    made = vrcaps(tmp_path)
    quiet = open_recording(made.root)
    assert quiet.truth is None and not quiet.has_depth and quiet.has_depth_images
    with pytest.raises(RecordingError, match=r"^depth of frame 0 \(aov_image_0000\.png\) .*unknown factor.*no metres"):
        quiet.depth_m(0)
    told = open_recording(made.root, declared=made.declared)
    z, w = told.depth_m(2), quiet.relative_inverse_depth(2)
    slope = np.polyfit(w[z > 0], 1 / z[z > 0], 1)  # affine in 1/z: v (f - n) / (n f) + 1 / f
    np.testing.assert_allclose(slope, [(0.2 - 0.001) / (0.2 * 0.001), 1 / 0.2], rtol=1e-4)
    np.testing.assert_allclose(told.relative_inverse_depth(2)[z > 0], 1 / z[z > 0], rtol=1e-6)


def test_the_unfinished_line_of_a_pose_file_is_dropped_even_if_it_looks_whole(tmp_path: Path):
    poses = read_unity_poses(endoslam(tmp_path).root / "Poses" / "stomach_position_rotation.csv")
    assert len(poses.t_ns) == 6 and np.linalg.det(poses.T_world_object[:, :3, :3]) == pytest.approx(np.ones(6))


def test_frames_without_a_row_of_their_own_need_a_rate(tmp_path: Path):
    root = endoslam(tmp_path).root
    (root / "Frames" / "image_0009.png").write_bytes((root / "Frames" / "image_0000.png").read_bytes())
    with pytest.raises(RecordingError, match=r"frame 9 has no row in stomach_position_rotation\.csv \(6 rows\)"):
        open_recording(root)
    at_rate = open_recording(root, declared=Declared(rate_hz=30))
    assert at_rate.frame_t_ns[-1] == 300_000_000 and len(at_rate) == 7


def test_c3vd_camera_is_the_published_one_within_half_a_pixel():
    fitted = fit_equidistant(ENDOSCOPE)
    grid = np.stack(np.meshgrid(np.arange(0, 1350, 13.0), np.arange(0, 1080, 13.0)), axis=-1).reshape(-1, 2)
    # The published formula, written out.
    c, d, e = 0.99998688224999, 0.00288273829525059, -0.00296316513429569
    u, v = np.linalg.solve([[c, d], [e, 1]], (grid - [678.544839263292, 542.975887548343]).T)
    rho = np.hypot(u, v)
    w = 769.243600037458 - 8.12770624150226e-4 * rho**2 + 6.25674244578925e-07 * rho**3 - 1.1966218214428e-09 * rho**4
    rays = np.stack([u, v, w], axis=1) @ fitted.T_omni_camera[:3, :3]  # into the fitted camera's axes
    pixels, seen = fitted.camera.project(rays)
    assert seen.all() and np.linalg.norm(pixels - grid, axis=1).max() < 0.5
    # Without the turn about the axis the error would be several times larger.
    turned = fitted.camera.project(np.stack([u, v, w], axis=1))[0]
    assert np.linalg.norm(turned - grid, axis=1).max() > 2


def test_big_frames_are_nothing_special(tmp_path: Path):
    root = tmp_path / "uhd"
    root.mkdir()
    cv2.imwrite(str(root / "0.png"), np.zeros((2160, 3840, 3), np.uint8))
    (root / "frames.csv").write_text("t_s,filename\n0,0.png\n")
    assert convert_to_asl(root, tmp_path / "REC").has_images
    assert open_recording(tmp_path / "REC").frame(0).shape == (2160, 3840, 3)
