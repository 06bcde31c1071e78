"""Every error of the contract, through the command line: one line on stderr, its exit code, a remedy, nothing left."""

import argparse
import ast
import importlib.util
import re
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import fusion.cli
import learned.errors  # noqa: F401, its errors are walked too
from fusion.cli import main
from fusion.cli_parser import build_parser
from tests.vio.samples import film, own_images
from vio.errors import VioError
from vio.motions import load_motions

ROOT = Path(__file__).resolve().parents[1]
PATIENT = "Erika_Mustermann_1964"
REMEDY = re.compile(r"; |\bgive\b|\bmust\b|\bneed|\bexpected\b|\bchoose\b|\binstall\b|\bsay\b|\buse\b")


def errors(kind: type[VioError] = VioError) -> list[type[VioError]]:
    return [kind, *(deeper for sub in kind.__subclasses__() for deeper in errors(sub))]


def stderr_line(capsys: pytest.CaptureFixture[str]) -> str:
    lines = [line for line in capsys.readouterr().err.split("\n") if line and not line.startswith("…")]
    assert len(lines) == 1, lines
    return lines[0]


@pytest.mark.parametrize("kind", errors(), ids=lambda kind: kind.__name__)
def test_every_kind_of_error_becomes_one_line_and_its_exit_code(kind, monkeypatch, capsys):
    """Even where a file name holds a line break or a terminal's escape sequence."""
    def fail(_: argparse.Namespace) -> int:
        raise kind("file a\nb\x1b[2J.csv: 7 rows (limit 3); cut it")

    monkeypatch.setattr(fusion.cli, "_doctor", fail)
    code = main(["doctor"])
    assert code == kind.exit_code and code in (2, 3, 4)
    line = stderr_line(capsys)
    assert line == "capsule-vio doctor: file a b [2J.csv: 7 rows (limit 3); cut it"


def test_bugs_are_not_dressed_up_as_bad_input(monkeypatch):
    def fail(_: argparse.Namespace) -> int:
        raise ZeroDivisionError

    monkeypatch.setattr(fusion.cli, "_doctor", fail)
    with pytest.raises(ZeroDivisionError):
        main(["doctor"])


