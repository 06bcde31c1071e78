"""The report and the picture: self-contained, safe with any name, and true to the numbers."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fusion.report import figures, words, write_report, write_trajectory_plot
from fusion.report.aligned import make_scene, thin
from fusion.report.plot import ticks
from fusion.result import ImuConclusion, Refinement, ScaleConclusion
from vio import se3
from vio.errors import OutputError
from vio.imu import Gap
from vio.metrics import accuracy_table
from vio.motions import RelativeMotions
from vio.trajectory import Trajectory

EVIL = "<img src=x onerror=alert(1)> & </script><b>"
SVG = "{http://www.w3.org/2000/svg}"


def refinement_of(n: int = 400, sd_m: float = 5e-4, claim: float = 1.0, seed: int = 3, **changes) -> Refinement:
    """A winding track; refined positions are off by noise of `sd_m` along body x and less along y and z, claimed as
    `claim` times that."""
    rng = np.random.default_rng(seed)
    t, u = np.arange(n) / 4, np.linspace(0, 1, n)
    p = np.column_stack([np.sin(9 * u), np.cos(5 * u), np.sin(4 * u + 1)]) * 0.1
    T = se3.transform(se3.so3_exp(np.column_stack([0.2 * np.sin(7 * u), u, 3 * u])), p)
    sd_body = sd_m * np.array([1.0, 0.1, 0.4])
    noise = (T[:, :3, :3] @ (rng.normal(size=(n, 3)) * sd_body)[..., None])[..., 0]
    noise[0] = 0
    cov = np.broadcast_to(np.diag(np.r_[[1e-4] * 3, (claim * sd_body) ** 2]), (n, 6, 6)).copy()
    rejected = np.array([k for k in (5, 60, 61) if k < n - 1])
    motions = T.copy()
    motions[:, :3, 3] += np.cumsum(rng.normal(size=(n, 3)) * 1e-3, axis=0)
    values = {
        "name": "colon 7", "estimator": "graph", "fallback_reason": None,
        "trajectory": Trajectory(t, se3.transform(T[:, :3, :3], p + noise), cov), "velocity_m_s": np.zeros((n, 3)),
        "gyro_bias_rad_s": np.full((n, 3), 0.01), "accel_bias_m_s2": np.full((n, 3), 0.1),
        "log_scale": np.full(n, np.log(8e-4)), "log_scale_sd": np.full(n, 0.02),
        "motions_only": Trajectory(t, motions),
        "scale": ScaleConclusion("free", float(np.log(8e-4)), 0.02, "measured by the IMU"),
        "imu": ImuConclusion(0.49, 1.0, (Gap(20.0, 22.5),)), "motions_used": n - 1 - len(rejected),
        "rejected": rejected, "bridged": 0, "time_offset_s": 0.0, "truth": Trajectory(t, T), "timing_s": {"free": 1.25},
        "peak_rss_bytes": 2**30,
    }
    return Refinement(**(values | changes))


def summary_of(r: Refinement) -> dict:
    summary = {"duration_s": float(r.trajectory.t_s[-1]), "path_length_m": r.trajectory.path_length_m,
               "timing_s": r.timing_s, "peak_rss_bytes": r.peak_rss_bytes}
    if r.truth is not None:
        summary["accuracy"] = {"refined": accuracy_table(r.trajectory, r.truth),
                               "motions": accuracy_table(r.motions_only, r.truth)}
        summary["paper_metrics"] = {key: {"ate_paper": 1e-4, "abs_rel_t": None} for key in ("refined", "motions")}
    return summary


class Page(HTMLParser):
    """Elements with their attributes, the text outside scripts, and the scripts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.text, self.raw, self.inside = "", [], ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        self.inside = tag

    def handle_endtag(self, tag):
        self.inside = ""

    def handle_data(self, data):
        if self.inside in ("script", "style"):
            self.raw.append((self.inside, data))
        else:
            self.text += data


