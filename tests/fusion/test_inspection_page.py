"""The inspection's page and verdicts: every check with what to do, true to the numbers, safe with any name."""

import json
import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fusion.cli import main
from fusion.report.charts import HEIGHT, WIDTH, Chart, Curve, chart_svg
from fusion.report.inspection_page import write_inspection
from vio.formats.asl import write_asl
from vio.imu import ImuSamples
from vio.inspection import inspect_recording
from vio.recording import Recording

EVIL = "<script>alert(1)</script>"


def holed(recording: Recording, start_s: float, end_s: float) -> Recording:
    keep = (recording.imu_t_s < start_s) | (recording.imu_t_s > end_s)
    imu = recording.imu
    return replace(recording, imu=ImuSamples(imu.t_ns[keep], imu.gyro_rad_s[keep], imu.accel_m_s2[keep]))


def verdicts(recording: Recording) -> dict:
    return {check.name: check for check in inspect_recording(recording).checks}


def test_holes_and_vibration_are_judged_with_what_to_do(examination):
    recording = examination.recording
    found = verdicts(holed(recording, 20.0, 23.0))["imu gaps"]
    assert found.level == "warning" and "1 holes" in found.text and found.remedy
    longest, begins = (float(v) for v in re.search(r"longest, ([\d.]+) s, begins at ([\d.]+) s", found.text).groups())
    assert longest == pytest.approx(3.0, abs=0.06) and begins == pytest.approx(20.0, abs=0.06)
    assert verdicts(recording)["imu gaps"].level == "ok"
    shaken = recording.imu.accel_m_s2 + np.where(np.arange(len(recording.imu))[:, None] % 2, 2.0, -2.0)
    loud = verdicts(replace(recording, imu=replace(recording.imu, accel_m_s2=shaken)))["vibration"]
    assert loud.level == "warning" and "examples/08" in loud.remedy
    frames = np.delete(np.arange(len(recording)), np.arange(100, 130))
    paths = tuple(recording.frame_paths[k] for k in frames)
    cut = verdicts(replace(recording, frame_t_ns=recording.frame_t_ns[frames], frame_paths=paths, depth_paths=()))
    assert cut["frames"].level == "warning" and "1 holes" in cut["frames"].text and cut["frames"].remedy


def test_the_page_shows_every_check_and_runs_nothing(examination, tmp_path):
    recording = replace(holed(examination.recording, 20.0, 23.0), name=EVIL)
    inspection = inspect_recording(recording)
    write_inspection(recording, inspection, tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert EVIL not in text and "<script" not in text and str(tmp_path) not in text and "http:" not in text
    for check in inspection.checks:
        assert check.name in text
    assert text.count("What to do:") == sum(bool(check.remedy) for check in inspection.checks)
    for title in ("Frame intervals", "Intervals of inertial samples", "Gravity", "Turning", "Vibration",
                  "Spectrum of the accelerometer", "Spectrum of the gyro"):
        assert f"<h2>{title}</h2>" in text
    charts = re.findall(r"<svg.*?</svg>", text, re.DOTALL)
    assert len(charts) == 2 * 7  # for wide pages and for narrow ones
    for chart in charts[2:4]:
        path = next(e for e in ElementTree.fromstring(chart).iter("path") if e.get("class") == "refined").get("d")
        heights = np.array([pair.split(",") for pair in path[1:].split()], float)[:, 1]
        assert heights.min() < 60 and np.median(heights) > 190  # the hole of three seconds stands out


def test_letters_of_the_pictures_can_be_read_on_a_wide_and_on_a_narrow_page(examination, tmp_path, tab):
    inspection = inspect_recording(examination.recording)
    write_inspection(examination.recording, inspection, tmp_path / "page.html")
    for width in (1280, 390):
        tab.show(tmp_path / "page.html", width=width)
        tab.ask("new Promise(done => document.readyState === 'complete' ? done() : addEventListener('load', done))")
        boxes = tab.ask("[...document.querySelectorAll('figure')].map(one => [...one.querySelectorAll('svg text')]"
                        ".map(t => t.getBoundingClientRect()).filter(b => b.width)"
                        ".map(b => [b.left, b.right, b.height]))")
        assert len(boxes) == 7
        for left, right, height in np.concatenate([np.array(b) for b in boxes]):
            assert 0 <= left < right <= width and 11 <= height <= 24


def test_the_command_prints_what_to_do_and_writes_the_page(examination, tmp_path, capsys):
    write_asl(holed(examination.recording, 20.0, 23.0), tmp_path / "REC")
    assert main(["inspect", str(tmp_path / "REC"), "--html", str(tmp_path / "page.html")]) == 0
    out = capsys.readouterr().out
    assert "to do: only the motions hold the frames there" in out and "-        sync       not judged: it takes" in out
    assert (tmp_path / "page.html").is_file()
    assert main(["inspect", str(tmp_path / "REC"), "--json"]) == 0
    checks = json.loads(capsys.readouterr().out)["checks"]
    assert {"imu gaps", "vibration"} <= {check["name"] for check in checks}


@given(y=arrays(float, st.integers(1, 80), elements=st.floats(-1e5, 1e5) | st.just(np.nan)), log=st.booleans())
def test_any_series_makes_a_valid_chart_within_its_frame(y, log):
    x = np.arange(1.0, len(y) + 1)
    svg = ElementTree.fromstring(chart_svg(Chart([Curve("refined", x, y, "a <b>")], "x", "y", log=log), EVIL))
    drawn = 0
    for path in svg.iter("path"):
        if path.get("class") == "refined" and "," in path.get("d") and "V" not in path.get("d"):
            points = np.array([pair.split(",") for pair in path.get("d")[1:].split()], float)
            assert (points >= 0).all() and (points <= [WIDTH, HEIGHT]).all()
            drawn += len(points)
    shown = np.isfinite(y) & ((y > 0) if log else True)
    assert drawn >= shown.sum()
