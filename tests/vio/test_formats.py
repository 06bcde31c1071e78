"""Reading and writing files: real ones against evo, our own there and back, and the dialects that exist."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface
from hypothesis import given
from hypothesis import strategies as st

from vio import open_recording, se3
from vio.errors import FormatError, OutputError, RecordingError
from vio.formats.asl import matches, read_asl, read_asl_imu, read_asl_truth, write_asl
from vio.formats.kitti import read_kitti, write_kitti
from vio.formats.tum import read_tum, write_tum
from vio.imu import ImuSamples
from vio.trajectory import Trajectory

STAMPS = st.lists(st.integers(-(2**62), 2**62), min_size=1, max_size=20, unique=True).map(sorted)


@st.composite
def trajectories(draw):
    t = np.cumsum(draw(st.lists(st.floats(1e-3, 1e3), min_size=1, max_size=15)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    size = 10.0 ** draw(st.integers(-5, 4))
    return Trajectory(t, se3.transform(se3.so3_exp(rng.normal(0, 2, (len(t), 3))), size * rng.normal(size=(len(t), 3))))


# --- ASL -----------------------------------------------------------------------------------------------------------


def test_a_recording_survives_its_folder(recording, tmp_path: Path):
    write_asl(recording, tmp_path / "seven")
    back = open_recording(tmp_path / "seven")
    assert back.name == "seven" and back.provenance == recording.provenance
    np.testing.assert_array_equal(back.frame_t_ns, recording.frame_t_ns)
    for name in ("t_ns", "gyro_rad_s", "accel_m_s2"):
        np.testing.assert_array_equal(getattr(back.imu, name), getattr(recording.imu, name))
    assert back.calibration.camera == recording.calibration.camera
    assert back.calibration.imu_noise == recording.calibration.imu_noise
    assert back.calibration.time_offset_s == recording.calibration.time_offset_s
    np.testing.assert_allclose(back.calibration.T_body_camera, recording.calibration.T_body_camera, atol=1e-15)
    np.testing.assert_allclose(back.truth.t_s, recording.truth.t_s, atol=1e-9)
    np.testing.assert_allclose(back.truth.T_world_body, recording.truth.T_world_body, atol=1e-14)
    for name in ("velocity_m_s", "gyro_bias_rad_s", "accel_bias_m_s2"):
        np.testing.assert_array_equal(getattr(back.truth_state, name), getattr(recording.truth_state, name))
    assert back.has_images and back.depth_unit_m == recording.depth_unit_m
    for k in range(7):
        np.testing.assert_array_equal(back.frame(k), recording.frame(k))
        ours, theirs = back.depth_m(k), recording.depth_m(k)
        assert (ours is None and theirs is None) if k == 2 else (ours == theirs).all()


def test_a_recording_without_images_truth_or_camera(recording, tmp_path: Path):
    bare = replace(recording, frame_paths=(), depth_paths=(), truth=None, truth_state=None,
                   calibration=replace(recording.calibration, camera=None), provenance={})
    write_asl(bare, tmp_path / "bare")
    back = read_asl(tmp_path / "bare")
    assert not back.has_images and back.truth is None and back.calibration.camera is None
    np.testing.assert_array_equal(back.frame_t_ns, recording.frame_t_ns)
    assert back.frame_paths[0].name == f"{recording.frame_t_ns[0]}.png"
    poses_only = replace(recording, truth_state=None)
    write_asl(poses_only, tmp_path / "poses")
    back = read_asl(tmp_path / "poses")
    assert back.truth_state is None and len(back.truth) == len(recording.truth)


def test_the_same_recording_gives_the_same_bytes_and_replaces_only_itself(recording, tmp_path: Path):
    for name in ("a", "b"):
        write_asl(recording, tmp_path / name)
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*") if path.is_file())
    assert len(files) == 7 + 6 + 4 + 4
    assert all((tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes() for file in files)
    write_asl(replace(recording, name="again"), tmp_path / "a")
    (tmp_path / "b" / "recording.yaml").unlink()
    with pytest.raises(OutputError, match="was not written by"):
        write_asl(recording, tmp_path / "b")
    with pytest.raises(RecordingError, match="provenance must be plain"):
        write_asl(replace(recording, provenance={"seed": np.int64(3)}), tmp_path / "c")
    assert not (tmp_path / "c").exists()


@given(STAMPS)
def test_stamps_never_pass_through_floating_point(tmp_path_factory, stamps):
    folder = tmp_path_factory.mktemp("imu0")
    rows = "".join(f"{stamp},1,2,3,4,5,6\n" for stamp in stamps)
    (folder / "data.csv").write_text("#header\n" + rows)
    assert read_asl_imu(folder / "data.csv").t_ns.tolist() == stamps
    shutil.rmtree(folder)


def test_euroc_as_published(shared_data):
    folder = shared_data / "euroc_v101"
    euroc = open_recording(folder)
    assert (len(euroc), len(euroc.imu), len(euroc.truth)) == (24, 29_120, 2_895)
    assert euroc.frame_t_ns[0] == 1403715273262142976 and euroc.imu.t_ns[1] == 1403715273267142912
    np.testing.assert_array_equal(euroc.imu.gyro_rad_s[0], [-0.0020943951023931952, 0.017453292519943295,
                                                           0.07749261878854824])
    np.testing.assert_array_equal(euroc.imu.accel_m_s2[0], [9.0874956666666655, 0.13075533333333333,
                                                           -3.6938381666666662])
    assert euroc.truth.t_s[0] == 0 and euroc.name == "euroc_v101" == open_recording(folder / "mav0").name
    # At rest the accelerometer shows up, so the truth's rotations must turn it to world z.
    up = euroc.truth.rotations[0] @ euroc.imu.accel_m_s2[:200].mean(axis=0)
    np.testing.assert_allclose(up / np.linalg.norm(up), [0, 0, 1], atol=0.02)


@pytest.mark.parametrize("file", ["euroc_v101/mav0/state_groundtruth_estimate0/data.csv",
                                  "evo_testdata/V102_groundtruth.csv"])
def test_asl_truth_agrees_with_evo_and_with_itself(shared_data, file):
    truth = read_asl_truth(shared_data / file)
    evo = file_interface.read_euroc_csv_trajectory(str(shared_data / file))
    np.testing.assert_allclose(truth.t_first_ns * 1e-9 + truth.trajectory.t_s, evo.timestamps, atol=1e-6)
    np.testing.assert_array_equal(truth.trajectory.positions_m, evo.positions_xyz)
    np.testing.assert_allclose(truth.trajectory.T_world_body, evo.poses_se3, atol=1e-5)
    velocity = np.diff(truth.trajectory.positions_m, axis=0) / np.diff(truth.trajectory.t_s)[:, None]
    stated = 0.5 * (truth.state.velocity_m_s[1:] + truth.state.velocity_m_s[:-1])
    assert np.abs(velocity - stated).max() < 0.2 and np.median(np.abs(velocity - stated)) < 0.01


def test_dialects_of_the_layout(recording, tmp_path: Path):
    write_asl(recording, tmp_path / "a")
    plain, cam0 = read_asl(tmp_path / "a"), tmp_path / "a" / "mav0" / "cam0"
    for part in ("cam0", "imu0", "state_groundtruth_estimate0"):
        file = tmp_path / "a" / "mav0" / part / "data.csv"
        header, *rows = file.read_text().splitlines()
        lines = [header.replace(",", ", "), "", *(row.replace(",", " , ", 1) + "," for row in rows), "# end", ""]
        file.write_bytes("\r\n".join(lines).encode("utf-8-sig"))
    listing = cam0 / "data.csv"
    listing.write_text(listing.read_text(encoding="utf-8") + f"{recording.frame_t_ns[-1] + 5},later.png\n")
    (cam0 / "sensor.yaml").write_text("%YAML:1.0\n" + (cam0 / "sensor.yaml").read_text())
    back = read_asl(tmp_path / "a")
    np.testing.assert_array_equal(back.frame_t_ns[:7], plain.frame_t_ns)
    np.testing.assert_array_equal(back.imu.accel_m_s2, plain.imu.accel_m_s2)
    np.testing.assert_array_equal(back.truth.T_world_body, plain.truth.T_world_body)
    assert len(back) == 8 and not back.has_images and (back.frame(6) == plain.frame(6)).all()
    with pytest.raises(RecordingError, match=r"frame 7: data/later\.png cannot be read"):
        back.frame(7)


def test_the_level_mav0_may_be_left_out(recording, tmp_path: Path):
    write_asl(recording, tmp_path / "a")
    shutil.move(tmp_path / "a" / "mav0", tmp_path / "b")
    shutil.copy(tmp_path / "a" / "recording.yaml", tmp_path / "b")
    flat = open_recording(tmp_path / "b")
    assert flat.name == "b" and flat.provenance == recording.provenance and flat.frame(0).shape == (24, 32, 3)


def test_depth_belongs_to_frames_by_its_stamp(recording, tmp_path: Path):
    write_asl(recording, tmp_path / "a")
    listing = tmp_path / "a" / "mav0" / "depth0" / "data.csv"
    lines = listing.read_text().splitlines()
    listing.write_text("\n".join([lines[0], *lines[3:]]) + "\n")
    back = read_asl(tmp_path / "a")
    assert [back.depth_m(k) is not None for k in range(7)] == [False, False, False, True, True, True, True]
    np.testing.assert_allclose(back.depth_m(5), 0.05)
    listing.write_text(f"{recording.frame_t_ns[0] + 1},x.png\n")
    with pytest.raises(FormatError, match=r"depth0/data\.csv: stamp \d+ is no frame of cam0"):
        read_asl(tmp_path / "a")


# --- opening -------------------------------------------------------------------------------------------------------


def test_opening_says_what_was_looked_for(recording, tmp_path: Path):
    write_asl(recording, tmp_path / "a")
    assert matches(tmp_path / "a") and open_recording(tmp_path / "a", "asl").name == "a"
    (tmp_path / "empty").mkdir()
    assert not matches(tmp_path / "empty")
    with pytest.raises(RecordingError, match=r"^empty: not a recording .* asl = .*mav0/cam0/data\.csv"):
        open_recording(tmp_path / "empty")
    with pytest.raises(RecordingError, match=r"^nowhere: no such folder"):
        open_recording(tmp_path / "nowhere")
    with pytest.raises(RecordingError, match="a file, not a folder"):
        open_recording(tmp_path / "a" / "recording.yaml")
    with pytest.raises(RecordingError, match="format 'rosbag' is unknown; known are asl"):
        open_recording(tmp_path / "a", "rosbag")


# --- TUM and KITTI -------------------------------------------------------------------------------------------------


@given(trajectories())
def test_tum_there_and_back(tmp_path_factory, trajectory):
    file = tmp_path_factory.mktemp("tum") / "a.tum"
    write_tum(trajectory, file)
    back = read_tum(file)
    np.testing.assert_allclose(back.t_s, trajectory.t_s, atol=0.6e-9)
    np.testing.assert_array_equal(back.positions_m, trajectory.positions_m)
    np.testing.assert_allclose(back.rotations, trajectory.rotations, atol=1e-14)
    evo = file_interface.read_tum_trajectory_file(str(file))
    assert evo.check()[0]
    np.testing.assert_allclose(evo.poses_se3, trajectory.T_world_body, rtol=1e-13, atol=1e-13)


@given(trajectories())
def test_kitti_there_and_back(tmp_path_factory, trajectory):
    folder = tmp_path_factory.mktemp("kitti")
    write_kitti(trajectory, folder / "poses.txt", folder / "times.txt")
    back = read_kitti(folder / "poses.txt", folder / "times.txt")
    np.testing.assert_allclose(back.t_s, trajectory.t_s, atol=0.6e-9)
    np.testing.assert_array_equal(back.positions_m, trajectory.positions_m)
    np.testing.assert_allclose(back.rotations, trajectory.rotations, atol=1e-14)
    evo = file_interface.read_kitti_poses_file(str(folder / "poses.txt"))
    np.testing.assert_array_equal(np.array(evo.poses_se3), trajectory.T_world_body)


@pytest.mark.parametrize("name", ["freiburg1_xyz-groundtruth.txt", "freiburg1_xyz-rgbdslam_drift.txt", "V102.txt"])
def test_real_tum_files_agree_with_evo(shared_data, name):
    file = shared_data / "evo_testdata" / name
    evo = file_interface.read_tum_trajectory_file(str(file))
    ours = read_tum(file, repair=True)
    _, first = np.unique(evo.timestamps, return_index=True)
    np.testing.assert_array_equal(ours.t_s, evo.timestamps[first])
    np.testing.assert_array_equal(ours.positions_m, evo.positions_xyz[first])
    # fr1 quaternions are unit to 8e-5 only; evo uses them as they are.
    np.testing.assert_allclose(ours.T_world_body, np.array(evo.poses_se3)[first], atol=3e-4)


def test_repeated_stamps_are_refused_unless_repaired(shared_data):
    file = shared_data / "evo_testdata" / "V102.txt"
    with pytest.raises(FormatError, match=r"V102\.txt line 433: stamp .* \(4 such rows\); read with repair=True"):
        read_tum(file)
    assert len(read_tum(file, repair=True)) == 807 - 4


@pytest.mark.parametrize(("name", "length_m"), [("KITTI_00_gt.txt", 3724.187), ("KITTI_00_ORB.txt", 3705.098)])
def test_real_kitti_files_agree_with_evo(shared_data, name, length_m):
    file = shared_data / "evo_testdata" / name
    ours, evo = read_kitti(file), file_interface.read_kitti_poses_file(str(file))
    np.testing.assert_array_equal(ours.t_s, np.arange(4541))
    np.testing.assert_allclose(ours.T_world_body, evo.poses_se3, atol=1e-5)
    assert ours.path_length_m == pytest.approx(length_m, abs=1e-3) == pytest.approx(evo.path_length, abs=1e-3)


def test_imu_units_in_the_header(tmp_path: Path):
    from vio.errors import ImuError

    file = tmp_path / "data.csv"
    for header, words in (("#t [ns],w_x [deg/s]", "'deg'.*rad/s"), ("#t [ns],w_x [rad/s],a_x [g]", "m/s²")):
        file.write_text(f"{header}\n1,0,0,0,0,0,9.81\n")
        with pytest.raises(ImuError, match=words):
            read_asl_imu(file)
    file.write_text("timestamp,wx,wy,wz,ax,ay,az\n1,0,0,0,0,0,9.81\n")
    assert isinstance(read_asl_imu(file), ImuSamples)
