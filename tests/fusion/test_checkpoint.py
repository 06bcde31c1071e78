"""Killed for real, at several stages, and started again: the same bytes, and nothing computed twice."""

import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fusion import refine
from fusion.chain_engine import ChainEngine
from fusion.checkpoint import Checkpoint, refinement_key, unfinished
from fusion.cli import main
from vio.errors import EstimationError, OutputError
from vio.formats.asl import write_asl

ROOT = Path(__file__).resolve().parents[2]
SAME = ("trajectory.tum", "trajectory.npz", "motions_only.tum")


@pytest.fixture(scope="module")
def made(examine, tmp_path_factory):
    """A recording on disk, its motions, and an uninterrupted run."""
    examination = examine("small-bowel", "gaussian", 2, 400.0, 231)
    folder = tmp_path_factory.mktemp("killed")
    write_asl(examination.recording, folder / "REC")
    examination.motions.save(folder / "motions.npz")
    assert main(["refine", str(folder / "REC"), "--motions", str(folder / "motions.npz"), "--out",
                 str(folder / "whole")]) == 0
    assert not (folder / ".whole.unfinished").exists()
    return folder


def killed_at(stage, folder, out):
    """Run the command in a process of its own and kill it when it announces a stage."""
    command = [sys.executable, "-m", "fusion.cli", "refine", str(folder / "REC"), "--motions",
               str(folder / "motions.npz"), "--out", str(out)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment, cwd=ROOT) as process:
        for line in process.stderr:
            if line.startswith(f"… {stage}"):
                os.kill(process.pid, signal.SIGKILL)
                break
        process.stderr.read()
        assert process.wait() == -signal.SIGKILL
    return command, environment


@pytest.mark.parametrize("stage, finished", [("fixed scale", 1), ("covariances", 3)])
def test_a_killed_refinement_ends_with_the_same_bytes(made, tmp_path, stage, finished):
    command, environment = killed_at(stage, made, tmp_path / "RUN")
    kept = tmp_path / ".RUN.unfinished" / "graph"
    names = sorted(file.name for file in kept.glob("[0-9]*.npz"))
    assert len(names) >= finished and names[0] == "01_begin.npz" and not (tmp_path / "RUN").exists()
    subprocess.run(command, check=True, env=environment, cwd=ROOT, capture_output=True)
    for name in SAME:
        assert (tmp_path / "RUN" / name).read_bytes() == (made / "whole" / name).read_bytes(), name
    assert [path.name for path in tmp_path.iterdir()] == ["RUN"]


def test_finished_stages_are_not_computed_again(examination, tmp_path, monkeypatch):
    first = refine(examination.recording, examination.motions, resume=tmp_path / "kept")

    def refuse(*_):
        raise AssertionError("computed again")

    for name in ("begin", "solve", "uncertainty"):
        monkeypatch.setattr(ChainEngine, name, refuse)
    again = refine(examination.recording, examination.motions, resume=tmp_path / "kept")
    np.testing.assert_array_equal(first.trajectory.T_world_body, again.trajectory.T_world_body)
    np.testing.assert_array_equal(first.trajectory.cov, again.trajectory.cov)
    np.testing.assert_array_equal(first.joint.xi, again.joint.xi)
    assert (first.scale, first.imu) == (again.scale, again.imu)


def test_what_was_made_from_other_input_or_is_damaged_is_not_used(examination, configured, tmp_path):
    refine(examination.recording, examination.motions, resume=tmp_path)
    other = replace(examination.motions, cov=1.5 * examination.motions.cov)
    plain, resumed = (refine(examination.recording, other, resume=folder) for folder in (None, tmp_path))
    np.testing.assert_array_equal(plain.trajectory.cov, resumed.trajectory.cov)
    last = max(tmp_path.glob("[0-9]*.npz"))
    last.write_bytes(last.read_bytes()[:1000])
    again = refine(examination.recording, other, resume=tmp_path)
    np.testing.assert_array_equal(plain.trajectory.cov, again.trajectory.cov)
    key = refinement_key(examination.recording, other, configured())
    assert key != refinement_key(examination.recording, examination.motions, configured())
    assert key != refinement_key(examination.recording, other, configured(estimator="graph"))


def test_a_folder_of_somebody_elses_is_left_alone(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(OutputError, match="holds no unfinished run"):
        Checkpoint(tmp_path, "key")
    assert (tmp_path / "thesis.txt").read_text() == "mine"


def test_what_will_fail_again_is_not_kept_but_an_interruption_is(tmp_path):
    for error, left in ((EstimationError("x"), False), (KeyboardInterrupt(), True)):
        with pytest.raises(type(error)), unfinished(tmp_path / "RUN") as kept:
            Checkpoint(kept / "graph", "key").save("01_begin", {"a": np.ones(3)})
            raise error
        assert (tmp_path / ".RUN.unfinished").exists() is left
