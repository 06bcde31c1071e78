"""The run folder: what the contract promises is there, whole or not at all, and other tools read it."""

import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core import sync as evo_sync
from evo.tools import file_interface

from fusion import Provenance, RefineConfig, read_run, refine, run_folder, write_run
from fusion.config import ScaleConfig
from vio.errors import FormatError, OutputError
from vio.formats.tum import write_tum

FILES = {"trajectory.tum", "trajectory.npz", "motions_only.tum", "summary.json", "manifest.json", "report.html"}
MODES = {"none", "origin", "yaw4", "se3", "sim3"}
SUMMARY = {
    "schema": int, "estimator": str, "fallback_reason": type(None), "frames": int, "duration_s": float,
    "path_length_m": float, "time_offset_s": float, "timing_s": dict, "peak_rss_bytes": int,
    "scale": {"policy": str, "log_mean": float, "log_sd": float, "reason": str},
    "imu": {"chi2_per_dof": float, "inflation": float, "gaps": list},
    "motions": {"used": int, "rejected": int}, "loops": {"proposed": int, "accepted": int},
}
STATES = {"t": (300,), "T_world_body": (300, 4, 4), "cov": (300, 6, 6), "velocity": (300, 3), "gyro_bias": (300, 3),
          "accel_bias": (300, 3), "log_scale": (300,), "log_scale_sd": (300,)}


@pytest.fixture(scope="module")
def inputs(examination, tmp_path_factory) -> dict[str, Path]:
    path = tmp_path_factory.mktemp("inputs") / "motions.npz"
    examination.motions.save(path)
    return {"motions": path}


@pytest.fixture(scope="module")
def provenance(inputs) -> Provenance:
    return Provenance(["refine", "REC", "--motions", "motions.npz"], RefineConfig(scale=ScaleConfig(segment_s=20.0)),
                      inputs, seed=7)


@pytest.fixture(scope="module")
def run(refined, provenance, examination, tmp_path_factory) -> Path:
    """A run folder that no test may change."""
    out = tmp_path_factory.mktemp("runs") / "RUN"
    write_run(refined, out, provenance, examination.motions)
    return out


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def check_shape(value, shape, where=""):
    for key, kind in shape.items():
        assert key in value, f"{where}{key} is missing"
        if isinstance(kind, dict):
            check_shape(value[key], kind, f"{where}{key}.")
        else:
            assert type(value[key]) is kind, f"{where}{key} is {value[key]!r}"


# ---- the contract ----------------------------------------------------------------------------

def test_every_file_of_the_contract_is_there(run):
    assert {path.name for path in run.iterdir()} >= FILES
    assert all(path.stat().st_size > 0 for path in run.iterdir())


def test_summary_has_the_keys_of_the_contract(run, refined):
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    check_shape(summary, SUMMARY)
    assert summary["schema"] == 1
    assert summary["estimator"] == "graph" and summary["scale"]["policy"] in ("free", "prior", "fixed")
    assert summary["frames"] == 300 and summary["duration_s"] == pytest.approx(299 / 3)
    assert summary["path_length_m"] == refined.trajectory.path_length_m
    assert summary["motions"]["used"] + summary["motions"]["rejected"] == 299
    assert set(summary["accuracy"]) == set(summary["paper_metrics"]) == {"refined", "motions"}
    for block in summary["accuracy"].values():
        assert set(block) == MODES | {"scale_error"}
        for mode in MODES:
            assert set(block[mode]) == {"ate_rmse_m", "rotation_rmse_rad", "matched"} and block[mode]["matched"] == 300
        assert isinstance(block["scale_error"], float)


def test_gaps_are_listed_with_their_times(examination, provenance, tmp_path):
    imu_t = examination.recording.imu_t_s
    gapped = refine(examination.with_samples((imu_t < 50) | (imu_t > 52)), examination.motions)
    gap, = write_run(gapped, tmp_path / "RUN", provenance)["imu"]["gaps"]
    assert gap == {"start_s": pytest.approx(50, abs=0.03), "end_s": pytest.approx(52, abs=0.03)}


def test_states_have_the_keys_and_shapes_of_the_contract(run, refined):
    arrays = np.load(run / "trajectory.npz", allow_pickle=False)
    for key, shape in STATES.items():
        assert arrays[key].shape == shape and arrays[key].dtype == np.float64, key
        assert np.isfinite(arrays[key]).all(), key
    np.testing.assert_array_equal(arrays["T_world_body"], refined.trajectory.T_world_body)
    np.testing.assert_array_equal(arrays["cov"], refined.trajectory.cov)
    root = np.sqrt(np.diagonal(arrays["cov"], axis1=1, axis2=2))
    assert np.linalg.eigvalsh(arrays["cov"] / (root[:, :, None] * root[:, None, :])).min() > 0


