"""Lesions on the command line and in the report, in a real browser where there is one."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from fusion import Provenance, RefineConfig, read_lesions, write_run
from fusion.cli import main
from vio.errors import FormatError

EVIL = '<img src=x onerror=alert(1)></script><b>'
LIST = ("label,frame,kind\nPylorus,20,landmark\n=1+1,120,finding\n"
        f'"{EVIL}",150,finding\nIleocecal valve,280,landmark\n')


@pytest.fixture(scope="module")
def run(refined, examination, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("report") / "RUN"
    write_run(refined, out, Provenance(["refine"], RefineConfig(), {}), examination.motions)
    (out.parent / "L.csv").write_text(LIST, encoding="utf-8")
    assert main(["locate", str(out), "--lesions", str(out.parent / "L.csv")]) == 0
    assert main(["report", str(out)]) == 0
    return out


def page(run: Path) -> str:
    return (run / "report.html").read_text(encoding="utf-8")


def figures(text: str) -> dict:
    found = re.search(r'<script type="application/json" id="figures">(.*?)</script>', text, re.DOTALL)
    return json.loads(found.group(1))


def test_locate_prints_a_table_or_json_alone(run, tmp_path, capsys):
    arguments = ["locate", str(run), "--lesions", str(run.parent / "L.csv"), "--out", str(tmp_path / "out")]
    assert main(arguments) == 0
    text = capsys.readouterr().out
    assert "Pylorus" in text and "no depth was given" in text
    assert main([*arguments, "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["lesions"]
    assert [row["label"] for row in rows] == ["Pylorus", "=1+1", EVIL, "Ileocecal valve"]
    assert json.loads((tmp_path / "out" / "lesions.json").read_text())["lesions"] == rows
    assert rows == read_lesions(run)


@pytest.mark.parametrize(("text", "words"), [("label;frame\nx;1\n", "semicolons"),
                                             ("label,frame\nx,9999\n", "outside")])
def test_unusable_lists_exit_3_with_one_line_and_write_nothing(run, tmp_path, capsys, text, words):
    (tmp_path / "L.csv").write_text(text)
    assert main(["locate", str(run), "--lesions", str(tmp_path / "L.csv"), "--out", str(tmp_path / "out")]) == 3
    error = capsys.readouterr().err
    assert words in error and len(error.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_what_is_no_run_exits_3(run, tmp_path, capsys):
    assert main(["locate", str(tmp_path), "--lesions", str(run.parent / "L.csv")]) == 3
    assert main(["report", str(tmp_path)]) == 3
    assert capsys.readouterr().err.count("summary.json") == 2


@pytest.mark.parametrize("spoil", ["bytes", "key", "shape", "missing"])
def test_damaged_states_are_refused_in_one_line(run, tmp_path, capsys, spoil):
    shutil.copytree(run, tmp_path / "RUN")
    path = tmp_path / "RUN" / "trajectory.npz"
    with np.load(path) as data:
        arrays = dict(data)
    if spoil == "bytes":
        path.write_bytes(path.read_bytes()[:1000])
    elif spoil == "missing":
        path.unlink()
    else:
        changed = {k: v for k, v in arrays.items() if k != "velocity"} if spoil == "key" else (
            arrays | {"joint_xi": arrays["joint_xi"][:, :5]})
        np.savez(path, **changed)
    assert main(["locate", str(tmp_path / "RUN"), "--lesions", str(run.parent / "L.csv")]) == 3
    error = capsys.readouterr().err
    assert "trajectory.npz" in error and len(error.splitlines()) == 1


def test_runs_of_earlier_versions_give_places_without_intervals(run, tmp_path):
    shutil.copytree(run, tmp_path / "RUN")
    path = tmp_path / "RUN" / "trajectory.npz"
    with np.load(path) as data:
        arrays = {k: v for k, v in data.items() if not k.startswith("joint")
                  and k not in ("T_body_camera", "camera", "first_frame", "prior_log_scale")}
    np.savez(path, **arrays)
    assert main(["locate", str(tmp_path / "RUN"), "--lesions", str(run.parent / "L.csv")]) == 0
    assert main(["report", str(tmp_path / "RUN")]) == 0
    rows = read_lesions(tmp_path / "RUN")
    assert all(row["arc_length_mm"] is not None and row["arc_lo_mm"] is None for row in rows)


def test_report_shows_lesions_with_their_intervals(run):
    text, rows = page(run), read_lesions(run)
    unrolled = figures(text)["unrolled"]
    marks = {part["name"]: part for part in unrolled["data"] if part.get("mode") == "markers+text"}
    assert marks["lesions"]["text"] == ["2", "3"] and marks["landmarks"]["text"] == ["1", "4"]
    factor = 1.0 if "[mm]" in unrolled["layout"]["yaxis"]["title"]["text"] else 1e-3
    for name, kind in (("lesions", "finding"), ("landmarks", "landmark")):
        shown = [row for row in rows if row["kind"] == kind]
        np.testing.assert_allclose(marks[name]["y"], [factor * r["arc_length_mm"] for r in shown], rtol=1e-4)
        np.testing.assert_allclose(marks[name]["error_y"]["array"],
                                   [factor * (r["arc_hi_mm"] - r["arc_length_mm"]) for r in shown], rtol=1e-3)
    space = {part["name"] for part in figures(text)["trajectory"]["data"]}
    assert {"lesions", "landmarks"} <= space
    table = text.split('<section class="lesions">')[1].split("</section>")[0]
    assert f"{rows[1]['percent_path']:.1f} [" in table and "Pylorus" in table


def test_no_label_runs_anything_in_the_report(run):
    text = page(run)
    assert EVIL not in text and "&lt;img src=x onerror=alert(1)&gt;" in text
    assert "onerror" not in json.dumps(figures(text)) and "1+1" not in json.dumps(figures(text))


def test_a_report_without_lesions_has_no_such_section(run, tmp_path):
    shutil.copytree(run, tmp_path / "RUN")
    for name in ("lesions.csv", "lesions.json"):
        (tmp_path / "RUN" / name).unlink()
    assert main(["report", str(tmp_path / "RUN")]) == 0
    assert 'class="lesions"' not in page(tmp_path / "RUN") and "unrolled" not in figures(page(tmp_path / "RUN"))


@pytest.mark.parametrize("text", ["{", "[]", '{"schema": 2, "lesions": []}', '{"schema": 1, "lesions": [{"id": "1"}]}'])
def test_damaged_lesions_are_refused(tmp_path, text):
    (tmp_path / "lesions.json").write_text(text)
    with pytest.raises(FormatError, match="run `capsule-vio locate` again"):
        read_lesions(tmp_path)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_browser_draws_the_unrolled_gut(run, tab, scheme):
    """Rendered marks, not only text: points with their bars, and no dialogue from a label."""
    tab.show(run / "report.html", scheme=scheme)
    tab.ask("window.reportDrawn ?? new Promise(done => addEventListener('load', () => done(window.reportDrawn)))")
    assert tab.ask("document.querySelectorAll('#unrolled .point').length") == 4
    assert tab.ask("document.querySelectorAll('#unrolled .yerror').length") == 4
    colour = {"light": "rgb(179, 38, 122)", "dark": "rgb(255, 143, 208)"}[scheme]
    assert tab.ask("getComputedStyle(document.querySelector('#unrolled .point')).fill") == colour
