"""`capsule-vio benchmark`: the plan of every table, one table end to end, resumed, and what it refuses."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fusion import cli_parser
from fusion.cli import main
from learned.benchmark import BUDGETS, TABLES, run_table
from learned.benchmark.budgets import METHODS, STRATEGIES, budget_of, decisions
from learned.benchmark.conditions import CLEAN, CORRUPTED, Condition, shown
from learned.benchmark.scores import METRICS, guess, scores
from learned.benchmark.tables import plan_table
from learned.errors import BenchmarkError
from learned.measured import Measured
from learned.train_config import train_config_to_dict
from vio import se3
from vio.camera import Camera
from vio.corruptions import CORRUPTIONS, corrupt
from vio.errors import ConfigError
from vio.formats.asl import read_asl
from vio.simulation.dataset import plan as simulated_plan
from vio.simulation.dataset import recording_digest

KINDS = ("vibration-types/peristalsis", "vibration-types/collision")


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("benchmark")


@pytest.fixture
def data(made, written) -> Path:
    """A data set as the simulator lays it out, of three views of the ball."""
    folder = made / "DATA"
    if folder.is_dir():
        return folder
    balls = [made / f"ball{k}" for k in range(3)]
    for k, ball in enumerate(balls):
        written(made, Camera("pinhole", 64, 64, 40 + 3 * k, 44, 30.5, 33.0), ball.name)
    entries = []
    for kind in KINDS:
        for part, count in (("train", 1), ("test", 3)):
            for k in range(count):
                path = f"{kind}/{part}/{k:02d}"
                shutil.copytree(balls[k], folder / path)
                entries.append({"path": path, "level": 3, "sha256": recording_digest(folder / path)})
    (folder / "manifest.json").write_text(json.dumps({"schema": 1, "simulator_version": 1, "sequences": entries}))
    return folder


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    """Smoke, smaller still."""
    monkeypatch.setitem(BUDGETS, "smoke", replace(BUDGETS["smoke"], steps=2, test_frames=5))


def command(data: Path, out: Path, *more: str) -> list[str]:
    return ["benchmark", "vibration-types", "--data", str(data), "--budget", "smoke", "--device", "cpu",
            "--out", str(out), *more]


@pytest.fixture
def finished(made, data) -> Path:
    if not (made / "OUT").is_dir():
        assert main(command(data, made / "OUT")) == 0
    return made / "OUT"


class Killed(Exception):
    """What ends a run from outside."""


class Killer:
    """Progress that ends the second run in the middle of its training."""

    def __init__(self) -> None:
        self.run = ""

    def __call__(self, stage: str) -> None:
        self.run = stage

    def count(self, done: int, total: int) -> None:
        if self.run.startswith("run 2 of 4") and done == 1:
            raise Killed


def test_a_table_from_the_command_line(finished, data, capsys):
    """Values are those of the files of runs, differences are paired, and finished runs are not made again."""
    table = json.loads((finished / "vibration-types.json").read_text())
    assert [(line["row"], line["side"]) for line in table["lines"]] == [
        (kind, side) for kind in ("peristalsis", "collision") for side in ("vision-only", "vision–vibration")]
    parts = [json.loads((finished / "runs" / f"af-sfmlearner_{fusion}_vibration-types-collision_seed-0" / "clean.json")
                        .read_text())["scores"] for fusion in ("vision", "fourier")]
    paths = [f"{KINDS[1]}/test/{k:02d}" for k in range(3)]
    assert list(parts[0]) == paths
    for metric in METRICS:
        values = [[part[path][metric.key] for path in paths] for part in parts]
        if any(value is None for side in values for value in side):
            continue
        assert np.isclose(table["lines"][3]["means"][metric.key], np.mean(values[1]))
        found = table["comparisons"][1]["differences"][metric.key]
        assert np.isclose(found["mean"], np.mean(np.subtract(values[1], values[0])))
        assert found["low"] <= found["mean"] <= found["high"]
        assert ("excludes 0" in found["verdict"]) == (found["low"] > 0 or found["high"] < 0) or found["mean"] == 0
    assert table["comparisons"][2]["row"] == "both kinds"
    assert table["comparisons"][2]["differences"]["abs_rel"]["sequences"] == 6
    assert table["lines"][0]["snr"] is None and all(value > 1 for value in table["lines"][1]["snr"].values())
    assert set(table["manifest"]["data"]["sha256"]) == {
        f"{kind}/{part}" for kind in KINDS for part in ("train/00", "test/00", "test/01", "test/02")}
    better = sum(line["means"]["abs_rel"] < guessed["means"]["abs_rel"]
                 for line, guessed in zip(table["lines"], np.repeat(table["guesses"], 2), strict=True))
    assert f"AbsRel: {better} of 4 variants beat the same depth everywhere." in table["verdicts"]
    page = (finished / "vibration-types.md").read_text()
    assert "not who wins" in page and "One seed" in page and str(data.parent) not in page + json.dumps(table)
    assert not list((finished / "training").rglob("checkpoint.pt"))
    before = {path: path.stat().st_mtime_ns for path in (finished / "runs").rglob("*.json")}
    capsys.readouterr()
    assert main(command(data, finished, "--json")) == 0
    assert json.loads(capsys.readouterr().out) == table
    assert {path: path.stat().st_mtime_ns for path in (finished / "runs").rglob("*.json")} == before


SHARED = """
import sys
from dataclasses import replace
from fusion.cli import main
from learned.benchmark import BUDGETS
BUDGETS["smoke"] = replace(BUDGETS["smoke"], steps=2, test_frames=5)
sys.exit(main(sys.argv[1:]))
"""


def test_two_processes_share_the_runs_and_make_the_same_table(finished, data, tmp_path):
    script, out = tmp_path / "shared.py", tmp_path / "OUT"
    script.write_text(SHARED)
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", str(script)]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parents[2])}
    ended = subprocess.run([*torchrun, *command(data, out)], capture_output=True, text=True, env=environment,
                           timeout=300)
    assert ended.returncode == 0, ended.stderr[-3000:]
    assert ended.stdout.count("vibration-types.md") == 1  # one of them speaks
    for made in sorted((finished / "runs").rglob("*.json")):
        assert (out / made.relative_to(finished)).read_bytes() == made.read_bytes()
    for name in ("vibration-types.json", "vibration-types.md"):
        assert (out / name).read_bytes() == (finished / name).read_bytes()
    for k in range(1, 5):
        assert ended.stderr.count(f"run {k} of 4") == 1  # nobody trained what another had taken


def test_a_killed_table_ends_as_if_nothing_had_happened(finished, data, tmp_path):
    out = tmp_path / "OUT"
    with pytest.raises(Killed):
        run_table("vibration-types", data, "smoke", out, device="cpu", progress=Killer())
    assert len(list((out / "runs").rglob("*.json"))) == 1 and not (out / "vibration-types.json").exists()
    assert len(list((out / "training").rglob("checkpoint.pt"))) == 1
    for run in (finished / "runs").glob("*collision*"):  # as if another table had made them
        shutil.copytree(run, out / "runs" / run.name)
    run_table("vibration-types", data, "smoke", out, device="cpu")
    for name in ("vibration-types.json", "vibration-types.md"):
        assert (out / name).read_bytes() == (finished / name).read_bytes()


def test_another_plan_and_damaged_results_are_noticed(finished, data, tmp_path, monkeypatch, capsys):
    out = tmp_path / "OUT"
    shutil.copytree(finished, out)
    table = (out / "vibration-types.json").read_bytes()
    part = out / "runs" / "af-sfmlearner_vision_vibration-types-peristalsis_seed-0" / "clean.json"
    with monkeypatch.context() as patch:
        patch.setitem(BUDGETS, "smoke", replace(BUDGETS["smoke"], width=0.25, test_frames=4))
        assert main(command(data, out)) == 3
        complaint = last_line(capsys)
        assert "test_frames, training.method.width" in complaint and "another --out" in complaint
    with monkeypatch.context() as patch:  # how often a training is validated changes no weight
        patch.setattr("learned.benchmark.budgets.FEWEST_STEPS_TO_VALIDATE", 1)
        assert main(command(data, out)) == 0
        assert (out / "vibration-types.json").read_bytes() == table
    capsys.readouterr()
    for text, what in (("{", "cannot be read; delete it"), (json.dumps(json.loads(part.read_text()) | {"schema": 9}),
                                                          "has schema 9")):
        part.write_text(text)
        assert main(command(data, out)) == 3
        assert what in last_line(capsys)
    assert (out / "vibration-types.json").read_bytes() == table


def test_data_that_are_missing_or_changed_are_refused_in_one_line(data, tmp_path, capsys):
    copy, out = tmp_path / "DATA", tmp_path / "OUT"

    def refused() -> str:
        assert main(command(copy, out)) == 3
        assert not list(out.rglob("*.json"))
        return last_line(capsys)

    assert "does not exist; write it with `capsule-vio simulate --dataset" in refused()
    shutil.copytree(data, copy)
    manifest = (copy / "manifest.json").read_text()
    image = next((copy / KINDS[1] / "test" / "02" / "mav0" / "cam0" / "data").iterdir())
    image.write_bytes(image.read_bytes()[:-1])
    assert f"{KINDS[1]}/test/02 is not what manifest.json says" in refused()
    shutil.rmtree(copy / KINDS[1] / "train" / "00")
    assert f"{KINDS[1]}/train/00 is missing" in refused()
    entries = json.loads(manifest)
    entries["sequences"] = [e for e in entries["sequences"] if "peristalsis/test" not in e["path"]]
    for text, what in ((json.dumps(entries), f"no sequence in {KINDS[0]}/test"), ("{}", "damaged"), ("[", "damaged"),
                       (json.dumps(json.loads(manifest) | {"schema": 2}), "has schema 2")):
        (copy / "manifest.json").write_text(text)
        assert what in refused()
    (copy / "manifest.json").unlink()
    assert "not complete" in refused()
    with pytest.raises(BenchmarkError, match="no sequence of vibration level 1 in mm-wce-1/train"):
        (copy / "manifest.json").write_text(manifest.replace(KINDS[0], "mm-wce-1").replace(KINDS[1], "mm-wce-2"))
        run_table("intensity", copy, "smoke", out)


def test_wrong_wishes_are_refused(data, tmp_path, capsys):
    assert main(command(data, tmp_path / "OUT", "--seeds", "0")) == 3
    assert "at least 1" in last_line(capsys)
    (tmp_path / "FILE").write_text("")
    assert main(command(data, tmp_path / "FILE")) == 3
    assert "choose another --out" in last_line(capsys)
    for wrong in ({"table": "colours"}, {"method": "sift"}):
        with pytest.raises(BenchmarkError, match="is unknown, choose one of"):
            run_table(**{"table": "fusion", "data": data, "budget": "smoke", "out": tmp_path / "OUT"} | wrong)
    with pytest.raises(ConfigError, match="'huge' is unknown"):
        budget_of("huge")


def last_line(capsys) -> str:
    lines = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("…")]
    assert len(lines) == 1, lines
    return lines[0]


def test_plans_are_the_papers():
    sizes = {name: (len(plan_table(name).variants), len(plan_table(name).lines)) for name in TABLES}
    assert sizes == {"methods": (20, 20), "intensity": (10, 10), "vibration-types": (4, 4), "fusion": (8, 8),
                     "corruptions": (2, 2 * (1 + 12 + 5 + 1))}
    assert len(CORRUPTED) == 60 and {v.conditions for v in plan_table("corruptions").variants} == {(CLEAN, *CORRUPTED)}
    assert (TABLES, tuple(BUDGETS)) == (cli_parser.TABLES, cli_parser.BUDGETS)
    assert set(cli_parser.METHODS) == set(METHODS) and set(cli_parser.FUSIONS) == set(STRATEGIES)
    simulated = simulated_plan("mm-wce", 1, 6.0, "mirocam", 64)
    for name in TABLES:
        for variant in plan_table(name).variants:
            for data in variant.sets:
                for part in ("train", "test"):
                    assert any(s.path.startswith(f"{data}/{part}/") and variant.level in (None, s.level)
                               for s in simulated)
    paper = decisions(BUDGETS["full"], "af-sfmlearner", "fourier", 0, [180] * 6)
    assert (paper.learning_rate, paper.batch_size, paper.schedule) == (1e-4, 4, "constant")
    assert paper.steps == 400 * (6 * (144 - 2) // 4)


@pytest.mark.parametrize("method", METHODS)
def test_only_the_vibration_differs_between_what_is_compared(method):
    for name in TABLES:
        plan = plan_table(name, method)
        for comparison in plan.comparisons:
            for a, b in zip(comparison.baselines, comparison.candidates, strict=True):
                one, other = plan.lines[a].variant, plan.lines[b].variant
                assert (one.fusion, other.fusion is None) == (None, False)
                assert replace(other, fusion=None) == one
                for budget in BUDGETS.values():
                    left, right = (train_config_to_dict(decisions(budget, v.method, v.fusion, 3, [40, 50]))
                                   for v in (one, other))
                    left["method"].pop("fusion"), right["method"].pop("fusion")
                    assert (left["method"].pop("vibration"), right["method"].pop("vibration")) == (False, True)
                    assert left == right


def test_corrupted_frames_do_not_depend_on_what_was_read_before(data):
    recording = read_asl(data / KINDS[0] / "test" / "00")
    assert shown(recording, CLEAN) is recording
    for kind in CORRUPTIONS:
        hurt = shown(recording, Condition(kind, 4))
        first = hurt.frame(3)
        hurt.frame(2)
        assert np.array_equal(hurt.frame(3), first) and not np.array_equal(first, recording.frame(3))
        assert np.array_equal(shown(recording, Condition(kind, 4)).frame(3), first)
        assert np.array_equal(hurt.imu.accel_m_s2, recording.imu.accel_m_s2)
    bright = corrupt(recording.frame(3), "brightness", 4, np.random.default_rng(0))  # draws nothing
    assert np.array_equal(shown(recording, Condition("brightness", 4)).frame(3), bright)


def measured(seed: int = 0, pairs: int = 6) -> Measured:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.01, 0.05, (pairs, 8, 9)).astype(np.float32)
    T = se3.exp(np.concatenate([rng.normal(0, 0.1, (pairs, 3)), rng.normal(0, 0.003, (pairs, 3))], 1))
    return Measured("one", np.zeros((pairs, 8, 9, 3), np.uint8), np.ones((8, 9), bool), depth.copy(), depth, T.copy(),
                    T, None, np.zeros((pairs, 8)), np.full(pairs, 1 / 3),
                    Camera("pinhole", 9, 8, 8.0, 8.0, 4.0, 3.5, (0.0,) * 4))


def test_scores_forgive_scale_and_nothing_else():
    true = measured()
    scaled = true.T_i_j.copy()
    scaled[:, :3, 3] *= 7
    perfect = scores(replace(true, depth=true.depth * 30, T_i_j=scaled), true.usable)
    assert perfect.pop("acc_percent") == 100 and max(perfect.values()) < 1e-4
    turned = replace(true, T_i_j=true.T_i_j @ se3.exp([0.02, 0, 0, 0, 0, 0]))
    assert np.isclose(scores(turned, true.usable)["r_error_deg"], np.degrees(0.02))
    half = np.zeros_like(true.usable)
    half[:4] = True
    spoiled = replace(true, depth=np.where(half, true.depth, 1).astype(np.float32))
    assert scores(spoiled, half)["abs_rel"] < 1e-6 < scores(spoiled, true.usable)["abs_rel"]
    rest = scores(guess(true), true.usable)
    steps = np.linalg.norm(true.T_true_m[:, :3, 3], axis=1)
    middle = np.median(true.depth_true_m, axis=(1, 2))[:, None, None]
    assert np.isclose(rest["ate_paper_mm"], 1e3 * steps.mean()) and rest["ate_sim3_mm"] is None
    assert np.isclose(rest["abs_rel"], np.mean(np.abs(middle / true.depth_true_m - 1)), rtol=1e-5)
    with pytest.raises(BenchmarkError, match="no true depth"):
        scores(replace(true, depth_true_m=None), true.usable)
    with pytest.raises(BenchmarkError, match="no pixel"):
        scores(true, np.zeros_like(true.usable))
