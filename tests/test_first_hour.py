"""The tutorial, followed literally: every command, file and snippet of docs/first_hour.md, in order."""

import json
import re
import shlex
from pathlib import Path

import pytest

from fusion.cli import main

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "first_hour.md"


def blocks() -> list[tuple[str, str]]:
    """(info string, content) of every fenced block, in order."""
    return re.findall(r"^```(.*?)\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def test_every_step_of_the_first_hour_works(tmp_path, monkeypatch, capsys):
    pytest.importorskip("numba", reason="rendering needs the extra 'sim'")
    monkeypatch.chdir(tmp_path)
    commands = []
    for kind, content in blocks():
        if kind == "sh":
            for line in content.splitlines():
                assert main(shlex.split(line)[1:]) == 0, line
                commands.append(shlex.split(line)[1])
        elif kind == "python":
            exec(compile(content, PAGE.name, "exec"), {})
        elif kind.startswith("csv "):
            Path(kind.split()[1]).write_text(content, encoding="utf-8")
        else:
            assert kind == "console", f"what is {kind!r}?"
    assert {"doctor", "simulate", "refine", "locate", "report", "compare", "convert", "inspect", "predict"} <= {
        *commands}
    rows = json.loads(Path("run/lesions.json").read_text(encoding="utf-8"))["lesions"]
    assert [row["label"] for row in rows] == ["Pylorus", "angiectasia", "polyp", "Ileocecal valve"]
    assert len(rows[1]["sightings"]) == 2 and rows[2]["percent_path"] is not None
    assert all("no depth was given" in row["status"] for row in rows)  # as the page says
    assert json.loads(Path("run/summary.json").read_text())["accuracy"]["refined"]["se3"]["ate_rmse_m"] < 0.01
    for made in ("run/report.html", "compared/comparison.json", "compared/truth.tum", "compared/run_refined.tum",
                 "inspection.html", "my-run/report.html", "depth/data.csv"):
        assert Path(made).is_file(), made
    text = capsys.readouterr().out
    assert "significantly" in text or "beats" in text


def test_what_the_page_points_to_exists():
    text = PAGE.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)]+)\)", text):
        assert (PAGE.parent / target).exists(), target
    for example in re.findall(r"`(examples/\d\d_\w+\.py)`", text):
        assert (ROOT / example).is_file(), example
