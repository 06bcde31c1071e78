"""Damaged and hostile data of every format: one line that says what, where and what to do; never another error."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.vio.samples import SAMPLES
from vio import open_recording
from vio.conversion import convert_to_asl
from vio.errors import FormatError, OutputError, RecordingError, VioError
from vio.formats import READERS
from vio.formats.declared import Declared
from vio.image_files import image_size

Damage = Callable[[Path], object]


def line(number: int, change: Callable[[str], str]) -> Damage:
    def damage(path: Path) -> None:
        lines = path.read_text().splitlines()
        lines[number - 1] = change(lines[number - 1])
        path.write_text("\n".join(lines) + "\n")
    return damage


def text(content: str | bytes) -> Damage:
    return lambda path: path.write_bytes(content if isinstance(content, bytes) else content.encode())


def replace(old: str, new: str) -> Damage:
    return lambda path: path.write_text(path.read_text().replace(old, new))


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def last_rows_off(path: Path) -> None:
    path.write_text("\n".join(path.read_text().splitlines()[:3]) + "\n")


def other_size(path: Path) -> None:
    cv2.imwrite(str(path), np.zeros((24, 30, 3), np.uint8))


def bomb(path: Path) -> None:
    """A whole PNG whose header asks for 60,000 x 60,000 pixels."""
    content = bytearray(path.read_bytes())
    content[16:24] = (60_000).to_bytes(4, "big") * 2
    path.write_bytes(bytes(content))


def no_frames(path: Path) -> None:
    shutil.rmtree(path)
    path.mkdir()


POSES = "Poses/stomach_position_rotation.csv"
LATIN = "t_s,filename\n0,gr\u00f6\u00dfe.png\n".encode("latin-1")

FAULTS: list[tuple[str, str, Damage, str]] = [
    # --- one's own images
    ("images", "frames.csv", text(LATIN), r"frames\.csv: not a text file in UTF-8; save it again"),
    ("images", "frames.csv", text("t_s filename\n0 a.png\n"), r"csv line 1: the title line 't_s filename' has no"),
    ("images", "frames.csv", text("t_s,file\n0,a.png\n"), r"frames\.csv: no column 'filename'; found 't_s', 'file'"),
    ("images", "frames.csv", text("time,filename\n0,a.png\n"), r"frames\.csv: no column of time; name one of t_ns"),
    ("images", "frames.csv", text("t_s,t_ms,filename\n0,0,shots/0.png\n"), r"frames\.csv: more than one column"),
    ("images", "frames.csv", text("t_s,filename,t_s\n0,a,1\n"), r"frames\.csv line 1: column 't_s' occurs twice"),
    ("images", "frames.csv", text(""), r"frames\.csv: empty"),
    ("images", "frames.csv", text("t_s,filename\n"), r"frames\.csv: no rows below the title"),
    ("images", "frames.csv", line(3, lambda _: "x;shots/1.png"), r"frames\.csv line 3: time 'x' is no number"),
    ("images", "frames.csv", line(3, lambda _: "0,25;shots/1.png"), r"line 3: time '0,25' .* decimals with a point"),
    ("images", "frames.csv", line(3, lambda _: "nan;shots/1.png"), r"frames\.csv line 3: time 'nan'"),
    ("images", "frames.csv", line(3, lambda _: "1e30;shots/1.png"), r"frames\.csv line 3: time '1e30'"),
    ("images", "frames.csv", line(3, lambda _: "0;shots/1.png"), r"frames\.csv line 3: stamp 0 repeats 0 in line 2"),
    ("images", "frames.csv", line(3, lambda _: "250"), r"frames\.csv line 3: 1 columns, expected at least 2"),
    ("images", "frames.csv", line(3, lambda _: "250;../x.png"), r"line 3: '\.\./x\.png' is not a file name below"),
    ("images", "frames.csv", line(3, lambda _: "250;/etc/passwd"), r"frames\.csv line 3: '/etc/passwd' is not"),
    ("images", "frames.csv", line(3, lambda _: "250;a\\b.png"), r"frames\.csv line 3: .* is not a file name"),
    ("images", "frames.csv", line(3, lambda _: "250;shots/x.png"), r"frames\.csv line 3: there is no file 'x\.png'"),
    ("images", "frames.csv", line(3, lambda _: "250;link/secret.png"), r"line 3: 'link/secret\.png' leads out of"),
    ("images", "imu.csv", replace("gyro_x_deg_s", "gyro_x"), r"imu\.csv: columns gyro_x_rad_s or gyro_x_deg_s"),
    ("images", "imu.csv", replace("accel_y_g", "accel_y"), r"imu\.csv: no column 'accel_y_g'; found"),
    ("images", "imu.csv", line(5, lambda row: row.replace(",", ",x", 1)), r"imu\.csv line 5: 'x.*' in column 2 is not"),
    ("images", "camchain.yaml", Path.unlink, r"imu\.csv is there, but nothing says where the camera sits"),
    ("images", "imu.yaml", Path.unlink, r"imu\.csv is there, but nothing says how noisy"),
    ("images", "camchain.yaml", replace("T_cam_imu", "T_old"), r"camchain\.yaml: cam0 has no T_cam_imu"),
    # --- one's own film
    ("video", "frames.csv", Path.unlink, r"film\.avi: a film's presentation times are not"),
    ("video", "frames.csv", last_rows_off, r"film\.avi: 6 frames decode, but frames\.csv lists 2 times; frames 0 to 1"),
    ("video", "film.avi", text(b"none"), r"film\.avi: not a film"),
    # --- data sets
    ("endoslam", POSES, text("a,b\n1,2\n"), r"rotation\.csv: the title line is 'a,b', exp"),
    ("endoslam", POSES, line(3, lambda row: row.replace(".", ",")), r"csv line 3: \d+ fields for 8 columns: .*commas"),
    ("endoslam", POSES, line(3, lambda row: row.rpartition(",")[0]), r"csv line 3: 7 columns, expected at least 8"),
    ("endoslam", POSES, last_rows_off, r"frame 2 has no row in stomach_position_rotation\.csv \(2 rows\)"),
    ("endoslam", "Poses/b_position_rotation.csv", text("x"), r"2 pose files .* keep the one"),
    ("endoslam", POSES, Path.unlink, r"format endoslam: nothing in these files says when a frame was taken"),
    ("endoslam", "Frames", no_frames, r"no Frames/image_0000\.png"),
    ("endoslam", "Frames/image_00001.png", text("x"), r"image_00001\.png and image_0001\.png are both number 1"),
    ("vrcaps", "position_rotation.csv", last_rows_off, r"frame 2 has no row in position_rotation\.csv"),
    ("c3vd", "pose.txt", line(2, lambda row: row.replace("1", "2")), r"pose\.txt line 2: neither the last row nor"),
    ("c3vd", "pose.txt", line(2, lambda row: "0.0," + row), r"pose\.txt line 2: neither the last row nor"),
    ("c3vd", "pose.txt", text("0.5,0,0,0,0,1,0,0,0,0,1,0,1,2,3,1\n" * 6), r"pose\.txt line 1: not a rigid transform"),
    ("c3vd", "pose.txt", text("1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1\n" * 6), r"pose\.txt: .*order cannot be told"),
    ("c3vd", "pose.txt", last_rows_off, r"frame 5 has no row in pose\.txt \(3 rows for 6 frames\)"),
    ("c3vd", "pose.txt", text(""), r"pose\.txt: no rows"),
    ("simcol3d", "../SavedPosition_S1.txt", last_rows_off, r"SavedPosition_S1\.txt has 3 rows, .* 6; restore"),
    ("simcol3d", "../SavedPosition_S1.txt", Path.unlink, r"SavedPosition_S1\.txt: no such file"),
    ("simcol3d", "../SavedRotationQuaternion_S1.txt", line(2, lambda _: "1 1 0 0"), r"line 2: quaternion of length"),
    ("simcol3d", "../cam.txt", text("20 0 15"), r"cam\.txt: 3 numbers, expected 9"),
    ("simcol3d", "../cam.txt", text("20 0 1500 0 20 10 0 0 1"), r"cam\.txt: camera: cx is 1500"),
    ("scared", "data/frame_data/frame_data000002.json", Path.unlink, r"frame_data000002\.json: no such file"),
    ("scared", "data/frame_data/frame_data000002.json", text("{"), r"frame_data000002\.json: not valid JSON"),
    ("scared", "data/frame_data/frame_data000002.json", text("[]"), r"expected keys and values, found list"),
    ("scared", "data/frame_data/frame_data000002.json", replace("camera-pose", "pose"), r"'camera-pose' is missing"),
    ("scared", "data/frame_data/frame_data000002.json", replace("15.5", "15.6"), r"000002\.json: KL or DL differs"),
    ("scared", "data/frame_data/frame_data000002.json", replace("[0.0, 0.0, 0.0, 1.0]", "[0, 0, 0, 2]"),
     r"frame_data000002\.json: not a rigid transform"),
    ("scared", "data/left", no_frames, r"no data/left/frame_data000000\.png; unpack"),
    ("tum-rgbd", "rgb.txt", line(3, lambda row: row.split()[0]), r"rgb\.txt line 3: expected `timestamp filename`"),
    ("tum-rgbd", "rgb.txt", line(3, lambda row: row.replace("rgb/", "../")), r"txt line 3: '\.\./1\.png' is not a"),
    ("tum-rgbd", "rgb.txt", line(3, lambda row: "x " + row), r"rgb\.txt line 3: time 'x' is no number"),
    ("tum-rgbd", "rgb.txt", text("# none\n"), r"rgb\.txt lists no frames"),
    ("tum-rgbd", "groundtruth.txt", line(4, lambda row: row.rpartition(" ")[0] + " 5"),
     r"groundtruth\.txt line 4: quaternion of length"),
    ("tum-rgbd", "groundtruth.txt", text(""), r"groundtruth\.txt: no rows"),
    ("jhu-sinus", "visible_view_indexes", line(2, lambda _: "4584"), r"visible_view_indexes line 2: view numbers must"),
    ("jhu-sinus", "visible_view_indexes", last_rows_off, r"motion\.yaml: 6 poses for 3 views"),
    ("jhu-sinus", "motion.yaml", replace("orientation", "o"), r"motion\.yaml poses\[0\]: expected position"),
    ("jhu-sinus", "motion.yaml", replace("w: ", "w: 2"), r"motion\.yaml poses\[0\]: quaternion of length"),
    ("jhu-sinus", "motion.yaml", text("poses[]: {"), r"motion\.yaml: not valid YAML"),
    ("jhu-sinus", "camera_intrinsics_per_view", text("1\n2\n"), r"per_view: 2 rows, expected fx, fy, cx, cy"),
    ("kitti", "times.txt", last_rows_off, r"times\.txt: 3 times, but there is a frame 5"),
    ("kitti", "calib.txt", replace("P2:", "P9:"), r"calib\.txt: no line P2: with 12 numbers"),
    ("kitti", "../../poses/00.txt", last_rows_off, r"poses/00\.txt: 3 poses for 6 times"),
    # --- pictures, seen when they are converted
    ("images", "shots/3.png", cut, r"^frame 3: shots/3\.png is cut off; copy the file again"),
    ("images", "shots/3.png", text(b""), r"^frame 3: shots/3\.png is not an image"),
    ("images", "shots/3.png", other_size, r"^frame 3 \(3\.png\) has 30 x 24 pixels but the camera 32 x 24"),
    ("images", "shots/3.png", bomb, r"^frame 3: shots/3\.png has 60000 x 60000 pixels \(limit"),
    ("endoslam", "Frames/image_0004.png", other_size, r"^frame 4: 30 x 24 pixels after frames of 32 x 24"),
    ("jhu-sinus", "00004588.jpg", cut, r"^frame 3: .*00004588\.jpg is cut off"),
    ("c3vd", "0002_depth.tiff", cut, r"^depth of frame 2: .*0002_depth\.tiff is not an image"),
    ("c3vd", "0002_depth.tiff", other_size, r"^depth of frame 2.* is uint8"),
    ("scared", "data/scene_points/scene_points000001.tiff", cut, r"^depth of frame 1: .*000001\.tiff is not an image"),
]


@pytest.mark.parametrize(("name", "file", "damage", "words"), FAULTS)
def test_damaged_data_say_what_and_where(tmp_path: Path, capfd, name, file, damage, words):
    made = SAMPLES[name](tmp_path / "data")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "secret.png").write_bytes(b"")
    (made.root / "link").symlink_to(tmp_path / "elsewhere")
    damage(made.root / file)
    with pytest.raises(VioError, match=words) as caught:
        convert_to_asl(made.root, tmp_path / "REC", name, made.declared)
    message = str(caught.value)
    assert "\n" not in message and str(tmp_path) not in message and caught.value.exit_code == 3
    assert not (tmp_path / "REC").exists() and capfd.readouterr().err == ""


def test_every_reader_is_walked():
    walked = {name for name, *_ in FAULTS}
    assert walked >= set(READERS) - {"asl"}


def test_frames_of_a_real_endoslam_camera_are_refused(tmp_path: Path):
    (tmp_path / "Frames").mkdir()
    (tmp_path / "Frames" / "frameId_0005355_time_00565149.png").write_bytes(b"")
    with pytest.raises(RecordingError, match=r"frames of a real camera; .* list the times you know in frames\.csv"):
        open_recording(tmp_path)


@pytest.mark.parametrize("name", ["simcol3d", "scared", "jhu-sinus"])
def test_data_without_a_clock_need_a_rate(tmp_path: Path, name):
    with pytest.raises(RecordingError, match=f"^format {name}: nothing in these files says when .*--rate-hz"):
        open_recording(SAMPLES[name](tmp_path).root)


@pytest.mark.parametrize(("name", "declared", "words"), [
    ("tum-rgbd", {"rate_hz": 30}, "format tum-rgbd does not take --rate-hz"),
    ("images", {"presentation_times": True}, "format images does not take --presentation-times"),
    ("c3vd", {"unit_m": 0.1}, "format c3vd does not take --unit-m"),
])
def test_what_a_format_cannot_use_is_not_ignored(tmp_path: Path, name, declared, words):
    with pytest.raises(RecordingError, match=words):
        open_recording(SAMPLES[name](tmp_path).root, declared=Declared(**declared))


@pytest.mark.parametrize(("declared", "words"), [
    ({"rate_hz": 0}, "--rate-hz is 0"), ({"rate_hz": np.nan}, "--rate-hz is nan"), ({"rate_hz": 1e9}, "0.001 to 10000"),
    ({"unit_m": -1}, "--unit-m is -1"), ({"depth_planes": (0.01, 2)}, "add --unit-m"),
    ({"depth_planes": (2, 1), "unit_m": 1}, "--depth-planes: near 2, far 1"),
])
def test_impossible_declarations(declared, words):
    with pytest.raises(RecordingError, match=words):
        Declared(**declared)


@pytest.mark.parametrize("out", ["data", "data/Erika_Mustermann_1964", "data/Erika_Mustermann_1964/REC", "."])
def test_the_output_never_mixes_with_the_source(tmp_path: Path, out):
    root = SAMPLES["images"](tmp_path / "data").root
    with pytest.raises(OutputError, match="the output would mix with the source"):
        convert_to_asl(root, tmp_path / out)
    assert (root / "frames.csv").is_file()


def test_a_folder_of_somebody_else_is_not_replaced(tmp_path: Path):
    root = SAMPLES["images"](tmp_path / "data").root
    (tmp_path / "REC").mkdir()
    (tmp_path / "REC" / "thesis.tex").write_text("x")
    with pytest.raises(OutputError, match=r"REC exists and was not written by capsule-vio"):
        convert_to_asl(root, tmp_path / "REC")
    assert (tmp_path / "REC" / "thesis.tex").read_text() == "x"


# --- whatever the bytes, only our own errors -------------------------------------------------------------------------

TEXT_FILES = [
    ("images", "frames.csv"), ("images", "imu.csv"), ("images", "camchain.yaml"), ("images", "imu.yaml"),
    ("endoslam", POSES), ("c3vd", "pose.txt"), ("simcol3d", "../SavedPosition_S1.txt"),
    ("simcol3d", "../SavedRotationQuaternion_S1.txt"), ("simcol3d", "../cam.txt"),
    ("scared", "data/frame_data/frame_data000001.json"), ("tum-rgbd", "rgb.txt"), ("tum-rgbd", "depth.txt"),
    ("tum-rgbd", "groundtruth.txt"), ("jhu-sinus", "motion.yaml"), ("jhu-sinus", "visible_view_indexes"),
    ("jhu-sinus", "camera_intrinsics_per_view"), ("kitti", "times.txt"), ("kitti", "calib.txt"),
    ("kitti", "../../poses/00.txt"),
]


JUNK = [b"nan", b"inf", b"1e999", b"1e300", b"1e99999999", b"-", b"9" * 30, b"null", b"[]", b"\n", b","]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    made = {name: SAMPLES[name](folder / name) for name in {name for name, _ in TEXT_FILES}}
    return lambda name: made[name]  # hypothesis prints arguments, and these hold images


@pytest.mark.parametrize(("name", "file"), TEXT_FILES)
@settings(max_examples=12)
@given(at=st.floats(0, 1), length=st.sampled_from([0, 1, 2, 20, 10_000]),
       junk=st.one_of(st.binary(max_size=6), st.sampled_from(JUNK)))
def test_damaged_text_raises_nothing_but_our_errors(whole, name, file, at, length, junk):
    made = whole(name)
    path = made.root / file
    before = path.read_bytes()
    start = int(at * len(before))
    path.write_bytes(before[:start] + junk + before[start + length:])
    try:
        open_recording(made.root, name, made.declared)
    except VioError as error:
        assert "\n" not in str(error)
    finally:
        path.write_bytes(before)


@given(st.binary(max_size=60), st.sampled_from([b"", b"\x89PNG\r\n\x1a\n", b"BM", b"\xff\xd8\xff\xe0\0\x04ab"]))
@example(b"\xff" * 50, b"\xff\xd8")
def test_sizes_of_broken_headers_are_found_or_not(tail, start):
    size = image_size(start + tail)
    assert size is None or min(size) >= 0


@pytest.mark.parametrize("ending", [".png", ".jpg", ".bmp"])
def test_sizes_of_whole_headers(tmp_path: Path, ending):
    cv2.imwrite(str(tmp_path / f"x{ending}"), np.zeros((37, 53, 3), np.uint8))
    assert image_size((tmp_path / f"x{ending}").read_bytes()) == (53, 37)


def test_json_of_any_depth_is_refused(tmp_path: Path):
    made = SAMPLES["scared"](tmp_path)
    file = made.root / "data" / "frame_data" / "frame_data000000.json"
    file.write_text("[" * 100_000)
    with pytest.raises(FormatError, match=r"not valid JSON"):
        open_recording(made.root, declared=made.declared)
    note = {"camera-pose": "1", "camera-calibration": 3}
    file.write_text(json.dumps(note))
    with pytest.raises(FormatError, match=r"'camera-calibration' is missing"):
        open_recording(made.root, declared=made.declared)
