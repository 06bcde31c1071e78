"""Comparisons are fair: the same frames for all, the same alignment, and a loss is called a loss."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion import Provenance, RefineConfig, compare, compare_paths, format_table, write_comparison, write_run
from vio import se3
from vio.errors import FormatError, OutputError, TrajectoryError
from vio.formats.tum import write_tum
from vio.metrics import ate
from vio.trajectory import Trajectory


def track(n=60, dt_s=1 / 3, noise_m=0.0, seed=0, start_s=0.0):
    u = np.linspace(0, 1, n)
    p = np.column_stack([np.sin(5 * u), np.cos(3 * u), u**2]) * 0.1
    p += np.random.default_rng(seed).normal(0, 1, p.shape) * noise_m
    return Trajectory(start_s + np.arange(n) * dt_s, se3.transform(se3.so3_exp(np.outer(u, [0.3, 1.0, -0.5])), p))


TRUTH = track()


def part(trajectory, frames):
    return trajectory.select(np.asarray(frames))


# ---- the same frames -------------------------------------------------------------------------

def test_all_are_judged_on_the_frames_that_all_share():
    """One estimate is perfect but short, the other is bad only where the first has no frames."""
    spoiled = TRUTH.T_world_body.copy()
    spoiled[40:, 0, 3] += 1.0
    estimates = {"short": part(TRUTH, range(40)), "long": Trajectory(TRUTH.t_s, spoiled), "sparse":
                 part(TRUTH, range(0, 60, 2))}
    result = compare(estimates, TRUTH, [])
    assert result.frames == 20 and result.truth_frames == 60
    for row in result.rows.values():
        assert {row[mode]["matched"] for mode in ("none", "origin", "yaw4", "se3", "sim3")} == {20}
        assert row["none"]["ate_rmse_m"] < 1e-12
    alone = compare({"long": estimates["long"]}, TRUTH, [])
    assert alone.frames == 60 and alone.rows["long"]["none"]["ate_rmse_m"] > 0.5


@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1))
def test_order_and_company_do_not_change_a_row_on_the_same_frames(seed):
    rng = np.random.default_rng(seed)
    shared = np.sort(rng.choice(60, 20, replace=False))
    a, b = (part(track(noise_m=1e-3, seed=seed % 1000 + k), np.union1d(shared, rng.choice(60, 5))) for k in (0, 1))
    frames = np.intersect1d(a.t_s, b.t_s)
    forward, backward = compare({"a": a, "b": b}, TRUTH, []), compare({"b": b, "a": a}, TRUTH, [])
    assert forward.frames == backward.frames == len(frames)
    assert forward.rows == {name: backward.rows[name] for name in ("a", "b")}
    for name, estimate in (("a", a), ("b", b)):
        ours = estimate.select(np.isin(estimate.t_s, frames))
        reference = TRUTH.select(np.isin(TRUTH.t_s, frames))
        assert forward.rows[name]["se3"]["ate_rmse_m"] == pytest.approx(ate(ours, reference, "se3").rmse_m)


def test_truth_of_a_motion_capture_keeps_its_own_clock():
    """Truth at 100 Hz, whose stamps are never the frames': each frame meets the nearest."""
    truth = track(6000, 20 / 6000)
    rng = np.random.default_rng(0)
    near = {name: np.sort(rng.choice(np.arange(0, 5990, 100), 50, replace=False)) for name in ("a", "b")}
    estimates = {name: Trajectory(truth.t_s[k] + 0.0011 + 1e-4 * rng.random(), truth.T_world_body[k])
                 for name, k in near.items()}
    result = compare(estimates, truth, [])
    assert result.frames == len(np.intersect1d(near["a"], near["b"])) and result.truth_frames == 6000
    for row in result.rows.values():
        assert row["none"]["ate_rmse_m"] < 1e-12


def test_estimates_that_share_no_frame_cannot_be_compared():
    with pytest.raises(TrajectoryError, match="no frame is shared by all trajectories and the truth; check their clo"):
        compare({"a": part(TRUTH, range(20)), "b": part(TRUTH, range(30, 60))}, TRUTH, [])
    with pytest.raises(TrajectoryError, match="matched 0 of 60") as caught:
        compare({"a": Trajectory(TRUTH.t_s + 1e9, TRUTH.T_world_body)}, TRUTH, [])
    assert "one clock" in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(TrajectoryError, match="no frame is shared"):
        compare({}, TRUTH, [])


# ---- the verdict -----------------------------------------------------------------------------

def test_the_verdict_names_the_better_one():
    good, bad = track(noise_m=1e-4, seed=1), track(noise_m=1e-3, seed=2)
    a, b = (ate(x, TRUTH, "se3").rmse_m for x in (good, bad))
    won, = compare({"chain": bad, "graph": good}, TRUTH, [("chain", "graph")]).verdicts
    assert won.startswith("graph beats chain: ATE ") and f"{1e3 * a:.2f} mm against {1e3 * b:.2f} mm" in won
    assert f"({a / b:.2f} of the error is left)" in won and "SE3-aligned" in won
    lost, = compare({"chain": good, "graph": bad}, TRUTH, [("chain", "graph")]).verdicts
    assert lost.startswith("graph LOSES to chain: ATE ") and f"({b / a:.2f} times the error)" in lost