def page_of(r: Refinement, folder: Path, **arguments) -> tuple[Page, dict]:
    write_report(r, summary_of(r), folder / "report.html", **arguments)
    page = Page((folder / "report.html").read_text(encoding="utf-8"))
    drawn = next(json.loads(text) for tag, text in page.raw if text.lstrip().startswith('{"trajectory"'))
    return page, drawn


def trace(figure: dict, name: str) -> dict:
    return next(part for part in figure["data"] if part["name"] == name)


def test_page_fetches_nothing(tmp_path: Path) -> None:
    page, _ = page_of(refinement_of(), tmp_path)
    for tag, attributes in page.elements:
        assert tag not in ("link", "iframe", "img", "object", "embed", "base", "form", "a")
        assert not {"src", "href", "data", "action", "srcset"} & set(attributes)
        assert not any(key.startswith("on") for key in attributes)
    policy = next(a["content"] for t, a in page.elements if a.get("http-equiv") == "Content-Security-Policy")
    assert policy.startswith("default-src 'none'") and "http" not in policy and "connect-src" not in policy
    styles = "".join(text for tag, text in page.raw if tag == "style")
    assert "url(" not in styles and "@import" not in styles and "prefers-color-scheme" in styles and "print" in styles
    own = [text for tag, text in page.raw if tag == "script"][-1]
    assert 'showSendToCloud: false, plotlyServerURL: ""' in own and "http" not in own
    assert any("plotly.js v" in text[:60] for tag, text in page.raw if tag == "script")


def test_any_name_and_reason_stays_text(tmp_path: Path) -> None:
    r = refinement_of(name=EVIL, fallback_reason=EVIL, scale=ScaleConclusion("prior", 0.0, 0.1, EVIL))
    page, _ = page_of(r, tmp_path)
    assert page.text.count(EVIL) >= 5  # title, heading, picture, fallback, scale
    assert len([tag for tag, _ in page.elements if tag == "script"]) == 3
    write_trajectory_plot(r, tmp_path / "t.svg")
    root = ElementTree.parse(tmp_path / "t.svg").getroot()
    assert root.find(f"{SVG}text").text == EVIL and root.find(f".//{SVG}img") is None


def test_no_paths_in_the_page(tmp_path: Path) -> None:
    page_of(refinement_of(), tmp_path)
    assert str(tmp_path) not in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_figures_tell_the_numbers(tmp_path: Path) -> None:
    r = refinement_of()
    page, drawn = page_of(r, tmp_path)
    accuracy = summary_of(r)["accuracy"]
    for source, name in (("refined", "refined"), ("motions", "motions alone")):
        error_mm = np.array(trace(drawn["error"], name)["y"])
        rmse_m = accuracy[source]["se3"]["ate_rmse_m"]
        np.testing.assert_allclose(np.sqrt(np.mean(error_mm**2)), 1e3 * rmse_m, rtol=1e-4)
        assert words.length(rmse_m) in page.text
    space = drawn["trajectory"]
    assert space["layout"]["scene"]["aspectmode"] == "data"
    np.testing.assert_allclose(trace(space, "truth")["z"], 1e3 * r.truth.positions_m[:, 2], rtol=1e-5)
    assert trace(space, "refined")["z"][0] == pytest.approx(trace(space, "start")["z"][0])
    np.testing.assert_allclose(trace(drawn["scale"], "scale")["y"], 0.8, rtol=1e-5)
    np.testing.assert_allclose(max(trace(drawn["scale"], "± 2 sd")["y"]), 0.8 * np.exp(0.04), rtol=1e-5)
    np.testing.assert_allclose(trace(drawn["gyro"], "y")["y"], np.rad2deg(0.01), rtol=1e-5)
    np.testing.assert_allclose(trace(drawn["claim"], "claimed 3 sigma")["y"], 1.5, rtol=1e-5)