@pytest.mark.parametrize("name", ["trajectory.tum", "motions_only.tum", "truth.tum"])
def test_tum_files_hold_nine_digits_or_more(run, refined, name):
    lines = [line for line in (run / name).read_text(encoding="ascii").splitlines() if not line.startswith("#")]
    assert len(lines) == 300
    for line in lines:
        fields = line.split(" ")
        assert len(fields) == 8
        for field in fields[1:]:
            assert re.fullmatch(r"-?\d\.\d{8,}e[+-]\d\d", field), field
    expected = {"trajectory.tum": refined.trajectory, "motions_only.tum": refined.motions_only,
                "truth.tum": refined.truth}[name]
    np.testing.assert_allclose(np.loadtxt(run / name)[:, 1:4], expected.positions_m, rtol=1e-9, atol=0)


def test_manifest_says_how_the_run_came_about(run, inputs, tmp_path_factory):
    text = (run / "manifest.json").read_text(encoding="utf-8")
    manifest = json.loads(text)
    digest = hashlib.sha256(inputs["motions"].read_bytes()).hexdigest()
    assert manifest["inputs"] == {"motions": {"name": "motions.npz", "sha256": digest}}
    assert manifest["command"] == ["refine", "REC", "--motions", "motions.npz"] and manifest["seed"] == 7
    assert manifest["config"]["scale"]["segment_s"] == 20.0 and manifest["config"]["estimator"] == "auto"
    assert manifest["libraries"]["numpy"] == np.__version__ and manifest["libraries"]["gtsam"]
    assert str(tmp_path_factory.getbasetemp()) not in text


def test_a_run_reads_back(run, refined):
    again = read_run(run)
    assert again.name == "RUN" and again.summary["frames"] == 300
    np.testing.assert_allclose(again.refined.T_world_body, refined.trajectory.T_world_body, atol=1e-12)
    np.testing.assert_allclose(again.motions_only.T_world_body, refined.motions_only.T_world_body, atol=1e-12)
    np.testing.assert_allclose(again.refined.t_s, refined.trajectory.t_s, atol=1e-9)


def test_the_same_run_gives_the_same_bytes(examination, run, provenance, tmp_path):
    """All but how long it took and how much memory: those are set aside."""
    written = []
    for k in range(2):
        result = refine(examination.recording, examination.motions)
        write_run(replace(result, timing_s={"solve": 1.0}, peak_rss_bytes=1), tmp_path / str(k) / "RUN", provenance,
                  examination.motions)
        written.append(contents(tmp_path / str(k) / "RUN"))
    assert written[0] == written[1]
    ours = contents(run)
    assert {name for name in ours if ours[name] != written[0][name]} <= {"summary.json", "report.html"}


def test_a_resting_capsule_has_a_folder_without_a_number_that_is_none(examine, provenance, tmp_path):
    """No path, no alignment, no scale error: they are 'unavailable' with a reason, never NaN."""
    still = examine("colon", "none", 0, 20.0, 5, mode="rest")
    write_run(refine(still.recording, still.motions), tmp_path / "RUN", provenance, still.motions)
    text = (tmp_path / "RUN" / "summary.json").read_text(encoding="utf-8")
    assert "NaN" not in text and "Infinity" not in text
    accuracy = json.loads(text)["accuracy"]["refined"]
    assert "motionless" in accuracy["se3"]["unavailable"] and "motionless" in accuracy["scale_error"]["unavailable"]
    assert accuracy["origin"]["ate_rmse_m"] < 0.005


def test_without_truth_nothing_is_claimed_about_accuracy(refined, provenance, tmp_path):
    summary = write_run(replace(refined, truth=None), tmp_path / "RUN", provenance)
    assert not {"accuracy", "paper_metrics"} & set(summary)
    assert not (tmp_path / "RUN" / "truth.tum").exists()


# ---- evo as oracle ---------------------------------------------------------------------------

