"""Damaged input: every fault gives one line that names the place, and no input whatever gives a traceback."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from vio import se3
from vio.errors import CalibrationError, FormatError, ImuError, MotionsError, RecordingError, VioError
from vio.formats.asl import read_asl, read_asl_imu, read_asl_truth, write_asl
from vio.formats.kitti import read_kitti
from vio.formats.tum import read_tum
from vio.motions import RelativeMotions, load_motions

TRUTH = "state_groundtruth_estimate0"


def edit(line: int, change: Callable[[str], str]) -> Callable[[Path], None]:
    """Change one line of a file, counted from 1."""

    def apply(file: Path) -> None:
        lines = file.read_text().splitlines()
        lines[line - 1] = change(lines[line - 1])
        file.write_text("\n".join(lines) + "\n")

    return apply


def swap(line: int) -> Callable[[Path], None]:
    def apply(file: Path) -> None:
        lines = file.read_text().splitlines()
        lines[line - 1], lines[line] = lines[line], lines[line - 1]
        file.write_text("\n".join(lines) + "\n")

    return apply


def field(column: int, value: str) -> Callable[[str], str]:
    return lambda line: ",".join([*line.split(",")[:column], value, *line.split(",")[column + 1:]])


def without(key: str) -> Callable[[Path], None]:
    return lambda file: file.write_text(re.sub(rf"^{key}:", f"no_{key}:", file.read_text(), flags=re.M)) and None


def only_header(file: Path) -> None:
    file.write_text(file.read_text().splitlines()[0] + "\n")


FAULTS = [
    ("imu0/data.csv", edit(9, field(3, "nan")), ImuError, r"imu0/data\.csv line 9: .*not finite"),
    ("imu0/data.csv", edit(9, field(6, "")), ImuError, r"imu0/data\.csv line 9: '' in column 7 is not a number"),
    ("imu0/data.csv", edit(9, lambda line: line[:30]), ImuError, r"line 9: . columns, expected at least 7"),
    ("imu0/data.csv", edit(9, field(0, "1403.5")), ImuError, r"imu0/data\.csv line 9: stamp '1403\.5'.*nanoseconds"),
    ("imu0/data.csv", edit(9, field(0, "9" * 30)), ImuError, r"imu0/data\.csv line 9: stamp"),
    ("imu0/data.csv", edit(9, lambda line: line + "\n" + line), ImuError, r"line 10: stamp \d+ repeats \d+ in line 9"),
    ("imu0/data.csv", swap(9), ImuError, r"imu0/data\.csv line 10: stamp \d+ is earlier than \d+ in line 9"),
    ("imu0/data.csv", Path.unlink, RecordingError, r"no imu0/data\.csv"),
    ("imu0/sensor.yaml", Path.unlink, CalibrationError, r"imu0/sensor\.yaml: no such file"),
    ("imu0/sensor.yaml", without("rate_hz"), CalibrationError, r"imu0/sensor\.yaml: missing key 'rate_hz'"),
    ("cam0/data.csv", Path.unlink, RecordingError, r"no cam0/data\.csv; frame times"),
    ("cam0/data.csv", only_header, RecordingError, r"cam0/data\.csv: lists no frames"),
    ("cam0/data.csv", swap(4), FormatError, r"cam0/data\.csv line 5: stamp"),
    ("cam0/data.csv", edit(4, field(1, "../../secret.png")), FormatError, r"cam0/data\.csv line 4: '\.\./\.\./secret"),
    ("cam0/sensor.yaml", Path.unlink, CalibrationError, r"cam0/sensor\.yaml: no such file"),
    ("cam0/sensor.yaml", without("intrinsics"), CalibrationError, r"cam0/sensor\.yaml: missing key 'intrinsics'"),
    ("cam0/sensor.yaml", without("T_BS"), CalibrationError, r"cam0/sensor\.yaml: missing key 'T_BS'"),
    (f"{TRUTH}/data.csv", edit(7, field(4, "7")), FormatError, r"data\.csv line 7: quaternion of length"),
    (f"{TRUTH}/data.csv", edit(7, field(2, "inf")), FormatError, r"data\.csv line 7: .*not finite"),
    (f"{TRUTH}/data.csv", only_header, FormatError, r"data\.csv: no rows"),
    ("depth0/sensor.yaml", without("depth_unit_m"), CalibrationError, r"depth0/sensor\.yaml: missing key"),
    ("../recording.yaml", edit(1, lambda _: "schema: 99"), RecordingError, r"recording\.yaml: schema 99 is unknown"),
    ("../recording.yaml", edit(3, lambda _: "provenance: [1]\nx:"), RecordingError, r"recording\.yaml: provenance"),
]


@pytest.mark.parametrize(("file", "damage", "kind", "words"), FAULTS)
def test_a_damaged_recording_says_what_and_where(recording, tmp_path: Path, file, damage, kind, words):
    write_asl(recording, tmp_path / "r")
    damage(tmp_path / "r" / "mav0" / file)
    with pytest.raises(kind, match=words) as caught:
        read_asl(tmp_path / "r")
    assert "\n" not in str(caught.value) and str(tmp_path) not in str(caught.value)


def test_without_images_the_camera_may_be_unknown_but_not_where_it_sits(recording, tmp_path: Path):
    write_asl(recording, tmp_path / "r")
    cam0 = tmp_path / "r" / "mav0" / "cam0"
    for file in (cam0 / "data").iterdir():
        file.unlink()
    without("intrinsics")(cam0 / "sensor.yaml")
    assert read_asl(tmp_path / "r").calibration.camera is None
    without("T_BS")(cam0 / "sensor.yaml")
    with pytest.raises(CalibrationError, match=r"cam0/sensor\.yaml: missing key 'T_BS'"):
        read_asl(tmp_path / "r")


GOOD = ["0.0 1 2 3 0 0 0 1", "0.5 1 2 3 0 0 0 1", "1.0 1 2 3 0 0 0 1"]


@pytest.mark.parametrize(("rows", "words"), [
    ([], "no rows"),
    (["# only a comment"], "no rows"),
    ([GOOD[0], "0.5 nan 2 3 0 0 0 1"], "line 2: a value is not finite"),
    ([GOOD[0], "0.5 1 2 3 0 0 0"], "line 2: 7 columns, expected at least 8"),
    ([GOOD[0], "0.5 1 2 x 0 0 0 1"], "line 2: 'x' in column 4 is not a number"),
    ([GOOD[0], "0.5 1 2 3 0 0 0.1 1"], r"line 2: quaternion of length 1\.00499"),
    ([GOOD[0], "", GOOD[2], GOOD[1]], r"line 4: stamp 0\.500000000 s goes back from 1\.0"),
    ([GOOD[0], GOOD[0]], "line 2: stamp .* repeats"),
])
def test_damaged_tum_files(tmp_path: Path, rows, words):
    file = tmp_path / "a.tum"
    file.write_text("\n".join(rows))
    with pytest.raises(FormatError, match=rf"a\.tum.*{words}"):
        read_tum(file)


def test_damaged_kitti_files(tmp_path: Path):
    poses, times = tmp_path / "poses.txt", tmp_path / "times.txt"
    good = "1 0 0 0 0 1 0 0 0 0 1 0\n"
    for content, words in (("", "no rows"), (good + good.replace("1", "2"), r"pose\[1\]: not a rigid"),
                           (good + "1 2\n", "line 2: 2 columns, expected at least 12")):
        poses.write_text(content)
        with pytest.raises(FormatError, match=words):
            read_kitti(poses)
    poses.write_text(2 * good)
    for content, words in (("0\n", "1 times for 2 poses"), ("1\n1\n", "line 2: time"), ("0\ninf\n", "line 2: a value")):
        times.write_text(content)
        with pytest.raises(FormatError, match=rf"times\.txt.*{words}"):
            read_kitti(poses, times)


def motions(**change) -> RelativeMotions:
    n = 3
    values = {"t_i_s": np.arange(n), "t_j_s": np.arange(n) + 1.0, "T_i_j": se3.exp(np.full((n, 6), 0.1)),
              "cov": np.tile(np.eye(6) * 1e-4, (n, 1, 1)), "scale_log_mean": 0.1, "scale_log_sd": 0.2}
    return RelativeMotions(**(values | change))


def test_motions_survive_their_file(tmp_path: Path):
    before = motions(snr=np.array([1.0, 2.0, 3.0]), meta={"method": "af", "nested": [1, "ä"]})
    before.save(tmp_path / "m.npz")
    after = load_motions(tmp_path / "m.npz")
    for name in ("t_i_s", "t_j_s", "cov", "snr"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    np.testing.assert_allclose(after.T_i_j, before.T_i_j, atol=1e-15)
    assert (after.scale_log_mean, after.scale_log_sd, after.meta) == (0.1, 0.2, before.meta)


@pytest.mark.parametrize(("change", "words"), [
    ({"t_i_s": np.zeros(0)}, "empty"),
    ({"t_j_s": np.arange(4.0)}, "shapes"),
    ({"t_j_s": np.array([1.0, np.nan, 3.0])}, "not finite"),
    ({"t_j_s": np.array([1.0, 1.0, 3.0])}, r"motions\[1\]: t_i 1\.0+ s is not before t_j"),
    ({"scale_log_sd": -1.0}, "scale prior"),
    ({"snr": np.zeros(2)}, "snr"),
    ({"cov": np.zeros((3, 6, 6))}, r"cov\[0\]"),
    ({"T_i_j": np.zeros((3, 4, 4))}, r"T_i_j\[0\]"),
])
def test_impossible_motions(change, words):
    with pytest.raises(VioError, match=words):
        motions(**change)


@pytest.mark.parametrize("key", ["t_i", "T_i_j", "cov", "scale_log_sd"])
def test_a_missing_key_of_motions_is_named(tmp_path: Path, key):
    file = tmp_path / "m.npz"
    motions().save(file)
    with np.load(file) as data:
        np.savez(tmp_path / "less.npz", **{name: data[name] for name in data.files if name != key})
    with pytest.raises(MotionsError, match=rf"less\.npz: missing key '{key}'"):
        load_motions(tmp_path / "less.npz")
    file.write_bytes(file.read_bytes()[:200])
    with pytest.raises(MotionsError, match=r"m\.npz: not a readable npz"):
        load_motions(file)


# --- whatever the bytes, only our own errors -------------------------------------------------------------------------

NUMBERS = st.sampled_from(["0", "1", "-1", "1e3", "nan", "inf", "-", "", " ", "x", "9" * 25, "1_0", "1 2", "٣"])
ROWS = st.lists(st.lists(NUMBERS, max_size=18), max_size=6)
TABLES = st.builds(lambda rows, comma: "\n".join(comma.join(row) for row in rows), ROWS, st.sampled_from([",", " "]))
TEXT = st.one_of(st.binary(max_size=200), TABLES.map(str.encode))
READERS = [read_tum, read_kitti, read_asl_imu, read_asl_truth, load_motions]


def damaged(whole: bytes, data: st.DataObject) -> bytes:
    """Some bytes replaced by a few others."""
    start = data.draw(st.integers(0, len(whole)))
    end = data.draw(st.integers(start, min(len(whole), start + data.draw(st.sampled_from([0, 2, 20, 10_000])))))
    return whole[:start] + data.draw(st.binary(max_size=6)) + whole[end:]


@pytest.mark.parametrize("read", READERS)
@given(content=TEXT)
@example(content=b"")
@example(content=b"\xef\xbb\xbf1,0,0,0,0,0,0\n")
@example(content=b"PK\x03\x04")
@example(content=b"\x93NUMPY\x01\x00")
def test_readers_raise_nothing_but_our_errors(tmp_path_factory, read, content):
    file = tmp_path_factory.getbasetemp() / f"fuzz-{read.__name__}"
    file.write_bytes(content)
    try:
        read(file)
    except VioError as error:
        assert "\n" not in str(error)


@given(data=st.data())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damaged_motions_raise_nothing_but_our_errors(tmp_path: Path, data):
    if not (tmp_path / "whole.npz").exists():
        motions(meta={"method": "x"}).save(tmp_path / "whole.npz")
    (tmp_path / "m.npz").write_bytes(damaged((tmp_path / "whole.npz").read_bytes(), data))
    try:
        load_motions(tmp_path / "m.npz")
    except VioError as error:
        assert "\n" not in str(error)


def test_one_array_is_not_motions(tmp_path: Path):
    np.save(tmp_path / "m.npy", np.eye(4))
    with pytest.raises(MotionsError, match=r"m\.npy: not a readable npz"):
        load_motions(tmp_path / "m.npy")


@pytest.mark.parametrize("part", ["cam0/data.csv", "cam0/sensor.yaml", "imu0/sensor.yaml", "depth0/sensor.yaml",
                                  "../recording.yaml"])
@given(data=st.data())
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_recordings_raise_nothing_but_our_errors(recording, tmp_path: Path, part, data):
    if not (tmp_path / "r").exists():
        write_asl(recording, tmp_path / "r")
        (tmp_path / "whole").write_bytes((tmp_path / "r" / "mav0" / part).read_bytes())
    (tmp_path / "r" / "mav0" / part).write_bytes(damaged((tmp_path / "whole").read_bytes(), data))
    try:
        read_asl(tmp_path / "r")
    except VioError as error:
        assert "\n" not in str(error) and str(tmp_path) not in str(error)