@pytest.mark.parametrize("estimate", [TRUTH, track(noise_m=1e-3)], ids=["perfect", "noisy"])
def test_equal_neither_wins_nor_loses(estimate):
    """A run that fell back to its motions alone."""
    verdict, = compare({"chain": estimate, "graph": estimate}, TRUTH, [("chain", "graph")]).verdicts
    assert verdict.startswith("graph ties with chain: ATE ")


@pytest.mark.parametrize(("T", "why"), [
    (np.tile(np.eye(4), (60, 1, 1)), "motionless"),
    (se3.transform(np.eye(3), np.outer(np.arange(60.0), [0.001, 0.002, 0.0])), "straight line"),
])
def test_what_is_degenerate_is_unavailable_with_its_reason(T, why):
    truth = Trajectory(TRUTH.t_s, T)
    result = compare({"chain": truth, "graph": truth}, truth, [("chain", "graph")])
    row = result.rows["graph"]
    assert why in row["se3"]["unavailable"] and why in row["sim3"]["unavailable"]
    assert row["origin"]["ate_rmse_m"] == pytest.approx(0, abs=1e-12)  # what needs no alignment is still there
    verdict, = result.verdicts
    assert verdict.startswith("graph against chain: no verdict, ") and why in verdict
    table = format_table(result)
    assert table.count("unavailable") >= 2 and "nan" not in table.lower()
    json.dumps(result.to_dict(), allow_nan=False)


def test_the_table_shows_every_alignment_and_how_much_was_matched():
    table = format_table(compare({"chain": track(noise_m=1e-3), "x": part(TRUTH, range(50))}, TRUTH, []))
    lines = table.splitlines()
    for title in ("ATE none", "ATE origin", "ATE yaw4", "ATE SE3", "ATE Sim3", "scale error"):
        assert title in lines[0]
    assert lines[1].startswith("chain") and lines[2].startswith("x") and " mm" in lines[1]
    assert lines[3].startswith("50 of 60 frames matched")


def test_chance_is_not_called_a_victory():
    a, b = track(noise_m=1e-3, seed=1), track(noise_m=1e-3, seed=4)
    result = compare({"chain": a, "graph": b}, TRUTH, [("chain", "graph")])
    found = result.differences[0].under["se3"]
    assert found.low_m < 0 < found.high_m and not found.significant
    assert result.verdicts[0].startswith("graph does not differ significantly from chain: ATE ")
    assert f"95 % interval {1e3 * found.low_m:+.2f} to {1e3 * found.high_m:+.2f} mm" in result.verdicts[0]


def test_of_many_the_best_is_named_with_its_lead_over_the_next():
    tracks = {name: track(noise_m=noise, seed=k) for k, (name, noise) in
              enumerate((("a", 1e-3), ("b", 1e-4), ("c", 5e-4)))}
    result = compare(tracks, TRUTH, [])
    sentence, = result.verdicts
    b, c = (1e3 * ate(tracks[name], TRUTH, "se3").rmse_m for name in "bc")
    assert sentence.startswith(f"of 3: b wins, next is c: ATE {b:.2f} mm against {c:.2f} mm, SE3-aligned; difference ")
    assert result.differences[0].under["se3"].difference_m * 1e3 == pytest.approx(b - c)
    assert set(result.differences[0].under) == {"none", "origin", "yaw4", "se3", "sim3"}


# ---- from files ------------------------------------------------------------------------------

@pytest.fixture(scope="module")
def runs(refined, tmp_path_factory):
    """Two run folders of one recording: the second's estimators have changed places, so that refinement loses."""
    folder = tmp_path_factory.mktemp("compare")
    provenance = Provenance(["refine"], RefineConfig(), {})
    write_run(refined, folder / "good", provenance)
    swapped = replace(refined, motions_only=refined.trajectory,
                      trajectory=replace(refined.motions_only, cov=refined.trajectory.cov))
    write_run(swapped, folder / "bad", provenance)
    return folder


def test_a_run_that_loses_is_told_so(runs, refined):
    result = compare_paths([runs / "good", runs / "bad"], None)
    assert list(result.rows) == ["good: motions only", "good: refined", "bad: motions only", "bad: refined"]
    assert result.frames == 300
    good, bad, best = result.verdicts
    assert good.startswith("good: refined beats good: motions only")
    assert bad.startswith("bad: refined LOSES to bad: motions only")
    assert best.startswith("of 4: bad: motions only and good: refined tie") or "good: refined and bad: motions" in best
    expected = ate(refined.trajectory, refined.truth, "se3").rmse_m
    assert result.rows["good: refined"]["se3"]["ate_rmse_m"] == pytest.approx(expected, rel=1e-6)


