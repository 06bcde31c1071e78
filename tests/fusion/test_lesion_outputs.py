"""Located lesions on disk, and places that cannot be located."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fusion import LesionTable, Sighting, locate, write_lesions
from fusion.lesions.table import COLUMNS
from vio.errors import LesionError, RecordingError, VioError

# ---- outputs ---------------------------------------------------------------------------------

def table_of(case, *labels: str) -> LesionTable:
    return locate(case.refined, [Sighting(label, "finding", 20 * k, None, None, "x") for k, label in enumerate(labels)])


def read_csv(folder: Path) -> list[dict[str, str]]:
    with (folder / "lesions.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_output_has_the_columns_of_the_contract(case, tmp_path):
    table = locate(case.refined, case.rows(labels={1: "Pylorus", 8: "Ileocecal valve"}), depth=case.depth,
                   recording=case.recording)
    write_lesions(table, tmp_path)
    rows = read_csv(tmp_path)
    stored = json.loads((tmp_path / "lesions.json").read_text())
    assert stored["schema"] == 1 and stored["percent_between"] == ["Pylorus", "Ileocecal valve"]
    assert list(rows[0]) == list(COLUMNS) and len(rows) == len(stored["lesions"]) == 10
    for row, entry in zip(rows, stored["lesions"], strict=True):
        for key in COLUMNS:
            assert row[key] == "" if entry[key] is None else (
                row[key] == entry[key] if isinstance(entry[key], str) else float(row[key]) == pytest.approx(entry[key]))
        assert entry["sd_major_mm"] >= entry["sd_mid_mm"] >= entry["sd_minor_mm"] >= 0
        sd = np.sqrt(np.linalg.eigvalsh(np.array(entry["cov_mm2"])))[::-1]
        np.testing.assert_allclose(sd, [entry[f"sd_{axis}_mm"] for axis in ("major", "mid", "minor")], rtol=1e-6)


@pytest.mark.parametrize("label", ["=1+1", "+1", "-1", "@SUM(A1)", '=HYPERLINK("http://x","y")'])
def test_a_spreadsheet_runs_no_label(case, tmp_path, label):
    write_lesions(table_of(case, label), tmp_path)
    row, = read_csv(tmp_path)
    assert row["label"] == "'" + label
    assert json.loads((tmp_path / "lesions.json").read_text())["lesions"][0]["label"] == label


def test_somebodys_own_list_is_never_replaced(case, tmp_path):
    (tmp_path / "lesions.csv").write_text("label,frame\nmine,3\n")
    with pytest.raises(VioError, match="was not written by capsule-vio; choose another --out"):
        write_lesions(table_of(case, "x"), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["lesions.csv"]
    assert "mine" in (tmp_path / "lesions.csv").read_text()


def test_a_full_disk_leaves_what_was_there(case, tmp_path, monkeypatch):
    write_lesions(table_of(case, "before"), tmp_path)
    before = (tmp_path / "lesions.csv").read_bytes()

    def full(*_args: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("vio.atomic.os.replace", full)
    with pytest.raises(VioError, match="No space left"):
        write_lesions(table_of(case, "after"), tmp_path)
    assert (tmp_path / "lesions.csv").read_bytes() == before and len(list(tmp_path.iterdir())) == 2


# ---- unusable places -------------------------------------------------------------------------

@pytest.mark.parametrize(("sighting", "words"), [
    (Sighting("x", "finding", 450, None, None, "L line 2"), "L line 2: frame 450 is outside .* frames 0 to 449"),
    (Sighting("x", "finding", None, 151.0, None, "L line 2"), "L line 2: 151 s is outside the trajectory"),
    (Sighting("x", "finding", None, -3.0, None, "L line 2"), "outside the trajectory"),
    (Sighting("x", "finding", 3, None, (400.0, 3.0), "L line 2"), "pixel 400, 3 lies outside the image of 320 x 320"),
])
def test_places_outside_are_refused_in_one_line(case, sighting, words):
    with pytest.raises(LesionError, match=words) as caught:
        locate(case.refined, [sighting])
    assert "\n" not in str(caught.value)


def test_a_time_in_a_hole_between_frames_shows_nothing(case):
    t = case.refined.trajectory.t_s
    keep = (t < 20) | (t > 30)
    gapped = replace(case.refined, trajectory=case.refined.trajectory.select(keep), joint=None,
                     log_scale=case.refined.log_scale[keep], log_scale_sd=case.refined.log_scale_sd[keep])
    with pytest.raises(LesionError, match=r"no frame within 0\.5 s of 25 s"):
        locate(gapped, [Sighting("x", "finding", None, 25.0, None, "x")])


def test_another_recording_is_refused(case, examine):
    other = examine("colon", "none", 0, 12.0, 3).recording
    with pytest.raises(RecordingError, match="does not have the frames of the trajectory"):
        locate(case.refined, [Sighting("x", "finding", 3, None, None, "x")], recording=other)


@pytest.mark.parametrize("sd", [0.0, -1.0, 1.0, float("nan")])
def test_an_impossible_depth_error_is_refused(case, sd):
    with pytest.raises(LesionError, match="between 0 and 1"):
        locate(case.refined, [Sighting("x", "finding", 3, None, None, "x")], depth_relative_sd=sd)


def test_a_folder_without_depth_is_refused(case, tmp_path):
    with pytest.raises(VioError, match=r"no data\.csv"):
        locate(case.refined, [Sighting("x", "finding", 3, None, None, "x")], depth=tmp_path)
    for file in ("data.csv", "sensor.yaml"):
        (tmp_path / file).write_bytes((case.depth / file).read_bytes())
    with pytest.raises(VioError, match=r"no prediction\.json"):
        locate(case.refined, [Sighting("x", "finding", 3, None, None, "x")], depth=tmp_path)
