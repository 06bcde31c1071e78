"""Lesions on a trajectory: where they are, how sure that is, and what is not known."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.simulated_lesions import SimulatedLesion
from fusion import Provenance, Sighting, locate, write_lesions, write_run
from fusion.config import RefineConfig
from fusion.lesions.fixes import PIXEL_SD, DepthSource, Fix, place_sighting, pose_and_scale_covariance
from fusion.lesions.merging import merge
from fusion.lesions.table import COLUMNS
from vio import se3
from vio.depth_folder import read_depth_folder
from vio.errors import CalibrationError, FormatError

SD = 0.10


@pytest.fixture(scope="session")
def run(case, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "RUN"
    write_run(case.refined, out, Provenance(["refine"], RefineConfig(), {}))
    return out


# ---- where they are --------------------------------------------------------------------------

def test_intervals_hold_the_truth_and_are_worth_having(case):
    found = case.locate()
    assert len(found) == 10
    inside = [found[str(k)].arc_m.low <= lesion.arc_m <= found[str(k)].arc_m.high
              for k, lesion in enumerate(case.lesions)]
    path = np.ptp([lesion.arc_m for lesion in case.lesions])
    assert sum(inside) >= 8
    for k, lesion in enumerate(case.lesions):
        assert abs(found[str(k)].arc_m.value - lesion.arc_m) < 0.04 * path
        assert found[str(k)].arc_m.high - found[str(k)].arc_m.low < 0.15 * path


def test_covariance_to_first_order_is_what_sampling_finds(case):
    """Drawn pose, scale, depth and pixel through the exact map: nothing linearised, nothing of ours but the camera."""
    lesion, view = case.lesions[6], case.refined.view
    sighting = Sighting("x", "finding", lesion.frame, None, lesion.pixel, "x")
    source = DepthSource(read_depth_folder(case.depth, case.recording), None, SD)
    fix = place_sighting(case.refined, sighting, lesion.frame, view, source)
    rng, n = np.random.default_rng(1), 40_000
    drawn = rng.multivariate_normal(np.zeros(7), pose_and_scale_covariance(case.refined, lesion.frame), n)
    T = case.refined.trajectory.T_world_body[lesion.frame] @ se3.exp(drawn[:, :6])
    rays = view.camera.unproject(np.array(lesion.pixel) + PIXEL_SD * rng.standard_normal((n, 2)))
    body = np.linalg.solve(case.refined.trajectory.T_world_body[lesion.frame], np.r_[fix.point_m, 1])[:3]
    z = (view.T_body_camera[:3, :3].T @ (body - view.T_body_camera[:3, 3]))[2]
    depth = z * np.exp(drawn[:, 6] + SD * rng.standard_normal(n))
    camera = rays / rays[:, 2:] * depth[:, None]
    x = camera @ view.T_body_camera[:3, :3].T + view.T_body_camera[:3, 3]
    world = (T[:, :3, :3] @ x[:, :, None])[:, :, 0] + T[:, :3, 3]
    cov = fix.pose_cov + fix.own_cov
    lower = np.linalg.cholesky(cov)
    white = np.linalg.solve(lower, (world - fix.point_m).T)
    np.testing.assert_allclose(white @ white.T / n, np.eye(3), atol=0.08)


def test_sd_maps_beside_predicted_depth_are_believed(case, tmp_path):
    lesion = case.lesions[6]
    sighting = Sighting("x", "finding", lesion.frame, None, lesion.pixel, "x")
    folder = tmp_path / "depth"
    shutil.copytree(case.depth, folder)
    given = place_sighting(case.refined, sighting, lesion.frame, case.refined.view,
                           DepthSource(read_depth_folder(folder, case.recording), None, 0.3))
    (folder / "sd").mkdir()
    for file in (folder / "data").iterdir():
        shape = cv2.imread(str(file), cv2.IMREAD_UNCHANGED).shape
        cv2.imwrite(str(folder / "sd" / file.name), np.full(shape, 3000, np.uint16))
    with (folder / "sensor.yaml").open("a") as sensor:
        sensor.write("log_depth_sd_unit: 0.0001\n")
    found = place_sighting(case.refined, sighting, lesion.frame, case.refined.view,
                           DepthSource(read_depth_folder(folder, case.recording), None, None))
    np.testing.assert_allclose(found.own_cov, given.own_cov, rtol=1e-5)
    (folder / "sensor.yaml").write_text((folder / "sensor.yaml").read_text().replace("0.0001", "-1"))
    with pytest.raises(CalibrationError, match="log_depth_sd_unit is -1"):
        read_depth_folder(folder, case.recording)


def answer(fixes: list[Fix], scales: np.ndarray, t_s: np.ndarray) -> np.ndarray:
    """How a merged place moves per unit when its depth maps are off by such shares of their sd."""
    small = 1e-4
    shifted = [replace(f, point_m=f.point_m + small * e * f.image_m) for f, e in zip(fixes, scales, strict=True)]
    (before,), (after,) = merge(fixes, t_s), merge(shifted, t_s)
    return (after.point_m - before.point_m) / small


@pytest.mark.parametrize(("said", "sd"), [({"image_log_sd": 0.4, "common_log_sd": 0.5}, 0.4),
                                          ({"common_log_sd": 0.5}, 0.5), ("never calibrated", 0.0)])
def test_neighbouring_maps_are_off_by_one_scale_that_no_merging_averages(case, tmp_path, said, sd):
    folder = tmp_path / "depth"
    shutil.copytree(case.depth, folder)
    (folder / "prediction.json").write_text(json.dumps({"depth_uncertainty": said}))
    source = DepthSource(read_depth_folder(folder, case.recording), None, None)
    t_s, R_bc = case.refined.trajectory.t_s, case.refined.view.T_body_camera
    for group in (g for g in case.groups if len(g) > 2):
        rows = [Sighting("x", "finding", seen.frame, None, seen.pixel, "x") for seen in group]
        fixes = [place_sighting(case.refined, row, row.frame, case.refined.view, source) for row in rows]
        eyes = [(case.refined.trajectory.T_world_body[f.index] @ R_bc)[:3, 3] for f in fixes]
        for fix, eye in zip(fixes, eyes, strict=True):
            np.testing.assert_allclose(fix.image_m, sd * (fix.point_m - eye), atol=1e-12)
        (place,) = merge(fixes, t_s)
        added = place.own_cov - place.pixel_cov
        assert np.linalg.eigvalsh(added).min() > -1e-12
        # Oracle: move the fixes as scales that hang together in time would, and see what becomes of their mean.
        apart = 3**0.5 * np.abs(np.subtract.outer(t_s[[f.index for f in fixes]], t_s[[f.index for f in fixes]])) / 2
        moved = np.array([answer(fixes, column, t_s) for column in np.linalg.cholesky((1 + apart) * np.exp(-apart)).T])
        np.testing.assert_allclose(added, moved.T @ moved, rtol=1e-4, atol=1e-12)
        shared = answer(fixes, np.ones(len(fixes)), t_s)
        assert np.trace(added) >= 0.85 * shared @ shared
        # A minute later the maps are off by another scale, and the mean of both is surer.
        late = [replace(f, index=f.index + 180) for f in fixes if f.index + 180 < len(t_s)]
        if len(late) == len(fixes):
            (both,) = merge([*fixes, *late], t_s)
            assert np.trace(both.own_cov) <= np.trace(place.own_cov)


def test_a_prediction_that_says_nonsense_is_refused(case, tmp_path):
    folder = tmp_path / "depth"
    shutil.copytree(case.depth, folder)
    for text, words in (("{", "not valid JSON"), ('{"depth_uncertainty": {"image_log_sd": "x"}}', "image's ln scale")):
        (folder / "prediction.json").write_text(text)
        with pytest.raises(FormatError, match=words):
            read_depth_folder(folder, case.recording)


def test_pose_and_scale_belong_together(case):
    joint = pose_and_scale_covariance(case.refined, 300)
    sd = np.sqrt(np.diag(joint))
    correlation = joint / np.outer(sd, sd)
    np.testing.assert_allclose(joint[:6, :6], case.refined.trajectory.cov[300])
    assert np.linalg.eigvalsh(correlation).min() > -1e-9
    drawn = case.refined.joint
    sampled = np.corrcoef(np.column_stack([drawn.xi[:, 300], drawn.log_scale[:, 300]]).T)
    np.testing.assert_allclose(correlation[6, 3:6], sampled[6, 3:6], atol=0.25)


def test_distances_between_neighbours_are_surer_than_their_places(case):
    """The errors of two poses hang together: what they share is no error of the way between them."""
    found = case.locate(labels={7: "fold"})
    near = found["8"]
    landmark = found["7"]
    width = near.from_landmark_m.high - near.from_landmark_m.low
    apart = np.hypot(near.arc_m.high - near.arc_m.low, landmark.arc_m.high - landmark.arc_m.low)
    assert width < 0.8 * apart
    assert near.from_landmark_m.value == pytest.approx(near.arc_m.value - landmark.arc_m.value)


def test_percent_of_path_and_time_between_landmarks(case):
    found = case.locate(labels={1: "Pylorus", 8: "Ileocecal valve"})
    start, end = case.lesions[1], case.lesions[8]
    for k in range(2, 8):
        lesion, row = case.lesions[k], found[str(k)]
        if row.percent_path is None:
            continue
        assert row.percent_path.value == pytest.approx(
            100 * (lesion.arc_m - start.arc_m) / (end.arc_m - start.arc_m), abs=6)
        t = case.refined.trajectory.t_s
        times = [t[found[name].frame] for name in ("1", str(k), "8")]
        if row.percent_time is not None:
            assert row.percent_time == pytest.approx(100 * (times[1] - times[0]) / (times[2] - times[0]))
    assert found["1"].percent_path == (0, 0, 0) and found["8"].percent_path.value == pytest.approx(100)
    outside = found["0"]
    assert outside.percent_path is None and "before Pylorus" in outside.status
    assert found["9"].percent_path is None and "beyond Ileocecal valve" in found["9"].status


def test_a_run_folder_alone_says_the_same(case, run, tmp_path):
    a = locate(case.refined, case.rows(), depth=case.depth).to_dict()["lesions"]
    b = locate(run, case.rows(), depth=case.depth).to_dict()["lesions"]
    for x, y in zip(a, b, strict=True):
        for key in COLUMNS:
            assert x[key] == (pytest.approx(y[key], rel=1e-4, abs=1e-3) if isinstance(x[key], float) else y[key]), key


def test_the_same_input_gives_the_same_bytes(case, run, tmp_path):
    for name in ("a", "b"):
        write_lesions(locate(run, case.rows(), depth=case.depth), tmp_path / name)
    for file in ("lesions.csv", "lesions.json"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_the_refined_scale_corrects_predicted_depth(case):
    """Depth is metric at the prior scale; where the IMU found another, points move away or nearer by it."""
    shifted = replace(case.refined, log_scale=case.refined.log_scale + 0.2)
    camera = case.refined.trajectory.T_world_body @ case.refined.view.T_body_camera
    for k, row in list(case.locate(merged=False).items())[:3]:
        other = locate(shifted, [r for r in case.rows(False) if r.id == k], depth=case.depth, recording=case.recording)
        eye = camera[row.frame, :3, 3]
        ratio = np.linalg.norm(other.lesions[0].point_m - eye) / np.linalg.norm(row.point_m - eye)
        assert ratio == pytest.approx(np.exp(0.2), rel=1e-6)


# ---- several sightings -----------------------------------------------------------------------

def test_sightings_of_one_lesion_become_one_with_a_smaller_error_but_not_too_small(case):
    merged, single = case.locate(), case.locate(merged=False)
    for k, group in enumerate(case.groups):
        row, one = merged[str(k)], single[str(k)]
        assert len(row.sightings) == len(group)
        trace, alone = np.trace(row.cov_m2), np.trace(one.cov_m2)
        best = alone if len(group) == 1 else 1.2 * alone  # the frame that stands for `one` need not be the clearest
        assert trace <= best
        assert trace > np.trace(case.refined.trajectory.cov[row.frame][3:, 3:]) * 0.5  # what all share is not averaged


def test_what_is_far_in_time_or_space_or_named_otherwise_stays_apart(case):
    a, b = case.lesions[2], case.lesions[3]

    def count(*rows: Sighting) -> int:
        return len(locate(case.refined, list(rows), depth=case.depth, recording=case.recording))

    def row(lesion: SimulatedLesion, label: str) -> Sighting:
        return Sighting(label, "finding", lesion.frame, None, lesion.pixel, "x")

    assert count(row(a, "polyp"), row(a, "Polyp")) == 1
    assert count(row(a, "polyp"), row(a, "ulcer")) == 2
    assert count(row(a, "polyp"), row(b, "polyp")) == 2
    assert count(row(a, "polyp"), replace(row(a, "polyp"), kind="landmark")) == 2
    early, late = Sighting("x", "finding", 10, None, None, "x"), Sighting("x", "finding", 300, None, None, "x")
    assert count(early, replace(early, frame=12)) == 1 and count(early, late) == 2


# ---- what is not known -----------------------------------------------------------------------

def test_without_depth_it_is_the_camera_and_said_so(case, run):
    lesion = case.lesions[4]
    row, = locate(run, [Sighting("x", "finding", lesion.frame, None, None, "x")]).lesions
    camera = case.refined.trajectory.T_world_body[lesion.frame] @ case.refined.view.T_body_camera
    np.testing.assert_allclose(row.point_m, camera[:3, 3], atol=1e-9)
    assert "no depth was given" in row.status and row.arc_m is not None


def test_unknown_depth_at_the_pixel_is_said(case):
    lesion = case.lesions[4]
    elsewhere = (lesion.pixel[0] + (40 if lesion.pixel[0] < 160 else -40), lesion.pixel[1])
    row, = locate(case.refined, [Sighting("x", "finding", lesion.frame, None, elsewhere, "x")], depth=case.depth,
                  recording=case.recording).lesions
    assert "unknown at this pixel" in row.status


def test_no_landmark_no_distance_no_percentage(case):
    row = case.locate()["5"]
    assert row.nearest_landmark is row.from_landmark_m is row.percent_path is row.percent_time is None
    assert "distance unavailable" in row.status and "percentages unavailable" in row.status


@pytest.mark.parametrize(("labels", "words"), [
    ({1: "Pylorus"}, "no ileocecal valve"), ({8: "Ileocecal valve", 2: "Ampulla of Vater"}, "no pylorus")])
def test_a_missing_landmark_is_named_and_nothing_replaces_it(case, labels, words):
    row = case.locate(labels=labels)["5"]
    assert row.percent_path is None and words in row.status
    assert row.from_landmark_m is not None


def test_other_landmarks_serve_when_neither_is_there_or_when_asked_for(case):
    labels = {0: "cecum", 4: "hepatic flexure", 9: "rectum"}
    assert case.locate(labels=labels)["9"].percent_path.value == pytest.approx(100)
    asked = case.locate(labels=labels, between=("cecum", "Hepatic Flexure"))
    assert asked["4"].percent_path.value == pytest.approx(100) and "beyond hepatic flexure" in asked["9"].status
    assert "no anus" in case.locate(labels=labels, between=("cecum", "anus"))["9"].status


def test_beyond_the_travelled_path_nothing_is_extrapolated(case, tmp_path):
    """The capsule looks ahead in its last frame: the wall there lies where it never was."""
    t = case.refined.trajectory
    straight = np.tile(np.eye(4), (60, 1, 1))
    straight[:, 0, 3] = np.linspace(0, 0.1, 60)
    short = replace(case.refined, trajectory=replace(t.select(np.arange(60)), T_world_body=straight),
                    log_scale=case.refined.log_scale[:60], log_scale_sd=case.refined.log_scale_sd[:60], joint=None)
    centre = Sighting("ahead", "finding", 59, None, None, "x")
    camera = case.recording.calibration.camera
    stamp = case.recording.frame_t_ns
    (tmp_path / "d" / "data").mkdir(parents=True)
    (tmp_path / "d" / "data" / f"{stamp[59]}.png").write_bytes(
        cv2.imencode(".png", np.full((camera.height, camera.width), 3000, np.uint16))[1].tobytes())
    (tmp_path / "d" / "data.csv").write_text(f"#t,f\n{stamp[59]},{stamp[59]}.png\n")
    (tmp_path / "d" / "sensor.yaml").write_text("depth_unit_m: 1.0e-5\n")
    row, = locate(short, [centre], depth=tmp_path / "d", recording=case.recording).lesions
    assert row.arc_m is None and "beyond the path" in row.status and np.isfinite(row.point_m).all()


def test_without_joint_samples_there_is_no_interval(case):
    row = next(iter(locate(replace(case.refined, joint=None), case.rows(), depth=case.depth,
                           recording=case.recording).lesions))
    assert row.arc_m.low is row.arc_m.high is None and "refine the recording again" in row.status