@pytest.mark.parametrize(("name", "key"), [("trajectory.tum", "refined"), ("motions_only.tum", "motions")])
@pytest.mark.parametrize("mode", ["none", "se3", "sim3"])
def test_evo_reads_the_files_and_finds_the_same_errors(run, name, key, mode):
    estimate = file_interface.read_tum_trajectory_file(str(run / name))
    reference = file_interface.read_tum_trajectory_file(str(run / "truth.tum"))
    assert estimate.check()[0]
    reference, estimate = evo_sync.associate_trajectories(reference, estimate, max_diff=0.01)
    if mode != "none":
        estimate.align(reference, correct_scale=mode == "sim3")
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))["accuracy"][key][mode]
    for relation, ours in ((evo_metrics.PoseRelation.translation_part, summary["ate_rmse_m"]),
                           (evo_metrics.PoseRelation.rotation_angle_rad, summary["rotation_rmse_rad"])):
        ape = evo_metrics.APE(relation)
        ape.process_data((reference, estimate))
        assert ape.get_statistic(evo_metrics.StatisticsType.rmse) == pytest.approx(ours, rel=1e-6)


# ---- whole or not at all ---------------------------------------------------------------------

WRITERS = ["write_tum", "_write_states", "_write_json"]


def full_disk(*_args, **_kwargs):
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize("writer", WRITERS)
def test_a_full_disk_leaves_nothing(refined, provenance, tmp_path, monkeypatch, writer):
    monkeypatch.setattr(run_folder, writer, full_disk)
    with pytest.raises(OutputError, match="cannot write RUN: No space left on device") as caught:
        write_run(refined, tmp_path / "RUN", provenance)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("writer", WRITERS)
def test_a_full_disk_leaves_the_run_before_untouched(refined, provenance, tmp_path, monkeypatch, writer):
    out = tmp_path / "RUN"
    write_run(refined, out, provenance)
    before = contents(tmp_path)
    monkeypatch.setattr(run_folder, writer, full_disk)
    with pytest.raises(OutputError):
        write_run(replace(refined, name="other"), out, provenance)
    assert contents(tmp_path) == before


def test_an_interruption_leaves_nothing(refined, provenance, tmp_path, monkeypatch):
    def interrupt(*_args, **_kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(run_folder, "_write_states", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_run(refined, tmp_path / "RUN", provenance)
    assert list(tmp_path.iterdir()) == []


def test_a_run_is_replaced_by_the_next(refined, provenance, tmp_path):
    out = tmp_path / "RUN"
    write_run(refined, out, provenance)
    (out / "left_over.txt").write_text("old", encoding="utf-8")
    write_run(replace(refined, truth=None), out, provenance)
    assert {path.name for path in out.iterdir()} >= FILES
    assert not (out / "left_over.txt").exists() and not (out / "truth.tum").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["RUN"]


def test_a_folder_of_somebody_else_is_refused(refined, provenance, tmp_path):
    out = tmp_path / "photos"
    out.mkdir()
    (out / "holiday.jpg").write_bytes(b"sun")
    before = contents(tmp_path)
    with pytest.raises(OutputError, match="photos exists and was not written by capsule-vio") as caught:
        write_run(refined, out, provenance)
    assert "choose another" in str(caught.value)
    file = tmp_path / "notes.txt"
    file.write_text("mine", encoding="utf-8")
    with pytest.raises(OutputError, match=r"notes\.txt exists"):
        write_run(refined, file, provenance)
    file.unlink()
    assert contents(tmp_path) == before


# ---- reading what is no run ------------------------------------------------------------------

@pytest.fixture
def copy(run, tmp_path) -> Path:
    out = tmp_path / "COPY"
    out.mkdir()
    for name, data in contents(run).items():
        (out / name).write_bytes(data)
    return out


@pytest.mark.parametrize(("name", "text", "words"), [
    ("summary.json", None, r"COPY: no summary\.json; give a folder written by"),
    ("summary.json", "{", r"COPY/summary\.json: not valid JSON"),
    ("summary.json", "[1]", r"COPY/summary\.json: not a summary of schema 1"),
    ("summary.json", '{"schema": 2}', "schema 1"),
    ("trajectory.tum", None, r"trajectory\.tum"),
    ("trajectory.tum", "0 1 2 3", r"trajectory\.tum"),
    ("motions_only.tum", "", r"motions_only\.tum: no rows"),
])
def test_a_broken_run_is_named(copy, name, text, words):
    if text is None:
        (copy / name).unlink()
    else:
        (copy / name).write_text(text, encoding="utf-8")
    with pytest.raises(FormatError, match=words) as caught:
        read_run(copy)
    assert "\n" not in str(caught.value)


def test_a_trajectory_alone_is_no_run(refined, tmp_path):
    write_tum(refined.trajectory, tmp_path / "trajectory.tum")
    with pytest.raises(FormatError, match=r"no summary\.json"):
        read_run(tmp_path)
