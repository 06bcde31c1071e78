"""Loops: those that are true save error, none that is false survives, and without any nothing changes."""

import json
from dataclasses import replace

import numpy as np
import pytest

from fusion import Provenance, RefineConfig, refine, summarize, write_run
from fusion.cli import main
from fusion.loops import IMPOSSIBLE
from fusion.summary import sentences
from vio import se3
from vio.consistency import nees
from vio.errors import MotionsError
from vio.formats.asl import write_asl
from vio.loops import Loops, load_loops
from vio.metrics import ate
from vio.motions import RelativeMotions

TURN_SD, SHIFT_SD_M = 0.01, 4e-4
LATE = 140
WORDS = {"hardly a detail of one frame was found in the other": 88}


@pytest.fixture(scope="module")
def there_and_back(examine):
    """150 frames."""
    return examine("small-bowel", "gaussian", 3, 50.0, 211, driving="withdrawn")


@pytest.fixture(scope="module")
def alone(there_and_back):
    return refine(there_and_back.recording, there_and_back.motions)


def true_loops(made, count, seed, wrong=()):
    """Loops between the way there and the way back with honest noise; those in `wrong` are those of another place."""
    recording, motions = made.recording, made.motions
    rng = np.random.default_rng(seed)
    T = recording.truth_at_frames().T_world_body @ recording.calibration.T_body_camera
    unit_m = np.exp(float(np.mean(made.network.true_log_scale)))
    sd = np.repeat([TURN_SD, SHIFT_SD_M / unit_m], 3)
    i = np.linspace(3, 60, count).astype(int)
    j = len(T) - 1 - i
    true = se3.inverse(T[i]) @ T[j]
    true[:, :3, 3] /= unit_m
    found = true @ se3.exp(rng.standard_normal((count, 6)) * sd)
    for n, size in wrong:
        found[n] = found[n] @ se3.exp(size * np.array([0.4, -0.2, 0.3, 1.0, -0.5, 0.8]))
    t = recording.frame_t_s
    cov = np.broadcast_to(np.diag(sd**2), (count, 6, 6))
    return Loops(RelativeMotions(t[i], t[j], found, cov, motions.scale_log_mean, motions.scale_log_sd), 100, WORDS)


def ends_apart(T_world_body, T_world_body_true, loops):
    """Error [m, rms] of the positions of the loops' later ends in the bodies at their earlier ends."""
    i, j = loops.frames[loops.accepted].T
    found, true = (se3.inverse(T[i]) @ T[j] for T in (T_world_body, T_world_body_true))
    return np.sqrt(np.mean(np.sum((found - true)[:, :3, 3] ** 2, axis=1)))


def test_true_loops_save_error_and_stay_honest(there_and_back, alone):
    truth = there_and_back.recording.truth_at_frames()
    closed = refine(there_and_back.recording, there_and_back.motions, loops=true_loops(there_and_back, 12, 1))
    assert closed.loops.accepted.sum() >= 11
    assert ate(closed.trajectory, truth).rmse_m < ate(alone.trajectory, truth).rmse_m
    saved, lost = (ends_apart(r.trajectory.T_world_body, truth.T_world_body, closed.loops) for r in (closed, alone))
    assert saved < 0.85 * lost  # 1.0 mm without; a loop alone is good for 0.7
    before, after = (np.trace(r.trajectory.cov[LATE][3:, 3:]) for r in (alone, closed))
    assert after < 0.5 * before
    assert np.nanmean(nees(closed.trajectory, truth)) < 3.0
    drawn = closed.joint.position_errors(closed.trajectory.T_world_body[:, :3, :3], np.array([LATE]))[:, 0]
    claimed = closed.trajectory.T_world_body[LATE, :3, :3]
    claimed = claimed @ closed.trajectory.cov[LATE][3:, 3:] @ claimed.T
    assert np.trace(np.cov(drawn.T)) == pytest.approx(np.trace(claimed), rel=0.4)


@pytest.fixture(scope="module")
def clean(there_and_back):
    return refine(there_and_back.recording, there_and_back.motions, loops=true_loops(there_and_back, 10, 2))


@pytest.mark.parametrize("size", [0.3, 2.0])
def test_false_loops_are_dropped_and_change_nothing(there_and_back, clean, size):
    """From some centimetres to another part of the gut."""
    recording, motions = there_and_back.recording, there_and_back.motions
    wrong = [(2, size), (7, -size)]
    closed = refine(recording, motions, loops=true_loops(there_and_back, 10, 2, wrong))
    off = np.linalg.norm(closed.trajectory.T_world_body[:, :3, 3] - clean.trajectory.T_world_body[:, :3, 3], axis=1)
    assert not closed.loops.accepted[[2, 7]].any()
    assert off.max() < 1.5e-3
    assert closed.loops.accepted.sum() >= 6
    accepted, refused = int(closed.loops.accepted.sum()), sum(closed.loops.refused.values())
    assert accepted + refused == 10 + sum(WORDS.values())