def test_rejected_motions_and_holes_are_marked(tmp_path: Path) -> None:
    r = refinement_of()
    _, drawn = page_of(r, tmp_path)
    assert trace(drawn["error"], "motion rejected")["x"] == [1.25, 15.0, 15.25]
    assert len(trace(drawn["trajectory"], "motion rejected")["x"]) == 3
    hole = drawn["error"]["layout"]["shapes"][0]
    assert (hole["x0"], hole["x1"]) == (20.0, 22.5)
    # Wider baselines: the indices alone do not tell frames, the motions do.
    wide = replace(r, motions_used=2 * len(r.trajectory), rejected=np.array([1, 2]))
    page, drawn = page_of(wide, tmp_path)
    assert "not marked" in page.text and len(drawn["error"]["data"]) == 2
    t_i = np.array([0.0, 3.0, 50.0])
    motions = RelativeMotions(t_i, t_i + 1, np.tile(np.eye(4), (3, 1, 1)), np.tile(np.eye(6), (3, 1, 1)), 0.0, 0.1)
    _, drawn = page_of(wide, tmp_path, motions=motions)
    assert trace(drawn["error"], "motion rejected")["x"] == [3.0, 50.0]


def accuracy(refined_m: float, motions_m: float, **modes: tuple[float, float]) -> dict:
    table: dict = {"refined": {}, "motions": {}}
    for mode, pair in ({"se3": (refined_m, motions_m)} | modes).items():
        for source, value in zip(table, pair, strict=True):
            table[source][mode] = {"ate_rmse_m": value, "rotation_rmse_rad": 0.1, "matched": 10}
    return {"accuracy": table}


def test_verdict_says_plainly_who_wins() -> None:
    r = refinement_of(20)
    assert words.verdict(r, accuracy(1e-3, 4e-3)).tone == "good"
    assert "4.0 times closer" in words.verdict(r, accuracy(1e-3, 4e-3)).text
    lost = words.verdict(r, accuracy(4e-3, 1e-3))
    assert lost.tone == "bad" and "Fusion loses" in lost.text and "4.00\u00a0mm against 1.00\u00a0mm" in lost.text
    assert words.verdict(r, accuracy(1.001e-3, 1e-3)).text.startswith("Fusion makes no difference")
    assert "no truth" in words.verdict(r, {}).text
    assert "Nothing was fused" in words.verdict(replace(r, estimator="motions"), accuracy(1e-3, 1e-3)).text
    mixed = dict(words.sentences(r, accuracy(1e-3, 4e-3, sim3=(3e-3, 2e-3)), None))
    assert "Sim(3)" in mixed["Where fusion loses"] and "SE(3)" not in mixed["Where fusion loses"]


@pytest.mark.parametrize(("claim", "low", "high"), [(1.0, 0.985, 1.0), (0.3, 0.0, 0.6)])
def test_share_inside_the_claim_is_right(claim: float, low: float, high: float) -> None:
    errors = make_scene(refinement_of(3000, claim=claim)).errors
    assert low <= errors.within_3_sigma <= high


def test_gauge_of_the_claim_is_the_first_pose() -> None:
    r = refinement_of()
    turned = se3.transform(se3.so3_exp([0, 0, 1.2]), [3.0, -2.0, 1.0])
    moved = replace(r, truth=Trajectory(r.truth.t_s, turned @ r.truth.T_world_body))
    expected = np.linalg.norm(r.trajectory.positions_m - r.truth.positions_m, axis=1)
    np.testing.assert_allclose(make_scene(moved).errors.first_pose_m, expected, atol=1e-9)


def test_a_straight_track_still_gets_its_report(tmp_path: Path) -> None:
    r = refinement_of(50)
    line = Trajectory(r.trajectory.t_s, se3.transform(np.eye(3), np.outer(np.linspace(0, 0.2, 50), [1, 0, 0])))
    straight = replace(r, truth=line, motions_only=line, trajectory=replace(line, cov=r.trajectory.cov))
    page, _ = page_of(straight, tmp_path)
    assert "after yaw and translation alignment" in page.text and "not determined" in page.text
    up = replace(line, T_world_body=se3.transform(np.eye(3), np.outer(np.linspace(0, 0.2, 50), [0, 0, 1])))
    assert make_scene(replace(straight, truth=up, motions_only=up, trajectory=up)).errors.mode == "origin"


