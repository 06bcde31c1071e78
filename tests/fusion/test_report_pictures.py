"""The uncertainty tube, levels along time, pictures of lesions; and the whole page in a real browser."""

import io
import json
import re
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.browser import Browser
from fusion import Provenance, RefineConfig, locate, read_refinement, read_run, write_lesions, write_run
from fusion.cli import main
from fusion.report import write_report
from fusion.report.kept import even_frames
from fusion.report.levels import SPANS, spans_speed
from fusion.report.pictures import MOST, picture_gallery
from fusion.report.tube import RADIUS_SD, SIDES, ring_frames, tube
from fusion.view import write_rerun
from vio.calibration import Calibration
from vio.errors import RecordingError
from vio.imu import ImuSamples
from vio.recording import Recording

EVIL = "'><img src=x onerror=alert(1)></script><b>"


# ---- the tube ---------------------------------------------------------------------------------

@given(seed=st.integers(0, 2**32 - 1), n=st.integers(2, 12))
def test_rings_are_the_outlines_of_the_ellipsoids(seed, n):
    """No vertex lies outside the ellipsoid's shadow, and the widest ring point reaches its edge across the way."""
    rng = np.random.default_rng(seed)
    points = np.cumsum(rng.normal(size=(n, 3)), axis=0)
    root = rng.normal(size=(n, 3, 3)) * 0.1
    cov = root @ np.swapaxes(root, 1, 2) + 1e-6 * np.eye(3)
    vertices, faces = tube(points, cov)
    assert vertices.shape == (n * SIDES, 3) and faces.shape == (2 * (n - 1) * SIDES, 3)
    assert faces.min() == 0 and faces.max() == len(vertices) - 1
    rings = vertices.reshape(n, SIDES, 3) - points[:, None]
    ways = np.gradient(points, axis=0)
    for ring, way, sigma in zip(rings, ways, cov, strict=True):
        assert np.abs(ring @ way).max() < 1e-6 * np.linalg.norm(way) + 1e-9  # the ring lies across the way
        across = ring / np.linalg.norm(ring, axis=1, keepdims=True)
        reach = RADIUS_SD * np.sqrt(np.einsum("ki,ij,kj->k", across, sigma, across))
        assert (np.linalg.norm(ring, axis=1) <= reach * (1 + 1e-6)).all()
    np.testing.assert_allclose(rings.mean(axis=1), 0, atol=1e-9)


def test_rests_take_no_rings_and_a_still_track_has_two():
    still = np.repeat([[0.0, 0, 0], [1.0, 0, 0]], [500, 500], axis=0)
    assert set(ring_frames(still)) <= {0, 500, 999}
    vertices, _ = tube(np.zeros((2, 3)), np.tile(np.eye(3), (2, 1, 1)))
    assert np.isfinite(vertices).all()


@given(st.integers(2, 4000), st.floats(0.05, 5))
def test_speed_times_time_is_the_way(n, dt_s):
    p = np.cumsum(np.random.default_rng(n).normal(size=(n, 3)), axis=0)
    t = np.arange(n) * dt_s
    way = np.concatenate([[0.0], np.linalg.norm(np.diff(p, axis=0), axis=1).cumsum()])
    edges = even_frames(n, SPANS + 1)
    centres, speed = spans_speed(t[edges], way[edges])
    assert len(centres) <= SPANS and (np.diff(centres) > 0).all()
    assert len(speed) == 1 == n or speed @ np.diff(t[edges]) == pytest.approx(way[-1])


# ---- pictures ---------------------------------------------------------------------------------

def row(frame: int, label: str = "polyp") -> dict:
    return {"frame": frame, "label": label}


def pictured(folder: Path, count: int) -> Recording:
    cv2.imwrite(str(folder / "0.png"), np.full((40, 40, 3), 128, np.uint8))
    paths = (folder / "0.png", folder / "lost.png", *([None] * (count - 2)))
    t_ns = np.arange(count, dtype=np.int64) * 10**9
    return Recording("r", t_ns, ImuSamples.none(), Calibration(None, np.eye(4)), None, paths)


def test_pictures_name_what_they_show_and_say_what_is_missing(tmp_path):
    html = picture_gallery([row(0, EVIL), row(1), row(2)], pictured(tmp_path, 3))
    assert html.count("data:image/jpeg;base64,") == 1 and html.count("no image") == 2
    assert EVIL not in html and "&lt;img src=x onerror=alert(1)&gt;" in html
    assert str(tmp_path) not in html and "lost.png" not in html
    many = picture_gallery([row(2)] * (MOST + 5), pictured(tmp_path, 3))
    assert many.count("<li>") == MOST and f"The first {MOST} of {MOST + 5} are shown" in many


