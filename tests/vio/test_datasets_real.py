"""Real samples of other people's formats, and the conventions that were measured on them."""

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from vio import open_recording, read_kitti, read_tum, se3
from vio.camera import Camera
from vio.conversion import convert_to_asl
from vio.depth import LinearDepth
from vio.errors import RecordingError
from vio.formats.declared import Declared
from vio.formats.jhu_sinus import read_jhu_poses
from vio.formats.kalibr import read_calibration, write_kalibr
from vio.formats.scared import read_scared_curve
from vio.formats.unity import read_unity_poses

SINUS = "_start_004259_end_004629_stride_25_segment_13"


@pytest.fixture(scope="module")
def endoslam(shared_data):
    return open_recording(shared_data / "endoslam_unitycam_stomach")


def test_endoslam_as_published(shared_data, endoslam):
    assert len(endoslam) == 201 and endoslam.has_images and endoslam.frame(0).shape == (320, 320, 3)
    np.testing.assert_allclose(np.diff(endoslam.frame_t_s), 1 / 30.0003, atol=2e-6)
    assert endoslam.truth is None and endoslam.calibration.camera is None
    assert endoslam.has_depth_images and not endoslam.has_depth
    with pytest.raises(RecordingError, match="no metres"):
        endoslam.depth_m(0)
    poses = read_unity_poses(shared_data / "endoslam_unitycam_stomach" / "stomach_position_rotation.csv")
    assert len(poses.t_ns) == 1543  # the 1544th was cut off
    np.testing.assert_allclose(np.linalg.det(poses.T_world_object[:, :3, :3]), 1, atol=1e-6)
    # A quarter turn about Unity's x tilts the other way once y points down.
    np.testing.assert_allclose(poses.T_world_object[0, :3, :3] @ [0, 0, 1], [0, 1, 0], atol=1e-6)
    # Not the camera's: the view turns, the pose does not (hence no truth).
    assert np.abs(poses.T_world_object[:200, :3, :3] - poses.T_world_object[0, :3, :3]).max() < 1e-6