def test_only_false_loops_leave_the_trajectory_as_it_was(there_and_back, alone):
    wrong = true_loops(there_and_back, 3, 3, [(0, 2.0), (1, 3.0), (2, -2.0)])
    closed = refine(there_and_back.recording, there_and_back.motions, loops=wrong)
    assert not closed.loops.accepted.any() and closed.loops.refused[IMPOSSIBLE] == 3
    np.testing.assert_array_equal(closed.trajectory.T_world_body, alone.trajectory.T_world_body)
    np.testing.assert_array_equal(closed.trajectory.cov, alone.trajectory.cov)


def test_another_unit_is_the_same_loop(there_and_back):
    recording, motions = there_and_back.recording, there_and_back.motions
    loops = true_loops(there_and_back, 8, 4)
    m, unit = loops.motions, np.repeat([1.0, 5.0], 3)
    T = m.T_i_j.copy()
    T[:, :3, 3] *= 5.0
    other = replace(m, T_i_j=T, cov=m.cov * unit[:, None] * unit, scale_log_mean=m.scale_log_mean - np.log(5.0))
    a, b = (refine(recording, motions, loops=given) for given in (loops, replace(loops, motions=other)))
    np.testing.assert_allclose(a.trajectory.T_world_body, b.trajectory.T_world_body, atol=1e-6)


def test_loops_need_the_graph_and_say_so(there_and_back, configured):
    loops = true_loops(there_and_back, 4, 5)
    refined = refine(there_and_back.recording, there_and_back.motions, configured(estimator="ekf"), loops=loops)
    assert refined.estimator == "ekf" and not refined.loops.accepted.any()
    assert refined.loops.refused["only the graph can use it"] == 4


def test_the_run_folder_and_the_command_line_tell_of_loops(there_and_back, tmp_path, capsys):
    loops = true_loops(there_and_back, 6, 6)
    loops.save(tmp_path / "loops.npz")
    there_and_back.motions.save(tmp_path / "motions.npz")
    write_asl(there_and_back.recording, tmp_path / "REC")
    out = tmp_path / "RUN"
    assert main(["refine", str(tmp_path / "REC"), "--motions", str(tmp_path / "motions.npz"), "--loops-from",
                 str(tmp_path / "loops.npz"), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    summary = json.loads((out / "summary.json").read_text())
    count = summary["loops"]["accepted"]
    assert summary["loops"]["proposed"] == 100 and count >= 5 and summary["loops"]["refused"] | WORDS == \
        summary["loops"]["refused"]
    assert f"loops: {count} of 100 pairs" in said and "88 not, hardly a detail" in said
    assert f"{count} of 100 pairs" in (out / "report.html").read_text()
    rows = (out / "loops.csv").read_text().splitlines()
    assert rows[0] == "frame_i,frame_j,t_i_s,t_j_s,distance2,accepted" and len(rows) == 7
    assert sum(int(row.split(",")[-1]) for row in rows[1:]) == count
    assert main(["refine", str(tmp_path / "REC"), "--motions", str(tmp_path / "motions.npz"), "--loops-from",
                 str(tmp_path / "loops.npz"), "--online", "--out", str(out)]) == 2
    assert main(["refine", str(tmp_path / "REC"), "--motions", str(tmp_path / "motions.npz"), "--loops",
                 "--out", str(tmp_path / "OTHER")]) == 3
    assert "images are missing" in capsys.readouterr().err


def test_without_loops_none_are_mentioned(alone, tmp_path):
    write_run(alone, tmp_path / "RUN", Provenance(["refine"], RefineConfig(), {}))
    assert summarize(alone)["loops"] == {"proposed": 0, "accepted": 0, "refused": {}}
    assert not (tmp_path / "RUN" / "loops.csv").exists() and "loops" not in sentences(summarize(alone))


def test_files_of_loops(there_and_back, tmp_path):
    loops, path = true_loops(there_and_back, 3, 7), tmp_path / "loops.npz"
    loops.save(path)
    back = load_loops(path)
    np.testing.assert_allclose(back.motions.T_i_j, loops.motions.T_i_j, atol=1e-14)
    assert (back.proposed, dict(back.refused)) == (100, WORDS)
    Loops(None, 5).save(path)
    assert len(load_loops(path)) == 0 and load_loops(path).proposed == 5
    late = replace(loops.motions, t_j_s=loops.motions.t_j_s + 0.1)
    with pytest.raises(MotionsError, match="another recording"):
        refine(there_and_back.recording, there_and_back.motions, loops=replace(loops, motions=late))
    path.write_bytes(b"no loops")
    with pytest.raises(MotionsError, match="predict --loops"):
        load_loops(path)
    with pytest.raises(MotionsError, match=r"nowhere\.npz: cannot be read"):
        load_loops(tmp_path / "nowhere.npz")