def test_without_truth_and_covariance(tmp_path: Path) -> None:
    r = refinement_of(truth=None)
    page, drawn = page_of(replace(r, trajectory=replace(r.trajectory, cov=None)), tmp_path)
    assert set(drawn) == {"trajectory", "speed", "scale", "gyro", "accel"} and "no truth" in page.text
    assert "table" not in [tag for tag, _ in page.elements]
    write_trajectory_plot(r, tmp_path / "t.svg")
    assert "claimed 3 sigma" in (tmp_path / "t.svg").read_text()


def test_long_recordings_are_thinned_but_keep_their_peaks(tmp_path: Path) -> None:
    r = refinement_of(30_000)
    peak = r.trajectory.T_world_body.copy()
    peak[12_345, 2, 3] += 0.5
    _, drawn = page_of(replace(r, trajectory=replace(r.trajectory, T_world_body=peak)), tmp_path)
    for figure in drawn.values():
        assert max(len(part["x"]) for part in figure["data"]) <= 2 * figures.LIMIT + 4
    assert max(trace(drawn["error"], "refined")["y"]) > 490
    assert (tmp_path / "report.html").stat().st_size < 8e6


@given(arrays(float, st.integers(1, 400), elements=st.floats(-1e6, 1e6)), st.integers(4, 60))
def test_thinning_keeps_order_ends_and_extremes(values: np.ndarray, limit: int) -> None:
    keep = thin(values, limit)
    assert (np.diff(keep) > 0).all() and keep[0] == 0 and keep[-1] == len(values) - 1
    assert len(keep) <= limit + 2
    assert values[keep].max() == values.max() and values[keep].min() == values.min()


def test_picture_is_one_valid_repeatable_svg(tmp_path: Path) -> None:
    r = refinement_of()
    for name in ("a.svg", "b.svg"):
        write_trajectory_plot(r, tmp_path / name)
    text = (tmp_path / "a.svg").read_text(encoding="utf-8")
    assert text == (tmp_path / "b.svg").read_text(encoding="utf-8") and "prefers-color-scheme:dark" in text
    root = ElementTree.fromstring(text)
    _, _, width, height = (float(v) for v in root.get("viewBox").split())
    lines = [e.get("d") for e in root.iter(f"{SVG}path") if e.get("class") in ("refined", "motions", "truth")]
    assert len(lines) == 3 + 2 * 3 + 2  # legend, two views, errors
    for line in lines:
        points = np.array([pair.split(",") for pair in line[1:].split()], float)
        assert (points >= 0).all() and (points <= [width, height]).all()
    views = [np.array([pair.split(",") for pair in line[1:].split()], float) for line in lines[4:6]]
    spans_px, spans_m = np.ptp(views[0], axis=0), np.ptp(make_scene(r).refined_m[:, :2], axis=0)
    np.testing.assert_allclose(spans_px[0] / spans_px[1], spans_m[0] / spans_m[1], rtol=0.01)  # equal aspect


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e6), st.integers(3, 8))
def test_ticks_are_few_round_and_inside(low: float, span: float, about: int) -> None:
    values = ticks(low, low + span, about)
    assert len(values) <= about + 1
    slack = 1e-6 * span + 1e-9 * abs(low)
    assert all(low - slack <= value <= low + span + slack for value in values)


def test_lengths_in_words() -> None:
    shown = [words.length(v).replace("\u00a0", " ") for v in (0.0, 1.234e-6, 0.0099996, 0.12345, 0.9999, 1.0, 12345.6)]
    assert shown == ["0 mm", "0.00123 mm", "10.0 mm", "123 mm", "1,000 mm", "1.00 m", "12,346 m"]
    assert [words.duration(s) for s in (5.0, 333.2, 28_800.0)] == ["5.00 s", "5 min 33 s", "8 h 0 min"]
    assert words.percent(-0.25) == "−25\u00a0%"


def test_nothing_is_left_where_nothing_can_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    r = refinement_of(10)
    for write in (lambda path: write_report(r, summary_of(r), path), lambda path: write_trajectory_plot(r, path)):
        with pytest.raises(OutputError):
            write(tmp_path / "file" / "out")
    assert re.fullmatch("file", " ".join(p.name for p in tmp_path.iterdir()))