def test_files_and_runs_stand_side_by_side(runs, refined, tmp_path):
    write_tum(part(refined.truth, range(100, 200)), tmp_path / "truth.tum")
    (tmp_path / "other").mkdir()
    for name in ("orb.tum", "other/orb.tum"):
        write_tum(refined.truth, tmp_path / name)
    paths = [tmp_path / "orb.tum", tmp_path / "other" / "orb.tum", runs / "good", runs / "good"]
    result = compare_paths(paths, tmp_path / "truth.tum")
    assert result.frames == result.truth_frames == 100
    assert len(result.rows) == 6 and {"orb", "orb (2)"} <= set(result.rows)
    assert result.rows["orb"]["none"]["ate_rmse_m"] < 1e-9
    assert len(result.verdicts) == 3 and result.verdicts[2].startswith("of 6: orb and orb (2) tie for the first")


def test_without_any_truth_the_remedy_is_named(runs, refined, tmp_path):
    write_tum(refined.trajectory, tmp_path / "a.tum")
    with pytest.raises(TrajectoryError, match=r"compare: no truth; give --truth traj\.tum"):
        compare_paths([tmp_path / "a.tum"], None)
    with pytest.raises(FormatError, match=r"no summary\.json"):
        compare_paths([tmp_path], None)


def test_what_is_written_gives_evo_the_same_numbers(runs, refined, tmp_path):
    """evo reads the exports, aligns them itself, and finds the table's figures."""
    from evo.core import metrics, trajectory
    from evo.tools import file_interface

    write_tum(part(refined.motions_only, range(10, 250)), tmp_path / "=1+1 <b>.tum")
    comparison = compare_paths([runs / "good", tmp_path / "=1+1 <b>.tum"], None)
    folder = write_comparison(comparison, tmp_path / "OUT")
    content = json.loads((folder / "comparison.json").read_text())
    assert (folder / "table.txt").read_text() == format_table(comparison) + "\n"
    assert set(content["files"]) == set(comparison.rows) and len(list(folder.iterdir())) == 2 + 1 + 3
    for name, files in content["files"].items():
        assert re.fullmatch(r"[A-Za-z0-9._-]+\.tum", files["estimate"])
        truth = file_interface.read_tum_trajectory_file(folder / files["truth"])
        for mode, correct_scale in (("se3", False), ("sim3", True)):
            estimate = file_interface.read_tum_trajectory_file(folder / files["estimate"])
            estimate.align(truth, correct_scale=correct_scale)
            ape = metrics.APE(metrics.PoseRelation.translation_part)
            ape.process_data((truth, estimate))
            assert isinstance(truth, trajectory.PoseTrajectory3D) and truth.num_poses == 240
            assert ape.get_statistic(metrics.StatisticsType.rmse) == pytest.approx(
                content["accuracy"][name][mode]["ate_rmse_m"], rel=1e-6)
    write_comparison(comparison, folder)  # ours: replaced
    with pytest.raises(OutputError, match="choose another --out"):
        write_comparison(comparison, runs)


def moved(refined, metres):
    """An examination with another truth: everything lies somewhere else."""
    away = se3.transform(np.eye(3), [metres, 0, metres])
    shift = {name: replace(getattr(refined, name), T_world_body=away @ getattr(refined, name).T_world_body)
             for name in ("trajectory", "motions_only", "truth")}
    return replace(refined, **shift)


def test_runs_of_several_recordings_are_judged_by_their_own_truth(runs, refined, tmp_path):
    for k in range(5):
        write_run(moved(refined, 0.1 * k), tmp_path / f"run{k}", Provenance(["refine"], RefineConfig(), {}))
    folders = [tmp_path / f"run{k}" for k in range(5)]
    result = compare_paths(folders, None)
    own = ate(refined.trajectory, refined.truth, "none").rmse_m
    for k in range(5):
        assert result.rows[f"run{k}: refined"]["none"]["ate_rmse_m"] == pytest.approx(own, rel=1e-6)
    assert result.over.better == result.over.recordings == 5 and result.over.high < 1
    assert result.verdicts[-1].startswith("over 5 recordings: refined leaves 0.")
    assert result.frames == 5 * 300
    few = compare_paths(folders[:2], None)
    assert few.over.low is None and "5 recordings are needed for an interval" in few.verdicts[-1]
    files = json.loads((write_comparison(few, tmp_path / "OUT") / "comparison.json").read_text())["files"]
    assert {entry["truth"] for entry in files.values()} == {"truth.tum", "truth_2.tum"}
    write_tum(refined.trajectory, tmp_path / "a.tum")
    with pytest.raises(TrajectoryError, match="2 recordings, and a does not say of which one"):
        compare_paths([*folders[:2], tmp_path / "a.tum"], None)
