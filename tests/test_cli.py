"""End to end through the command line: what is printed, what is written, and every exit code of the contract."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from fusion.cli import main
from vio.formats import open_recording
from vio.motions import load_motions

FRAMES, SECONDS = 60, 20


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated recording REC with motions.npz beside it, made by the command line itself."""
    folder = tmp_path_factory.mktemp("cli")
    simulate(folder / "REC", folder / "motions.npz")
    return folder


def simulate(rec: Path, motions: Path) -> None:
    scenario = ["--organ", "colon", "--vibration", "gaussian", "--level", "2", "--duration", str(SECONDS)]
    arguments = ["simulate", *scenario, "--seed", "5", "--no-images", "--out", str(rec), "--motions", str(motions)]
    assert main(arguments) == 0


@pytest.fixture
def rec(made: Path, tmp_path: Path) -> Path:
    """A copy that a test may spoil."""
    shutil.copytree(made / "REC", tmp_path / "REC")
    return tmp_path / "REC"


def refine(rec: Path, motions: Path, out: Path, *more: str) -> int:
    return main(["refine", str(rec), "--motions", str(motions), "--out", str(out), *more])


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    lines = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("…")]
    assert len(lines) == 1, lines
    return lines[0]


def test_refine_writes_the_run_folder_and_compare_reads_it(made, tmp_path, capsys):
    assert refine(made / "REC", made / "motions.npz", tmp_path / "RUN", "--json") == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["estimator"] == "graph" and summary["frames"] == FRAMES
    assert {p.name for p in (tmp_path / "RUN").iterdir()} >= {
        "trajectory.tum", "trajectory.npz", "motions_only.tum", "summary.json", "manifest.json", "report.html"}
    manifest = (tmp_path / "RUN" / "manifest.json").read_text()
    assert str(tmp_path) not in manifest and str(made) not in manifest
    assert main(["compare", str(tmp_path / "RUN"), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["accuracy"]
    for name, key in (("RUN: refined", "refined"), ("RUN: motions only", "motions")):
        for mode in ("origin", "yaw4", "se3", "sim3"):
            expected = summary["accuracy"][key][mode]["ate_rmse_m"]
            assert rows[name][mode]["ate_rmse_m"] == pytest.approx(expected, rel=1e-6)


def test_two_runs_give_the_same_bytes(made, tmp_path):
    for name in ("A", "B"):
        assert refine(made / "REC", made / "motions.npz", tmp_path / name / "RUN") == 0
    for file in ("trajectory.tum", "trajectory.npz", "motions_only.tum", "manifest.json", "trajectory.svg"):
        a, b = ((tmp_path / name / "RUN" / file).read_bytes() for name in ("A", "B"))
        assert a == b, file


@pytest.mark.parametrize("estimator", ["graph", "ekf"])
def test_an_estimator_can_be_forced(made, tmp_path, capsys, estimator):
    assert refine(made / "REC", made / "motions.npz", tmp_path / "RUN", "--estimator", estimator, "--json") == 0
    assert json.loads(capsys.readouterr().out)["estimator"] == estimator


def test_inspect_says_what_is_there(made, capsys):
    assert main(["inspect", str(made / "REC"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["usable"] and found["facts"]["frames"] == FRAMES
    assert found["facts"]["imu_rate_hz"] == pytest.approx(40, rel=1e-3)


def test_doctor_refines_with_both_estimators(capsys):
    assert main(["doctor", "--json"]) == 0
    found = {finding["name"]: finding for finding in json.loads(capsys.readouterr().out)}
    assert found["graph"]["ok"] and found["ekf"]["ok"]


def test_simulate_is_reproducible(made, tmp_path):
    simulate(tmp_path / "REC", tmp_path / "m.npz")
    for file in sorted(p for p in (made / "REC").rglob("*") if p.is_file()):
        assert file.read_bytes() == (tmp_path / "REC" / file.relative_to(made / "REC")).read_bytes(), file.name
    assert np.array_equal(load_motions(made / "motions.npz").T_i_j, load_motions(tmp_path / "m.npz").T_i_j)


def test_a_truth_can_be_given_and_losing_is_said(made, tmp_path, capsys):
    assert refine(made / "REC", made / "motions.npz", tmp_path / "RUN") == 0
    run = tmp_path / "RUN"
    capsys.readouterr()
    shutil.copy(run / "motions_only.tum", tmp_path / "truth.tum")  # against this "truth" the motions are perfect
    assert main(["compare", str(run), "--truth", str(tmp_path / "truth.tum")]) == 0
    assert "LOSES" in capsys.readouterr().out


@pytest.mark.parametrize("arguments", [[], ["refine"], ["refine", "REC"], ["no-such"], ["simulate"],
                                       ["simulate", "--organ", "liver", "--out", "x"],
                                       ["simulate", "--dataset", "mm-wce", "--no-images", "--out", "x"]])
def test_wrong_usage_exits_2(arguments, capsys):
    try:
        code = main(arguments)
    except SystemExit as error:  # argparse
        code = error.code
    assert code == 2
    assert capsys.readouterr().err


def imu_rows(rec: Path) -> tuple[Path, list[str]]:
    path = rec / "mav0" / "imu0" / "data.csv"
    return path, path.read_text().splitlines()


def spoil_nan(rec: Path) -> None:
    path, rows = imu_rows(rec)
    rows[100] = rows[100].split(",")[0] + ",nan,0,0,0,0,9.81"
    path.write_text("\n".join(rows))


def spoil_order(rec: Path) -> None:
    path, rows = imu_rows(rec)
    rows[50], rows[51] = rows[51], rows[50]
    path.write_text("\n".join(rows))


def spoil_duplicate(rec: Path) -> None:
    path, rows = imu_rows(rec)
    rows.insert(60, rows[60])
    path.write_text("\n".join(rows))


def spoil_values(rec: Path, change) -> None:
    path, rows = imu_rows(rec)
    spoiled = []
    for row in rows[1:]:
        stamp, *values = row.split(",")
        spoiled.append(",".join([stamp, *(repr(float(v)) for v in change(np.array(values, float)))]))
    path.write_text("\n".join([rows[0], *spoiled]))


def spoil_g(rec: Path) -> None:
    spoil_values(rec, lambda v: np.r_[v[:3], v[3:] / 9.80665])


def spoil_deg(rec: Path) -> None:
    spoil_values(rec, lambda v: np.r_[np.rad2deg(v[:3]), v[3:]])


def spoil_gravity(rec: Path) -> None:
    spoil_values(rec, lambda v: np.r_[v[:3], 0.01 * v[3:]])


def spoil_saturated(rec: Path) -> None:
    counter = iter(range(10**9))
    spoil_values(rec, lambda v: np.r_[v[:4], 39.2266, v[5:]] if next(counter) % 5 == 0 else v)


def spoil_coverage(rec: Path) -> None:
    path, rows = imu_rows(rec)
    path.write_text("\n".join(rows[:300]))


def spoil_calibration(rec: Path) -> None:
    path = rec / "mav0" / "imu0" / "sensor.yaml"
    path.write_text("\n".join(row for row in path.read_text().splitlines() if "gyroscope_noise_density" not in row))


def spoil_one_frame(rec: Path) -> None:
    path = rec / "mav0" / "cam0" / "data.csv"
    path.write_text("\n".join(path.read_text().splitlines()[:2]))


def spoil_no_frames(rec: Path) -> None:
    path = rec / "mav0" / "cam0" / "data.csv"
    path.write_text(path.read_text().splitlines()[0])


FAULTS = [
    (spoil_nan, "finite"), (spoil_order, "sort"), (spoil_duplicate, "duplicate"), (spoil_g, "g"), (spoil_deg, "deg/s"),
    (spoil_gravity, "gravity"), (spoil_saturated, "full scale"),
    (spoil_coverage, "cover"), (spoil_calibration, "gyroscope_noise_density"),
    (spoil_one_frame, "2"), (spoil_no_frames, "frame"),
]


@pytest.mark.parametrize(("spoil", "word"), FAULTS, ids=[spoil.__name__ for spoil, _ in FAULTS])
def test_an_unusable_recording_exits_3_with_one_line_and_writes_nothing(made, rec, tmp_path, capsys, spoil, word):
    spoil(rec)
    assert refine(rec, made / "motions.npz", tmp_path / "RUN") == 3
    assert word in one_line(capsys)
    assert not (tmp_path / "RUN").exists()


def test_unusable_motions_exit_3(made, tmp_path, capsys):
    with np.load(made / "motions.npz") as data:
        arrays = dict(data)
    spoiled = {
        "rotation": ("T_i_j", lambda T: T * 1.01),
        "finite": ("T_i_j", lambda T: np.where(T[3, 0, 3] == T, np.nan, T)),
        "positive definite": ("cov", lambda c: -c), "matches no frame": ("t_j", lambda t: t + 0.1),
    }
    for name, (key, change) in spoiled.items():
        np.savez(tmp_path / "bad.npz", **{**arrays, key: change(arrays[key])})
        assert refine(made / "REC", tmp_path / "bad.npz", tmp_path / "RUN") == 3, name
        assert ("rigid transform" if name == "rotation" else name) in one_line(capsys)
    np.savez(tmp_path / "bad.npz", **{k: v for k, v in arrays.items() if k != "cov"})
    assert refine(made / "REC", tmp_path / "bad.npz", tmp_path / "RUN") == 3
    assert "cov" in one_line(capsys)
    assert not (tmp_path / "RUN").exists()


def test_configuration_mistakes_exit_3(made, tmp_path, capsys):
    config = tmp_path / "c.yaml"
    mistakes = (("robust: {gat: 3}", "robust.gat"), ("solver: {chunk_frames: -1}", "positive"), ("[1]", "mapping"))
    for text, word in mistakes:
        config.write_text(text)
        assert refine(made / "REC", made / "motions.npz", tmp_path / "RUN", "--config", str(config)) == 3
        assert word in one_line(capsys)


def test_a_foreign_folder_is_never_replaced(made, tmp_path, capsys):
    (tmp_path / "RUN").mkdir()
    (tmp_path / "RUN" / "thesis.txt").write_text("mine")
    assert refine(made / "REC", made / "motions.npz", tmp_path / "RUN") == 3
    assert "choose another --out" in one_line(capsys)
    assert (tmp_path / "RUN" / "thesis.txt").read_text() == "mine"


def test_an_unwritable_output_exits_3(made, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert refine(made / "REC", made / "motions.npz", tmp_path / "file" / "RUN") == 3
    assert "cannot write" in one_line(capsys)


def test_prediction_without_images_says_so(made, tmp_path, capsys):
    for options in ([], ["--method", "classical"]):
        assert main(["predict", str(made / "REC"), *options, "--out", str(tmp_path / "m.npz")]) == 3
        assert "image" in one_line(capsys)
    assert main(["predict", str(made / "REC"), "--weights", "no.safetensors", "--out", str(tmp_path / "m.npz")]) == 3
    assert "weights no.safetensors" in one_line(capsys)
    assert not (tmp_path / "m.npz").exists()


def test_images_are_simulated_and_inspected(tmp_path, capsys):
    pytest.importorskip("numba", reason="images need the extra 'sim'")
    scenario = ["--organ", "small-bowel", "--vibration", "collision", "--level", "3", "--duration", "2", "--seed", "3"]
    arguments = ["simulate", *scenario, "--camera", "fisheye-140", "--size", "64", "--products", "mask", "flow"]
    assert main([*arguments, "--out", str(tmp_path / "REC")]) == 0
    assert main(["inspect", str(tmp_path / "REC"), "--json"]) == 0
    out = capsys.readouterr().out
    found = json.loads(out[out.index("{"):])
    assert found["usable"] and any(
        check["name"] == "images" and check["text"] == "all 6 image files exist" for check in found["checks"])
    assert main([*arguments[:-3], "--no-images", "--out", str(tmp_path / "PLAIN")]) == 0
    plain, rendered = (open_recording(tmp_path / name) for name in ("PLAIN", "REC"))
    np.testing.assert_array_equal(plain.truth.T_world_body, rendered.truth.T_world_body)  # one motion drives both
    np.testing.assert_array_equal(plain.imu.accel_m_s2, rendered.imu.accel_m_s2)
    for spoil, words in ((lambda content: content[:len(content) // 2], "image files are cut off, the first is that of"),
                         (lambda content: content[:16] + (3840).to_bytes(4, "big") + (2160).to_bytes(4, "big")
                          + content[24:], "3840 x 2160 pixels but the calibration is for 64 x 64")):
        image = rendered.frame_paths[0]
        whole = image.read_bytes()
        image.write_bytes(spoil(whole))
        assert main(["inspect", str(tmp_path / "REC")]) == 0
        assert words in capsys.readouterr().out
        image.write_bytes(whole)


@pytest.mark.parametrize(("change", "word"), [
    (["--level", "7"], "from 0 to 5"), (["--duration", "0"], "above 0"), (["--seed", "-1"], "≥ 0"),
    (["--size", "5"], "give 16 to 4096"), (["--size", "0"], "whole number of pixels"), (["--start", "2"], "from 0"),
])
def test_what_cannot_be_simulated_exits_3_and_writes_nothing(tmp_path, capsys, change, word):
    assert main(["simulate", "--out", str(tmp_path / "REC"), "--duration", "2", *change]) == 3
    assert word in one_line(capsys)
    assert list(tmp_path.iterdir()) == []


def test_compare_without_truth_says_what_to_give(made, tmp_path, capsys):
    assert refine(made / "REC", made / "motions.npz", tmp_path / "RUN") == 0
    capsys.readouterr()
    assert main(["compare", str(tmp_path / "RUN" / "trajectory.tum")]) == 3
    assert "--truth" in one_line(capsys)