def test_no_message_in_the_library_has_two_lines():
    """Every `raise SomeError(...)` of every module, as written."""
    names, seen = {kind.__name__ for kind in errors()}, 0
    for file in (f for package in ("vio", "learned", "fusion") for f in (ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and (
                    ast.unparse(node.exc.func).split(".")[-1] in names):
                text = [c.value for c in ast.walk(node.exc) if isinstance(c, ast.Constant) and isinstance(c.value, str)]
                assert not any("\n" in part for part in text), f"{file.name}:{node.lineno}"
                seen += 1
    assert seen > 300


def commands() -> dict[str, argparse.ArgumentParser]:
    found = next(action for action in build_parser()._actions if isinstance(action, argparse._SubParsersAction))
    return dict(found.choices)


@pytest.mark.parametrize("command", commands())
def test_help_of_every_command_shows_an_example_that_parses(command, capsys):
    with pytest.raises(SystemExit) as stopped:
        main([command, "--help"])
    assert stopped.value.code == 0
    shown = " ".join(capsys.readouterr().out.split())
    example = re.search(r"example: capsule-vio (.+)$", shown).group(1)
    assert example.split()[0] == command
    parsed = build_parser().parse_args(example.split())
    assert parsed.command == command
    assert command in (fusion.cli.__doc__ or "")


# ---- bad input, command by command ------------------------------------------------------------------

@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """REC, motions.npz and RUN, all of a patient whose name is in every input path."""
    folder = tmp_path_factory.mktemp("errors") / PATIENT
    scenario = ["--organ", "colon", "--vibration", "gaussian", "--level", "1", "--duration", "20", "--seed", "6"]
    rec, motions = folder / f"{PATIENT}_REC", folder / f"{PATIENT}.npz"
    assert main(["simulate", *scenario, "--no-images", "--out", str(rec), "--motions", str(motions)]) == 0
    assert main(["refine", str(rec), "--motions", str(motions), "--out", str(folder.parent / "RUN")]) == 0
    return folder


@pytest.fixture
def place(made, tmp_path) -> dict[str, Path]:
    """Copies that a test may spoil."""
    shutil.copytree(made / f"{PATIENT}_REC", tmp_path / "REC")
    shutil.copytree(made.parent / "RUN", tmp_path / "RUN")
    shutil.copy(made / f"{PATIENT}.npz", tmp_path / "m.npz")
    return {"REC": tmp_path / "REC", "RUN": tmp_path / "RUN", "m.npz": tmp_path / "m.npz", "": tmp_path}


def spoil_text(name: str, change: Callable[[str], str]) -> Callable[[dict[str, Path]], None]:
    def spoil(place: dict[str, Path]) -> None:
        path = place[""] / name
        path.write_text(change(path.read_text(encoding="utf-8")), encoding="utf-8")
    return spoil


def write(name: str, content: bytes | str) -> Callable[[dict[str, Path]], None]:
    def spoil(place: dict[str, Path]) -> None:
        path = place[""] / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    return spoil


def only_wide(place: dict[str, Path]) -> None:
    """Motions that skip a frame: an EKF, which joins neighbours, can do nothing with them."""
    m = load_motions(place["m.npz"])
    np.savez(place["m.npz"], t_i=m.t_i_s[:-1:2], t_j=m.t_j_s[1::2], T_i_j=m.T_i_j[:-1:2], cov=m.cov[:-1:2],
             scale_log_mean=m.scale_log_mean, scale_log_sd=m.scale_log_sd)


def cut_film(name: str, table: bool) -> Callable[[dict[str, Path]], None]:
    """A film of 20 frames of which the second half is missing."""
    def spoil(place: dict[str, Path]) -> None:
        path = place[""] / name
        film(path, np.random.default_rng(0).integers(0, 255, (20, 64, 64, 3), dtype=np.uint8), "MJPG")
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        if table:
            path.with_suffix(".csv").write_text("t_ms\n" + "".join(f"{250 * k}\n" for k in range(20)))
    return spoil


def images_naming(name: str) -> Callable[[dict[str, Path]], None]:
    """One's own images, of which the table's second row names a file elsewhere."""
    def spoil(place: dict[str, Path]) -> None:
        own_images(place[""]).root.rename(place[""] / "MINE")
        write("x.png", b"elsewhere")(place)
        spoil_text("MINE/frames.csv", lambda text: text.replace("shots/1.png", name))(place)
    return spoil


def depth_naming(name: str) -> Callable[[dict[str, Path]], None]:
    def spoil(place: dict[str, Path]) -> None:
        write("L.csv", "label,frame\na,3\n")(place)
        write("D/data.csv", f"#timestamp [ns],filename\n0,{name}\n")(place)
        write("D/sensor.yaml", "depth_unit_m: 1.0e-05\n")(place)
        write("D/prediction.json", "{}")(place)
    return spoil


REFINE = ["refine", "REC", "--motions", "m.npz", "--out", "OUT"]
LOCATE = ["locate", "RUN", "--lesions", "L.csv", "--out", "OUT"]
IMU, CAM = "REC/mav0/imu0/data.csv", "REC/mav0/cam0/data.csv"
CASES = {
    "no recording": (lambda p: None, ["refine", "NOWHERE", "--motions", "m.npz", "--out", "OUT"], 3, "no such"),
    "no motions": (lambda p: p["m.npz"].unlink(), REFINE, 3, "m.npz"),
    "motions of text": (write("m.npz", "hello"), REFINE, 3, "npz"),
    "pickled motions": (lambda p: np.savez(p["m.npz"], t_i=np.array([{}], object)), REFINE, 3, "npz"),
    "zip bomb's shape": (lambda p: zipfile.ZipFile(p["m.npz"], "w").writestr("../../t_i.npy", "x"), REFINE, 3, "m.npz"),
    "imu with semicolons": (spoil_text(IMU, lambda t: t.replace(",", ";")), REFINE, 3, "imu0/data.csv"),
    "imu without a column": (spoil_text(IMU, lambda t: "\n".join(r.rsplit(",", 1)[0] for r in t.split("\n"))),
                             REFINE, 3, "imu0/data.csv"),
    "imu not UTF-8": (write(IMU, "#timestamp [ns],größe\n".encode("latin-1")), REFINE, 3, "imu0/data.csv"),
    "image outside": (spoil_text(CAM, lambda t: re.sub(r"(?m)^(\d+),.*$", r"\1,../../../etc/passwd", t)), REFINE, 3,
                      "not a plain file name"),
    "depth outside": (depth_naming("../../x.png"), [*LOCATE, "--depth", "D"], 3,
                      "'../../x.png' is not a plain file name"),
    "own image outside": (images_naming("../x.png"), ["convert", "MINE", "--to", "asl", "OUT"], 3,
                          "line 3: '../x.png'"),
    "absolute image": (images_naming("/etc/passwd"), ["inspect", "MINE"], 3, "'/etc/passwd' is not a file name below"),
    "half a film": (cut_film("f.avi", True), ["convert", "f.avi", "--to", "asl", "OUT"], 3,
                    re.compile(r"f\.csv lists 20 times; frames 0 to \d \(0 to (1\.75|2\.0|2\.25)0* s\) can be used")),
    "half a film without times": (cut_film("f.avi", False),
                                  ["convert", "f.avi", "--to", "asl", "OUT", "--presentation-times"], 3,
                                  re.compile(r"of 20 frames decode; frames 0 to \d \(0 to 0\.")),
    "unknown key": (write("c.yaml", "sovler: {}"), [*REFINE, "--config", "c.yaml"], 3, "sovler"),
    "nothing for the filter": (only_wide, [*REFINE, "--estimator", "ekf"], 4, "ekf"),
    "weights that are not there": (lambda p: None, ["refine", "REC", "--weights", "w.safetensors", "--out", "OUT"], 3,
                                   "w.safetensors"),
    "loops of text": (write("l.npz", "hello"), [*REFINE, "--loops-from", "l.npz"], 3, "l.npz"),
    "loops online": (lambda p: None, [*REFINE, "--online", "--loops"], 2, "--online"),
    "foreign output": (write("OUT/thesis.txt", "mine"), REFINE, 3, "choose another --out"),
    "lesions with semicolons": (write("L.csv", "label;frame\na;3\n"), LOCATE, 3, "semicolons"),
    "lesions with tabs": (write("L.csv", "label\tframe\na\t3\n"), LOCATE, 3, "tabs"),
    "lesions without label": (write("L.csv", "frame\n3\n"), LOCATE, 3, "label"),
    "lesions without frame": (write("L.csv", "label\na\n"), LOCATE, 3, "timestamp_s"),
    "lesion outside": (write("L.csv", "label,frame\na,3\nb,900\n"), LOCATE, 3, "line 3: frame 900 is outside"),
    "lesion before": (write("L.csv", "label,timestamp_s\na,-5\n"), LOCATE, 3, "outside"),
    "duplicate ids": (write("L.csv", "id,label,frame\n1,a,3\n1,b,4\n"), LOCATE, 3, "id '1'"),
    "lesions not UTF-8": (write("L.csv", "label,frame\nGeschwür,3\n".encode("latin-1")), LOCATE, 3, "line 2: not UTF"),
    "no lesions": (write("L.csv", "label,frame\n"), LOCATE, 3, "lists nothing"),
    "no list": (lambda p: None, LOCATE, 3, "no such file"),
    "no depth": (write("L.csv", "label,frame\na,3\n"), [*LOCATE, "--depth", "NOWHERE"], 3, "NOWHERE"),
    "no run": (lambda p: None, ["report", "REC"], 3, "summary.json"),
    "damaged run": (write("RUN/summary.json", "{"), ["report", "RUN"], 3, "not valid JSON"),
    "damaged lesions": (write("RUN/lesions.json", "[]"), ["report", "RUN"], 3, "locate"),
    "compared with nothing": (lambda p: (p["RUN"] / "truth.tum").unlink(), ["compare", "RUN"], 3, "--truth"),
    "compared with text": (write("t.tum", "one two three"), ["compare", "RUN", "--truth", "t.tum"], 3, "t.tum"),
    "another's clock": (write("t.tum", "99999 0 0 0 0 0 0 1\n"), ["compare", "RUN", "--truth", "t.tum"], 3,
                        "one clock"),
    "no images to predict on": (lambda p: None, ["predict", "REC", "--out", "OUT.npz"], 3, "image"),
    "no such weights": (lambda p: None, ["predict", "REC", "--weights", "w.safetensors", "--out", "OUT.npz"], 3,
                        "weights"),
    "weights of text": (write("w.safetensors", "hello"), ["predict", "REC", "--weights", "w.safetensors", "--out",
                                                          "OUT.npz"], 3, "w.safetensors"),
    "judged without images": (lambda p: None, ["evaluate", "REC"], 3, "image"),
    "trained on nothing": (lambda p: None, ["train", "REC", "--out", "OUT"], 3, "image"),
    "taught by too few": (lambda p: None, ["train", "REC", "REC", "--refined", "RUN", "--out", "OUT"], 2,
                          "1 runs for 2"),
    "taught by no run": (lambda p: None, ["train", "REC", "--refined", "REC", "--out", "OUT"], 3, "summary.json"),
    "nothing to view": (lambda p: None, ["view", "REC", "--out", "OUT.rrd"], 3, "summary.json"),
    "nothing to measure on": (lambda p: None, ["benchmark", "fusion", "--data", "REC", "--budget", "smoke", "--out",
                                               "OUT"], 3, "simulate --dataset"),
    "foreign demo": (write("OUT", "mine"), ["demo", "--out", "OUT"], 3, "choose"),
    "unknown format": (write("STRANGE/a.bin", "x"), ["convert", "STRANGE", "--to", "asl", "OUT"], 3, "STRANGE"),
    "half a declaration": (lambda p: None, ["convert", "REC", "--to", "asl", "OUT", "--imu-calibration", "i.yaml"], 2,
                           "--calibration"),
    "impossible level": (lambda p: None, ["simulate", "--level", "9", "--out", "OUT"], 3, "0 to 5"),
    "nothing to inspect": (lambda p: None, ["inspect", "NOWHERE"], 3, "NOWHERE"),
}


@pytest.mark.parametrize("case", CASES)
def test_bad_input_is_one_line_with_exit_code_and_remedy_and_leaves_nothing(place, monkeypatch, capsys, case):
    spoil, arguments, code, word = CASES[case]
    spoil(place)
    monkeypatch.chdir(place[""])
    before = {path: path.read_bytes() for path in place[""].rglob("*") if path.is_file()}
    capsys.readouterr()
    assert main(arguments) == code
    line = stderr_line(capsys)
    said = word.search(line) if isinstance(word, re.Pattern) else word in line
    assert line.startswith(f"capsule-vio {arguments[0]}: ") and said and REMEDY.search(line), line
    assert str(place[""]) not in line and "Traceback" not in line
    assert {path: path.read_bytes() for path in place[""].rglob("*") if path.is_file()} == before


def test_every_command_and_every_exit_code_has_its_bad_input():
    """`doctor` takes no input; what it finds missing it lists. 1 is a bug, above."""
    assert {arguments[0] for _, arguments, _, _ in CASES.values()} == {*commands()} - {"doctor"}
    assert {code for _, _, code, _ in CASES.values()} == {kind.exit_code for kind in errors()} == {2, 3, 4}


def test_no_name_of_a_patient_in_an_input_path_reaches_an_output(made, tmp_path, monkeypatch, capsys):
    rec, motions, lesions = made / f"{PATIENT}_REC", made / f"{PATIENT}.npz", made / f"{PATIENT}.csv"
    lesions.write_text("label,frame\npolyp,12\n", encoding="utf-8")
    (made / f"{PATIENT}.yaml").write_text("estimator: graph\n", encoding="utf-8")
    out = tmp_path / "OUT"
    assert main(["refine", str(rec), "--motions", str(motions), "--config", str(made / f"{PATIENT}.yaml"), "--out",
                 str(out / "RUN")]) == 0
    assert main(["locate", str(out / "RUN"), "--lesions", str(lesions)]) == 0
    assert main(["report", str(out / "RUN"), "--recording", str(rec)]) == 0
    assert main(["inspect", str(rec), "--html", str(out / "inspection.html")]) == 0
    shutil.copytree(made.parent / "RUN", made / "second", dirs_exist_ok=True)
    assert main(["compare", str(out / "RUN"), str(made / "second"), "--out", str(out / "compared")]) == 0
    own = own_images(tmp_path / "in").root
    (own / "shots").rename(own / PATIENT)
    spoilt = (own / "frames.csv").read_text().replace("shots/", f"{PATIENT}/")
    (own / "frames.csv").write_text(spoilt)
    assert main(["convert", str(own), "--to", "asl", str(out / "OWN")]) == 0
    assert main(["convert", str(own), "--to", "kalibr", str(out / "KALIBR")]) == 0
    (own / PATIENT / "0.png").write_bytes(b"none")
    assert main(["inspect", str(own), "--html", str(out / "damaged.html")]) == 0
    assert "its file is not an image" in (out / "damaged.html").read_text(encoding="utf-8")
    assert main(["convert", str(rec), "--to", "asl", str(out / "REC")]) == 0
    if importlib.util.find_spec("rerun") is not None:
        assert main(["view", str(out / "RUN"), "--recording", str(rec), "--out", str(out / "run.rrd")]) == 0
    monkeypatch.chdir(made)  # typed as `.`, a folder is called nothing
    assert main(["compare", str(out / "RUN"), "second", "--out", str(out / "compared2")]) == 0
    monkeypatch.chdir(rec)
    assert main(["inspect", "."]) == 0
    assert main(["refine", ".", "--motions", "nowhere.npz", "--out", str(out / "RUN2")]) == 3
    said = capsys.readouterr()
    assert PATIENT not in "".join(line for line in (said.out + said.err).splitlines()[-12:])
    files = [path for path in out.rglob("*") if path.is_file()]
    assert len(files) > 20
    for path in files:  # of convert's image files the content is the source's, see docs/formats.md
        assert PATIENT not in path.name and PATIENT.encode() not in path.read_bytes(), path.name
    for archive in out.rglob("*.npz"):
        with np.load(archive) as data:
            assert all(PATIENT not in str(data[key]) for key in data.files)
