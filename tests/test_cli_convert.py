"""`capsule-vio convert` from the command line: other people's data become a recording that the next command reads."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from fusion.cli import main
from tests.vio.samples import PATIENT, SAMPLES, T_BODY_CAMERA
from vio import open_recording
from vio.simulation import network_like_motions


def test_own_images_with_an_imu_are_converted_inspected_and_predicted_on(tmp_path: Path, capsys):
    root = SAMPLES["images"](tmp_path / "data").root
    assert main(["convert", str(root), "--to", "asl", str(tmp_path / "REC"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["format"] == "images" and found["frames"] == "6 over 1.750 s" and found["imu"] == "100 samples"
    assert main(["inspect", str(tmp_path / "REC"), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)["facts"]
    assert (facts["frames"], facts["imu_samples"], facts["time_offset_s"]) == (6, 100, 0.0125)
    assert PATIENT not in (tmp_path / "REC" / "recording.yaml").read_text()


def test_what_the_user_declares_reaches_the_reader(tmp_path: Path, capsys):
    made = SAMPLES["vrcaps"](tmp_path / "data")
    chain = tmp_path / "c.yaml"
    chain.write_text(yaml.safe_dump({"cam0": {
        "camera_model": "pinhole", "intrinsics": [20, 21, 15.5, 11.5], "distortion_model": "none",
        "resolution": [32, 24], "T_cam_imu": np.linalg.inv(T_BODY_CAMERA).tolist()}}))
    arguments = ["convert", str(made.root), "--to", "asl", str(tmp_path / "REC"), "--format", "vrcaps"]
    assert main([*arguments, "--calibration", str(chain), "--unit-m", "0.1", "--depth-planes", "0.01", "2"]) == 0
    out = capsys.readouterr().out
    assert "depth    6 images, in metres" in out and "truth    6 poses" in out and "imu      none" in out
    back = open_recording(tmp_path / "REC")
    np.testing.assert_allclose(back.truth_at_frames().T_world_body @ T_BODY_CAMERA, made.T_world_camera, atol=1e-10)
    assert main(arguments[:-2]) == 0  # again, and declared nothing: replaces its own output
    out = capsys.readouterr().out
    assert "up to an unknown factor; declare --depth-planes and --unit-m" in out and "truth    none: needs" in out
    assert open_recording(tmp_path / "REC").truth is None


def test_a_film_becomes_images(tmp_path: Path, capsys):
    made = SAMPLES["video"](tmp_path / "data")
    assert main(["convert", str(made.root), "--to", "asl", str(tmp_path / "REC")]) == 0
    back = open_recording(tmp_path / "REC")
    for k in (0, 5):
        np.testing.assert_array_equal(back.frame(k), made.images[k])
    capsys.readouterr()


def test_only_the_calibration_for_kalibr(tmp_path: Path, capsys):
    root = SAMPLES["images"](tmp_path / "data").root
    assert main(["convert", str(root), "--to", "kalibr", str(tmp_path / "K")]) == 0
    chain = yaml.safe_load((tmp_path / "K" / "camchain.yaml").read_text())["cam0"]
    np.testing.assert_allclose(chain["T_cam_imu"], np.linalg.inv(T_BODY_CAMERA), atol=1e-12)
    assert chain["timeshift_cam_imu"] == 0.0125 and {p.name for p in (tmp_path / "K").iterdir()} == {
        "camchain.yaml", "imu.yaml"}
    capsys.readouterr()


def test_without_an_imu_refinement_says_why_not(tmp_path: Path, capsys):
    made = SAMPLES["scared"](tmp_path / "data")
    assert main(["convert", str(made.root), "--to", "asl", str(tmp_path / "REC"), "--rate-hz", "25"]) == 0
    recording = open_recording(tmp_path / "REC")
    truth = recording.truth_at_frames()
    motions = network_like_motions(truth, recording.calibration.T_body_camera, 1).motions
    motions.save(tmp_path / "motions.npz")
    capsys.readouterr()
    arguments = ["refine", str(tmp_path / "REC"), "--motions", str(tmp_path / "motions.npz")]
    assert main([*arguments, "--out", str(tmp_path / "RUN")]) == 3
    lines = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("…")]
    assert len(lines) == 1 and "imu: 0 samples; at least 2 are needed" in lines[0]


@pytest.mark.parametrize(("name", "more", "code", "words"), [
    ("simcol3d", [], 3, "declare a constant rate with --rate-hz"),
    ("tum-rgbd", ["--rate-hz", "30"], 3, "format tum-rgbd does not take --rate-hz"),
    ("images", ["--imu-calibration", "i.yaml"], 2, "--imu-calibration needs --calibration"),
    ("images", ["--calibration", "absent.yaml"], 3, "absent.yaml: no such file"),
    ("endoslam", ["--depth-planes", "2", "1", "--unit-m", "1"], 3, "near 2, far 1; give 0 < near < far"),
    ("images", ["--format", "kitti"], 3, "no image_0/000000.png"),
])
def test_what_cannot_be_done_is_one_line(tmp_path: Path, capsys, name, more, code, words):
    root = SAMPLES[name](tmp_path / "data").root
    assert main(["convert", str(root), "--to", "asl", str(tmp_path / "REC"), *more]) == code
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1 and words in captured.err
    assert not (tmp_path / "REC").exists()


def test_help_shows_an_example(capsys):
    with pytest.raises(SystemExit) as done:
        main(["convert", "--help"])
    text = capsys.readouterr().out
    assert done.value.code == 0 and "example: capsule-vio convert" in text and "--presentation-times" in text
    with pytest.raises(SystemExit) as wrong:
        main(["convert", "SRC", "OUT"])
    assert wrong.value.code == 2