# ---- a run with everything ----------------------------------------------------------------------

@pytest.fixture(scope="module")
def run(refined, examination, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("pictures")
    out = folder / "RUN"
    write_run(refined, out, Provenance(["refine"], RefineConfig(), {}), examination.motions)
    (folder / "L.csv").write_text(f"label,frame,kind\nPylorus,20,landmark\n{EVIL},150,finding\n"
                                  "Ileocecal valve,280,landmark\n", encoding="utf-8")
    write_lesions(locate(out, folder / "L.csv"), out)
    return out


def test_what_the_imu_felt_is_kept_in_the_run_and_drawn(run, refined):
    again = read_refinement(run)
    for name in ("t_s", "rate_rad_s", "force_m_s2", "vibration_m_s2"):
        np.testing.assert_allclose(getattr(again.inertial, name), getattr(refined.inertial, name), rtol=1e-6)
    assert main(["report", str(run)]) == 0
    text = (run / "report.html").read_text(encoding="utf-8")
    found = re.search(r'<script type="application/json" id="figures">(.*?)</script>', text, re.DOTALL)
    figures = json.loads(found.group(1))
    np.testing.assert_allclose(figures["vibration"]["data"][0]["y"], refined.inertial.vibration_m_s2, rtol=1e-5)
    np.testing.assert_allclose(figures["rate"]["data"][0]["y"], np.rad2deg(refined.inertial.rate_rad_s), rtol=1e-5)
    assert figures["trajectory"]["data"][-3]["type"] == "mesh3d"
    expected = [float(f"{t:.6g}") for t in refined.trajectory.t_s[refined.rejected]]
    assert next(d for d in figures["speed"]["data"] if d["name"] == "motion rejected")["x"] == expected
    rotation = {d["name"]: np.array(d["y"]) for d in figures["rotation"]["data"]}
    assert np.sqrt(np.mean(rotation["refined"] ** 2)) < np.sqrt(np.mean(rotation["motions alone"] ** 2))


def test_damaged_levels_are_refused_in_one_line(run, tmp_path, capsys):
    for name in run.iterdir():
        (tmp_path / name.name).write_bytes(name.read_bytes())
    with np.load(run / "trajectory.npz") as data:
        arrays = dict(data)
    np.savez(tmp_path / "trajectory.npz", **arrays | {"inertial_rate": np.zeros(3)})
    assert main(["report", str(tmp_path)]) == 3
    error = capsys.readouterr().err
    assert "inertial levels" in error and len(error.splitlines()) == 1
    with zipfile.ZipFile(io.BytesIO((run / "trajectory.npz").read_bytes())) as archive:
        assert "inertial_t.npy" in archive.namelist()


# ---- in a browser ---------------------------------------------------------------------------------

def opened(tab: Browser, run: Path, **window) -> None:
    tab.requests.clear()
    tab.complaints.clear()
    tab.show(run / "report.html", **window)
    tab.ask("window.reportDrawn ?? new Promise(done => addEventListener('load', () => done(window.reportDrawn)))")


@pytest.mark.parametrize(("scheme", "width"), [("light", 1280), ("dark", 390)])
def test_every_figure_is_drawn_in_the_readers_colours_and_nothing_is_fetched(tab, run, scheme, width):
    opened(tab, run, scheme=scheme, width=width)
    keys = tab.ask("[...document.querySelectorAll('.plot')].map(plot => plot.id)")
    assert set(keys) >= {"trajectory", "unrolled", "error", "rotation", "claim", "speed", "scale", "rate", "vibration"}
    curves = tab.ask("Object.fromEntries([...document.querySelectorAll('.plot')].map(plot => "
                     "[plot.id, plot.querySelectorAll('.scatterlayer .js-line').length]))")
    assert all(count >= 1 for key, count in curves.items() if key != "trajectory")
    assert tab.ask("document.querySelector('#trajectory canvas').width") > 100
    colour = tab.ask("getComputedStyle(document.querySelector('#vibration .js-line')).stroke")
    assert colour == {"light": "rgb(200, 50, 63)", "dark": "rgb(255, 111, 123)"}[scheme]
    assert tab.ask("document.documentElement.scrollWidth") <= width  # nothing sticks out of a narrow window
    assert [url for url in tab.requests if not url.startswith(("file:", "data:", "blob:"))] == []
    assert tab.complaints == []
    assert tab.ask("document.querySelectorAll('[onerror]').length") == 0


@pytest.mark.parametrize("width", [1280, 390, 320])
def test_axes_of_the_picture_in_space_are_seen_whole(tab, run, tmp_path, width):
    """Nothing of it, no label either, reaches its edges: there are only pixels of the card."""
    opened(tab, run, width=width)
    tab.ask("new Promise(done => setTimeout(done, 500))")
    left, top, wide, high = tab.ask("(b => [b.left + scrollX, b.top + scrollY, b.width, b.height])"
                                    "(document.querySelector('#trajectory canvas').getBoundingClientRect())")
    tab.picture(tmp_path / "page.png")
    page = cv2.imread(str(tmp_path / "page.png"))
    shown = page[round(top):round(top + high), round(left):round(left + wide)]
    card = page[round(top + high) + 4, round(left)]
    assert (shown != card).any()
    for edge in (shown[:, :2], shown[:, -2:], shown[:2], shown[-2:]):
        assert (edge == card).all()


def test_legends_stay_above_the_curves_when_a_narrow_page_grows_wide(tab, run):
    overlaps = ("[...document.querySelectorAll('.plot:has(.gridlayer)')].map(plot => plot.querySelector('.legend')"
                ".getBoundingClientRect().bottom - plot.querySelector('.gridlayer').getBoundingClientRect().top)")
    opened(tab, run, width=390)
    narrow = tab.ask(overlaps)
    tab.ask("dispatchEvent(new Event('beforeprint'))")
    paper = tab.ask(overlaps)
    tab.ask("dispatchEvent(new Event('afterprint'))")
    assert len(paper) >= 8 and max(narrow) <= 0 and max(paper) <= 0


def test_keys_move_turn_and_bring_back(tab, run):
    opened(tab, run)
    eye = "JSON.stringify(document.getElementById('trajectory').layout.scene.camera.eye)"
    span = "document.getElementById('error').layout.xaxis.range.map(Number)"
    other = "document.getElementById('scale').layout.xaxis.range.map(Number)"
    tab.ask("document.getElementById('trajectory').focus()")
    before = json.loads(tab.ask(eye))
    tab.press("ArrowLeft")
    turned = json.loads(tab.ask(eye))
    assert np.hypot(turned["x"], turned["y"]) == pytest.approx(np.hypot(before["x"], before["y"]))
    assert abs(turned["x"] - before["x"]) > 0.05
    tab.press("+")
    nearer = json.loads(tab.ask(eye))
    assert np.linalg.norm(list(nearer.values())) == pytest.approx(0.8 * np.linalg.norm(list(turned.values())))
    tab.emulate("dark")
    assert json.loads(tab.ask(eye)) == nearer  # other colours, the same view
    tab.press("Home")
    assert json.loads(tab.ask(eye)) == pytest.approx(before)
    whole = tab.ask(span)
    tab.ask("document.getElementById('error').focus()")
    tab.press("+")
    zoomed = tab.ask(span)
    assert np.ptp(zoomed) == pytest.approx(0.8 * np.ptp(whole)) and tab.ask(other) == pytest.approx(zoomed)
    tab.press("ArrowRight")
    assert tab.ask(span) == pytest.approx([v + 0.08 * np.ptp(whole) for v in zoomed])
    tab.press("Home")
    assert tab.ask(span) == pytest.approx(whole)
    reached = []
    for _ in range(25):
        tab.press("Tab")
        reached.append(tab.ask("document.activeElement.id"))
    assert [key for key in reached if key][:3] == ["rotation", "claim", "speed"]  # in reading order


def test_paper_is_light_complete_and_within_its_margins(tab, run):
    opened(tab, run, scheme="dark")
    pdf = tab.paper()
    assert pdf.startswith(b"%PDF") and 2 <= len(re.findall(rb"/Type\s*/Page\b", pdf)) <= 10
    tab.ask("dispatchEvent(new Event('beforeprint'))")
    tab.emulate("dark", media="print")
    widths = tab.ask("[...document.querySelectorAll('figure:not(.trajectory) .main-svg')].map(svg => svg.clientWidth)")
    assert widths and max(widths) <= 690
    assert tab.ask("getComputedStyle(document.querySelector('#vibration .js-line')).stroke") == "rgb(200, 50, 63)"
    assert tab.ask("getComputedStyle(document.querySelector('.still')).display") == "block"
    tab.emulate("dark")
    tab.ask("dispatchEvent(new Event('afterprint'))")
    assert tab.ask("getComputedStyle(document.querySelector('#vibration .js-line')).stroke") == "rgb(255, 111, 123)"


def test_pictures_of_another_recording_are_refused(run, refined, tmp_path):
    other = pictured(tmp_path, len(refined.trajectory))  # as many frames, at other times
    for write in (lambda: write_report(refined, read_run(run).summary, tmp_path / "r.html", recording=other),
                  lambda: write_rerun(refined, tmp_path / "r.rrd", recording=other)):
        with pytest.raises(RecordingError, match=r"recording r does not have the frames .* give the recording"):
            write()
    assert not (tmp_path / "r.html").exists()
