"""The viewer's file: the right entities with the right number of rows, read back by the viewer's own tool."""

import re
import subprocess
import sys
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion import Provenance, RefineConfig, locate, write_lesions, write_run
from fusion.cli import main
from fusion.view import RADIUS_SD, cloud, ellipsoid
from vio import se3
from vio.camera import Camera

CAMERA = Camera("pinhole", 40, 30, 30.0, 30.0, 19.5, 14.5)


@given(seed=st.integers(0, 2**32 - 1), rank=st.integers(0, 3))
def test_the_ellipsoid_holds_what_the_covariance_says(seed, rank):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(3, 3)) * (np.arange(3) < rank)
    cov = root @ root.T
    _, half, quat_xyzw = ellipsoid(np.zeros(3), cov)
    R = se3.matrix_from_quat_xyzw(quat_xyzw)
    np.testing.assert_allclose(R @ np.diag((half / RADIUS_SD) ** 2) @ R.T, cov, atol=1e-9 * (1 + np.trace(cov)))
    assert np.linalg.det(R) == pytest.approx(1)


@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0, 1))
def test_points_of_the_cloud_project_back_to_known_pixels_at_their_depth(seed, share):
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.01, 0.1, (30, 40)) * (rng.random((30, 40)) < share)
    T = se3.exp(rng.normal(size=6))
    points = cloud(depth, CAMERA, T)
    assert len(points) == min(1500, int((depth > 0).sum()))
    inside = (points - T[:3, 3]) @ T[:3, :3]
    pixel, valid = CAMERA.project(inside)
    assert np.all(valid)
    at = np.round(pixel).astype(int)
    np.testing.assert_allclose(depth[at[:, 1], at[:, 0]], inside[:, 2], rtol=1e-6)


@pytest.fixture(scope="module")
def run(refined, examination, tmp_path_factory):
    out = tmp_path_factory.mktemp("view") / "RUN"
    write_run(refined, out, Provenance(["refine"], RefineConfig(), {}), examination.motions)
    (out.parent / "L.csv").write_text("label,frame,kind\nPylorus,20,landmark\npolyp,150,finding\n", encoding="utf-8")
    write_lesions(locate(out, out.parent / "L.csv"), out)
    return out


def test_without_the_viewer_the_remedy_is_named(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert main(["view", str(run), "--out", str(tmp_path / "run.rrd")]) == 3
    assert "pip install 'capsule-vio[view]'" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_the_viewers_own_tool_reads_what_was_written(run, tmp_path, refined, capsys):
    pytest.importorskip("rerun", reason="needs the extra 'view'")
    assert main(["view", str(run), "--out", str(tmp_path / "run.rrd")]) == 0
    assert "rerun run.rrd" in capsys.readouterr().out
    said = subprocess.run([sys.executable, "-m", "rerun", "rrd", "print", str(tmp_path / "run.rrd")], text=True,
                          capture_output=True, check=True, timeout=120).stdout
    rows: Counter[str] = Counter()
    for count, entity in re.findall(r"with (\d+) rows .*? - (/\S+) - data columns", said):
        rows[entity] += int(count)
    frames = len(refined.trajectory)
    assert rows["/world/body"] == rows["/world/position_95"] == frames
    assert rows["/world/refined"] == rows["/world/motions_alone"] == rows["/world/truth"] == 1
    assert {"/world/lesions/1", "/world/lesions/2", "/world/lesions/1/ellipsoid_95"} <= set(rows)
    assert "/picture" not in rows and str(tmp_path) not in said
