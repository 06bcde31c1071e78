"""Lists of lesions: what is read, and what is refused in one line."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion import Sighting, read_sightings
from vio.errors import LesionError

KVASIR = ("filename;video_id;frame_number;finding_category;finding_class;x1;y1;x2;y2;x3;y3;x4;y4\n"
          "a.jpg;v1;10;Anatomy;Pylorus;;;;;;;\n"  # 12 fields, as the data set has them
          "b.jpg;v1;31204;Luminal;Angiectasia;10;20;30;20;30;60;10;60\n"
          "c.jpg;v1;31300;Luminal;Normal clean mucosa;;;;;;;;\n"
          "d.jpg;v1;60000;Anatomy;Ileocecal valve;;;;;;;;\n")


def read(tmp_path: Path, text: str | bytes, **options: str) -> list[Sighting]:
    path = tmp_path / "L.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_sightings(path, **options)


def test_simple_csv(tmp_path):
    rows = read(tmp_path, '\ufefflabel,frame,timestamp_s,u,v,kind,id,doctor\r\n"polyp, flat",31204,,12.5,80,,A7,who\r\n'
                          "Pylorus,,4.25,,,landmark,,\r\n\r\nulcer,7\r\n")
    assert [(r.label, r.kind, r.frame, r.timestamp_s, r.pixel, r.id) for r in rows] == [
        ("polyp, flat", "finding", 31204, None, (12.5, 80.0), "A7"), ("Pylorus", "landmark", None, 4.25, None, None),
        ("ulcer", "finding", 7, None, None, None)]
    assert rows[0].where == "L.csv line 2" and rows[2].where == "L.csv line 5"


def test_kvasir_capsule(tmp_path):
    rows = read(tmp_path, KVASIR)
    assert [(r.label, r.kind, r.frame, r.pixel) for r in rows] == [
        ("Pylorus", "landmark", 10, None), ("Angiectasia", "finding", 31204, (20.0, 40.0)),
        ("Ileocecal valve", "landmark", 60000, None)]


def test_one_video_of_several(tmp_path):
    text = KVASIR + "e.jpg;v2;3;Luminal;Ulcer;;;;;;;\n"
    assert [r.label for r in read(tmp_path, text, video="v2")] == ["Ulcer"]
    with pytest.raises(LesionError, match=r"lists 2 videos \(v1, v2, …\).*--video"):
        read(tmp_path, text)
    with pytest.raises(LesionError, match="no video 'v3'"):
        read(tmp_path, text, video="v3")


BROKEN = [
    ("label;frame\nx;3\n", r"L\.csv: its columns are separated by semicolons; separate them by commas"),
    ("label\tframe\nx\t3\n", "separated by tabs"),
    ("", "no column `label`"), ("frame,u,v\n3,1,1\n", "no column `label`"), ("label,u,v\nx,1,1\n", "neither a column"),
    ("label,frame,u\nx,3,1\n", "only one of the columns `u` and `v`"),
    ("label,frame,frame\nx,3,4\n", "column 'frame' is there twice"),
    ("label,frame\n", "lists nothing"), ("label,frame\nx,3,surplus\n", "line 2: 3 fields under 2 columns"),
    ("label,frame\n,3\n", "line 2: the label is empty"), ("label,frame\nx,\n", "line 2: gives neither frame nor"),
    ("label,frame,timestamp_s\nx,3,1.0\n", "line 2: gives both frame and timestamp_s"),
    ("label,frame\nx,3\ny,3.5\n", r"line 3: frame is '3\.5'; give a whole number"),
    ("label,frame\nx,-1\n", "line 2: frame is -1; frames are counted from 0"),
    ("label,timestamp_s\nx,nan\n", "line 2: timestamp_s is 'nan'; give a finite number"),
    ("label,timestamp_s\nx,soon\n", "line 2: timestamp_s is 'soon'; give a number"),
    ("label,frame,u,v\nx,3,1,\n", "line 2: v is ''; give a number"),
    ("label,frame,kind\nx,3,tumour\n", "line 2: kind is 'tumour'; write finding or landmark"),
    ("label,frame,id\nx,3,A\ny,4,A\n", r"line 3: id 'A' is also in L\.csv line 2"),
    (f"label,frame\n{'x' * 201},3\n", "a label of 201 characters"),
    ('label,frame\n"x,3\n', r"not valid CSV \(.*\); repair the quotes"),
    ("label,frame\nGeschwür,3\n".encode("latin-1"), "line 2: not UTF-8"),
    ("label,frame\nx,3\n".encode("utf-16"), "not UTF-8"), ("label,frame\nx\0,3\n", "zero bytes"),
    (KVASIR + "e.jpg;v1;3;Luminal\n", r"line 6: 4 fields; Kvasir-Capsule's rows have 13, or 12 without a box"),
    (KVASIR + "e.jpg;v1;3;Luminal;Ulcer;1;2;3;4;;;;\n", "line 6: 4 numbers for a box"),
    (KVASIR + "e.jpg;v1;3;Luminal;Ulcer;1;2;3;4;a;6;7;8\n", "a corner of the box is 'a'"),
]


@pytest.mark.parametrize(("text", "words"), BROKEN, ids=[words[:40] for _, words in BROKEN])
def test_what_cannot_be_used_is_refused_in_one_line(tmp_path, text, words):
    with pytest.raises(LesionError, match=words) as caught:
        read(tmp_path, text)
    message = str(caught.value)
    assert "\n" not in message and str(tmp_path) not in message


def test_a_missing_file_and_a_folder(tmp_path):
    with pytest.raises(LesionError, match="no such file"):
        read_sightings(tmp_path / "none.csv")
    with pytest.raises(LesionError, match="cannot be read"):
        read_sightings(tmp_path)


@given(st.binary(max_size=300))
def test_any_bytes_are_read_or_refused(tmp_path_factory, content):
    path = tmp_path_factory.mktemp("any") / "L.csv"
    path.write_bytes(b"label,frame\n" + content)
    try:
        rows = read_sightings(path)
    except LesionError as error:
        assert "\n" not in str(error)
    else:
        assert all(row.label.isprintable() and row.label == row.label.strip() and row.frame >= 0 for row in rows)