def test_endoslam_depth_is_inverse(endoslam):
    """In a straight lumen 1/z grows linearly with the distance from its end (z = f R / r)."""
    y, x = np.mgrid[:320, :320]
    seen = np.hypot(x - 159.5, y - 159.5) < 155
    inverse, linear = [], []
    for k in range(120, 201, 10):
        value = endoslam.relative_inverse_depth(k).astype(float)
        smooth = np.where(seen, cv2.GaussianBlur(value, (0, 0), 5), np.inf)
        y_end, x_end = np.unravel_index(np.argmin(smooth), smooth.shape)
        radius = np.hypot(x - x_end, y - y_end)
        used = seen & (value > 0) & (radius > 8)
        ring = (radius[used] // 4).astype(int)
        count = np.bincount(ring)
        mean = np.bincount(ring, value[used])[count > 100] / count[count > 100]
        r = 4.0 * np.flatnonzero(count > 100) + 2
        inverse.append(np.corrcoef(r, mean)[0, 1] ** 2)
        linear.append(np.corrcoef(1 / r, mean)[0, 1] ** 2)
    assert np.median(inverse) > 0.94 and np.median(linear) < 0.6 and min(inverse) > max(linear)


def test_endoslam_becomes_an_asl_folder(shared_data, endoslam, tmp_path: Path):
    source, part = shared_data / "endoslam_unitycam_stomach", tmp_path / "part"
    for k in (0, 1, 7):
        for file in (f"frames/image_{k:04d}.png", f"depth/aov_image_{k:04d}.png"):
            (part / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source / file, part / file)
    shutil.copy(source / "stomach_position_rotation.csv", part)
    convert_to_asl(part, tmp_path / "REC")
    back = open_recording(tmp_path / "REC")
    np.testing.assert_array_equal(back.frame_t_ns, endoslam.frame_t_ns[[0, 1, 7]])
    np.testing.assert_array_equal(back.frame(2), endoslam.frame(7))
    np.testing.assert_array_equal(back.relative_inverse_depth(2), endoslam.relative_inverse_depth(7))
    assert back.frame_paths[2].read_bytes() == (source / "frames" / "image_0007.png").read_bytes()


def test_simcol3d_as_published(shared_data, tmp_path: Path):
    folder = shared_data / "simcol3d_sample"
    recording = open_recording(folder, declared=Declared(rate_hz=30))
    assert len(recording) == 10 and recording.frame(0).shape == (475, 475, 3) and recording.truth is None
    stored = cv2.imread(str(folder / "FrameBuffer_0004.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(recording.frame(4), stored[..., 2::-1] >> 8)  # no bit of the picture is lost
    counts = cv2.imread(str(folder / "Depth_0000.png"), cv2.IMREAD_UNCHANGED)
    assert (counts % 256 == 0).all()
    np.testing.assert_allclose(recording.depth_m(0), counts / 256 / 255 * 0.2, rtol=1e-6)
    ends = [(z[z > 0].min(), z.max()) for z in map(recording.depth_m, range(10))]
    assert 0.006 < min(low for low, _ in ends) < 0.007 and 0.13 < max(high for _, high in ends) < 0.134
    convert_to_asl(folder, tmp_path / "REC", declared=Declared(rate_hz=30))
    back = open_recording(tmp_path / "REC")
    assert isinstance(back.stored_depth, LinearDepth)
    for k in (0, 9):
        np.testing.assert_array_equal(back.depth_m(k), recording.depth_m(k))
        assert back.depth_paths[k].read_bytes() == (folder / f"Depth_{k:04d}.png").read_bytes()


def epipolar_px(recording, T_world_camera, pairs) -> float:
    """Median distance of tracked points from their epipolar lines."""
    K_inverse, off = np.linalg.inv(recording.calibration.camera.K), []
    for i, j, x, y in pairs:
        T_j_i = np.linalg.inv(T_world_camera[j]) @ T_world_camera[i]
        F = K_inverse.T @ se3.skew(T_j_i[:3, 3]) @ T_j_i[:3, :3] @ K_inverse
        lines = np.c_[x, np.ones(len(x))] @ F.T
        off.append(np.abs((np.c_[y, np.ones(len(y))] * lines).sum(axis=1)) / np.hypot(lines[:, 0], lines[:, 1]))
    return float(np.median(np.concatenate(off)))


def test_jhu_poses_are_camera_to_world(shared_data):
    folder = shared_data / "sinus_endoscopy_jhu" / SINUS
    recording = open_recording(folder, declared=Declared(rate_hz=30))
    assert len(recording) == 35 and recording.truth is None  # the mask is no frame, the scale is arbitrary
    assert recording.calibration.camera == Camera("pinhole", 1920, 1080, 677.171, 677.171, 872.127, 471.918)
    mask = cv2.imread(str(folder / "undistorted_mask.bmp"), cv2.IMREAD_GRAYSCALE)
    mask = cv2.erode((mask > 127).astype(np.uint8), np.ones((25, 25)))
    pairs = []
    for i in (0, 13, 26):
        before, after = (cv2.cvtColor(recording.frame(k), cv2.COLOR_RGB2GRAY) for k in (i, i + 8))
        x = cv2.goodFeaturesToTrack(before, 500, 0.01, 12, mask=mask)
        y, found, _ = cv2.calcOpticalFlowPyrLK(before, after, x, None, winSize=(31, 31), maxLevel=4)
        z, again, _ = cv2.calcOpticalFlowPyrLK(after, before, y, None, winSize=(31, 31), maxLevel=4)
        kept = (found * again)[:, 0] * (np.linalg.norm((z - x)[:, 0], axis=1) < 0.7) > 0
        pairs.append((i, i + 8, x[kept, 0], y[kept, 0]))
    poses = read_jhu_poses(folder)
    np.testing.assert_array_equal(poses.numbers, np.arange(4584, 4619))
    as_read = epipolar_px(recording, poses.T_world_camera, pairs)
    the_other_way = epipolar_px(recording, np.linalg.inv(poses.T_world_camera), pairs)
    assert as_read < 1.6 and the_other_way > 4
    scaled = open_recording(folder, declared=Declared(rate_hz=30, unit_m=0.01))
    np.testing.assert_allclose(scaled.truth_at_frames().positions_m, 0.01 * poses.T_world_camera[:, :3, 3], atol=1e-12)


def test_scared_curve_is_a_path_of_millimetres(shared_data):
    T_i_j = read_scared_curve(shared_data / "scared_pose_curves" / "gt_poses_sequence1.npz")
    step = np.linalg.norm(T_i_j[:, :3, 3], axis=1)
    assert len(T_i_j) == 410 and np.median(step) == pytest.approx(0.274e-3, abs=1e-6)
    path = se3.chain(T_i_j)
    assert np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1).sum() == pytest.approx(0.108, abs=1e-3)
    with np.load(shared_data / "scared_pose_curves" / "gt_poses_sequence1.npz") as file:
        stored = file["data"].astype(float)
    np.testing.assert_allclose(T_i_j[7] @ [*(stored[7, :3, 3] * 1e-3), 1], [0, 0, 0, 1], atol=1e-8)


def image_at(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.zeros((24, 32, 3), np.uint8))


def test_tum_truth_of_a_real_sequence(shared_data, tmp_path: Path):
    file = shared_data / "evo_testdata" / "freiburg1_xyz-groundtruth.txt"
    (tmp_path / "fr1").mkdir()
    shutil.copy(file, tmp_path / "fr1" / "groundtruth.txt")
    stamps = ["1305031102.175304", "1305031102.211214", "1305031102.243211"]  # as the benchmark lists them
    (tmp_path / "fr1" / "rgb.txt").write_text("# rgb\n" + "".join(f"{s} rgb/{s}.png\n" for s in stamps))
    for stamp in stamps:
        image_at(tmp_path / "fr1" / "rgb" / f"{stamp}.png")
    recording = open_recording(tmp_path / "fr1")
    assert recording.frame_t_ns.tolist() == [1305031102175304000, 1305031102211214000, 1305031102243211000]
    plain = read_tum(file)
    assert len(recording.truth) == len(plain) == 3000
    np.testing.assert_allclose(recording.truth.T_world_body, plain.T_world_body, atol=1e-12)
    expected = plain.interpolate(np.array([float(s) for s in stamps]))
    np.testing.assert_allclose(recording.truth_at_frames().positions_m, expected.positions_m, atol=1e-6)


def test_kitti_truth_of_a_real_sequence(shared_data, tmp_path: Path):
    sequence = tmp_path / "sequences" / "00"
    for k in range(3):
        image_at(sequence / "image_0" / f"{k:06d}.png")
    P = "20 0 15.5 0 0 21 11.5 0 0 0 1 0"
    (sequence / "calib.txt").write_text("".join(f"P{k}: {P}\n" for k in range(4)) + f"Tr: {P}\n")
    (sequence / "times.txt").write_text("".join(f"{0.1037 * k:.6e}\n" for k in range(4541)))
    (tmp_path / "poses").mkdir()
    shutil.copy(shared_data / "evo_testdata" / "KITTI_00_gt.txt", tmp_path / "poses" / "00.txt")
    recording = open_recording(sequence)
    assert len(recording) == 3 and recording.frame_t_ns[2] == 207_400_000
    plain = read_kitti(tmp_path / "poses" / "00.txt")
    np.testing.assert_allclose(recording.truth.T_world_body, plain.T_world_body, atol=1e-11)
    assert recording.truth.path_length_m == pytest.approx(3724.187, abs=1e-3)


def test_euroc_calibration_goes_to_kalibr_and_comes_back(shared_data, tmp_path: Path):
    mav0 = shared_data / "euroc_v101" / "mav0"
    ours = open_recording(mav0).calibration
    as_asl = read_calibration(mav0 / "cam0" / "sensor.yaml", mav0 / "imu0" / "sensor.yaml")
    assert (as_asl.camera, as_asl.imu_noise) == (ours.camera, ours.imu_noise)
    write_kalibr(ours, tmp_path / "kalibr")
    back = read_calibration(tmp_path / "kalibr" / "camchain.yaml", tmp_path / "kalibr" / "imu.yaml")
    assert back.camera == ours.camera and back.imu_noise == ours.imu_noise
    np.testing.assert_allclose(back.T_body_camera, ours.T_body_camera, atol=1e-15)


def test_published_capsule_cameras_as_kalibr_files(shared_data, tmp_path: Path):
    text = (shared_data / "endoslam_calib" / "SOURCE.txt").read_text()
    numbers = re.search(r"MiroCam fx (\S+) fy (\S+) cx (\S+) cy (\S+) k1 (\S+) k2 ([-\d.]+\d)", text).groups()
    fx, fy, cx, cy, k1, k2 = map(float, numbers)
    (tmp_path / "c.yaml").write_text(
        f"cam0:\n  camera_model: pinhole\n  intrinsics: [{fx}, {fy}, {cx}, {cy}]\n  distortion_model: radtan\n"
        f"  distortion_coeffs: [{k1}, {k2}, 0.0, 0.0]\n  resolution: [320, 320]\n")
    camera = read_calibration(tmp_path / "c.yaml").camera
    assert camera == Camera("pinhole", 320, 320, 159.5906, 159.2241, 161.9297, 163.1686, (0.1994, -0.1279, 0, 0))
    rays = np.array([[0.3, -0.2, 1.0], [-0.5, 0.4, 1.0]])
    oracle = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.K, np.array([k1, k2, 0, 0]))[0][:, 0]
    np.testing.assert_allclose(camera.project(rays)[0], oracle, atol=1e-9)
