"""Long recordings in the report: what is drawn of them, what all frames say, and run folders read in blocks."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from fusion import Provenance, RefineConfig, Refinement, read_refinement, write_run
from fusion.report.aligned import make_scene
from fusion.run_stream import RunFrames
from tests.fusion.test_report import refinement_of
from vio import se3
from vio.alignment import align
from vio.errors import FormatError
from vio.trajectory import Trajectory


@pytest.fixture
def bare_run(tmp_path: Path, monkeypatch):
    """Writes run folders without their pictures, which take most of the time."""
    monkeypatch.setattr("fusion.report.write_report", lambda *_: None)
    monkeypatch.setattr("fusion.report.write_trajectory_plot", lambda *_: None)

    def written(r: Refinement) -> Path:
        write_run(r, tmp_path / "RUN", Provenance(["x"], RefineConfig(), {}))
        return tmp_path / "RUN"
    return written


@pytest.mark.parametrize(("n", "covered"), [(700, slice(40, 600)), (13_000, slice(None)), (13_000, slice(9000, 9500))])
def test_a_run_folder_streamed_shows_what_memory_shows(bare_run, n: int, covered: slice) -> None:
    r, u = refinement_of(n), np.linspace(0, 40, n)
    turned = r.truth.T_world_body @ se3.transform(se3.so3_exp(0.01 * np.sin(np.outer(u, [1, 2, 3]))), np.zeros(3))
    cov = r.trajectory.cov * (1 + u)[:, None, None]  # nothing is constant, so rounding chooses no extreme
    r = replace(r, trajectory=replace(r.trajectory, cov=cov), truth=Trajectory(r.truth.t_s[covered], turned[covered]))
    run = bare_run(r)
    whole, streamed = make_scene(read_refinement(run)), make_scene(RunFrames(run))
    assert (whole.kept.frame == streamed.kept.frame).all() and len(whole.t_s) <= 12_000
    assert (whole.rejected_frames == streamed.rejected_frames).all() and whole.errors.mode == streamed.errors.mode
    for one, other in ((whole, streamed), (whole.errors, streamed.errors), (whole.kept, streamed.kept),
                       (whole.kept.refinement, streamed.kept.refinement)):
        for name, value in vars(one).items():
            if isinstance(value, np.ndarray) and name != "velocity_m_s":
                np.testing.assert_allclose(getattr(other, name), value, rtol=1e-9, atol=1e-12, err_msg=name)
    assert len(streamed.errors.t_s) == len(np.intersect1d(np.arange(n)[covered], whole.kept.frame))
    assert streamed.errors.within_3_sigma == whole.errors.within_3_sigma


def test_what_is_left_out_of_pictures_is_in_the_numbers_and_no_peak_is_left_out() -> None:
    n = 30_000
    r = refinement_of(n, claim=0.5)
    rng = np.random.default_rng(4)
    bias, scale = rng.normal(size=(n, 3)), rng.normal(size=n)
    r = replace(r, accel_bias_m_s2=bias, log_scale=scale)
    scene, exact = make_scene(r), align(r.trajectory, r.truth, "se3").apply(r.trajectory)
    kept = scene.kept
    assert len(kept.frame) < 14_000 and kept.count == n and kept.frame[0] == 0 and kept.frame[-1] == n - 1
    np.testing.assert_allclose(kept.mean_accel_bias_m_s2, bias.mean(axis=0), rtol=1e-9)
    np.testing.assert_allclose(kept.way_m[-1], r.trajectory.path_length_m, rtol=1e-9)
    np.testing.assert_allclose(scene.refined_m, exact.positions_m[kept.frame], atol=1e-9)
    off = r.truth.positions_m - r.trajectory.positions_m
    body = np.einsum("nji,nj->ni", r.trajectory.rotations, off)[1:]
    squares = (body**2 / np.diagonal(r.trajectory.cov[0, 3:, 3:])).sum(axis=1)
    assert scene.errors.within_3_sigma == pytest.approx(np.mean(squares <= 14.156), abs=1e-3)
    error = np.linalg.norm(exact.positions_m - r.truth.positions_m, axis=1)
    edges = np.linspace(0, n, 251).round().astype(int)
    for start, end in pairwise(edges):
        here = kept.frame[(kept.frame >= start) & (kept.frame < end)]
        for values in (error, scale, *bias.T):
            assert values[here].max() == values[start:end].max() and values[here].min() == values[start:end].min()
    steps = np.linalg.norm(np.diff(scene.refined_m, axis=0), axis=1)
    assert steps.max() < 3e-3 + r.trajectory.path_length_m / 4000


def test_damage_in_the_middle_of_a_run_is_refused_in_one_line(bare_run) -> None:
    run = bare_run(refinement_of(9000))
    motions, states = (run / "motions_only.tum").read_text().splitlines(), dict(np.load(run / "trajectory.npz"))

    def refused(words: str) -> None:
        with pytest.raises(FormatError, match=words) as caught:
            make_scene(RunFrames(run))
        assert "\n" not in str(caught.value)

    for spoilt, message in ((motions[:5000], "ends before frame"),
                          ([*motions[:5000], "1 2 3", *motions[5001:]], "motions_only.tum: .*refine the rec")):
        (run / "motions_only.tum").write_text("\n".join(spoilt))
        refused(message)
    (run / "motions_only.tum").write_text("\n".join(motions))
    for change, message in (({"cov": states["cov"][:-1]}, "cov has shape"), ({"log_scale": None}, "missing key"),
                          ({"t": np.r_[states["t"][:-1], 0.0]}, "time"),
                          ({"gyro_bias": states["gyro_bias"] * np.nan}, "not finite")):
        np.savez(run / "trajectory.npz", **{k: v for k, v in (states | change).items() if v is not None})
        refused(message)
