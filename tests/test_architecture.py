"""The walls of docs/architecture.md, read from the syntax trees: who may import whom, what library code may not do."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("vio", "learned", "fusion")
LIBRARY_FILES = sorted(file for package in PACKAGES for file in (ROOT / package).rglob("*.py"))
COMMAND_LINE = ("fusion/cli.py", "fusion/cli_learned.py", "fusion/cli_output.py")
LONGEST_FILE = 350

OURS = {"vio": {"vio"}, "learned": {"learned", "vio"}, "fusion": {"fusion", "vio"}}
"""What each package may import of ours; the command line alone composes all three."""

HEAVY = {
    "torch": ("learned/",),
    "safetensors": ("learned/",),
    "transformers": ("learned/",),
    "gtsam": ("fusion/",),
    "filterpy": ("fusion/ekf.py",),
    "cv2": ("vio/", "learned/"),
    "numba": ("vio/simulation/",),
    "plotly": ("fusion/report/",),
    "matplotlib": ("fusion/report/",),
    "rerun": ("fusion/view.py",),
    "tqdm": ("fusion/cli_progress.py",),
    "argparse": ("fusion/cli.py", "fusion/cli_learned.py", "fusion/cli_parser.py"),
    "evo": (),
    "pytest": (),
    "hypothesis": (),
}
"""Where a library may be imported; `()` = in tests only."""

LIGHT = {
    "vio": ("torch", "gtsam", "filterpy", "plotly", "matplotlib", "numba", "tqdm", "learned", "fusion"),
    "learned": ("gtsam", "filterpy", "plotly", "matplotlib", "fusion"),
    "fusion": ("torch", "plotly", "matplotlib.pyplot", "learned"),
}
"""What importing a package alone must not load."""

# Split, so that this file does not hold what it looks for.
MACHINE_PATH = re.compile(r"(?<![\w.:/*])(?:/(?:home|root|tmp|work|Users|mnt|opt)/" + r"[\w.-]+|[A-Z]:\\" + r"\w+)")
TEXT_ENDINGS = {".py", ".md", ".toml", ".yaml", ".yml", ".html", ".css", ".js", ".svg", ".json", ".csv", ".txt", ""}


def name_of(file: Path) -> str:
    return file.relative_to(ROOT).as_posix()


def tree_of(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"))


def imports(file: Path) -> Iterator[str]:
    """Top packages imported anywhere in the file, inside functions too."""
    for node in ast.walk(tree_of(file)):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name_of(file)}:{node.lineno}: relative import; write the package's name"
            yield (node.module or "").split(".")[0]
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in ("import_module", "importlib.import_module"):
            yield from (arg.value.split(".")[0] for arg in node.args[:1] if isinstance(arg, ast.Constant))


def our_files() -> list[Path]:
    """Files that are part of the project: tracked by git or about to be, or everything where there is no git."""
    try:
        listed = subprocess.run(["git", "ls-files", "--cached", "--others", "--exclude-standard"],
                                cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    except (OSError, subprocess.CalledProcessError):
        names = [name_of(file) for file in ROOT.rglob("*")]
        listed = [name for name in names if not any(part.startswith(".") for part in name.split("/"))]
    files = [ROOT / name for name in listed]
    return [file for file in files if file.is_file() and file.suffix in TEXT_ENDINGS]


def test_there_is_something_to_check() -> None:
    assert len(LIBRARY_FILES) > 30 and len(our_files()) > len(LIBRARY_FILES)


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_import_only_what_they_may(package: str) -> None:
    wrong = [f"{name_of(file)} imports {other}" for file in LIBRARY_FILES for other in imports(file)
             if name_of(file).startswith(f"{package}/") and name_of(file) not in COMMAND_LINE
             and other in OURS and other not in OURS[package]]
    assert not wrong


def test_heavy_libraries_stay_in_their_rooms() -> None:
    wrong = [f"{name_of(file)} imports {library}" for file in LIBRARY_FILES for library in imports(file)
             if library in HEAVY and not name_of(file).startswith(HEAVY[library] or ("nowhere",))]
    assert not wrong


def test_every_library_is_declared() -> None:
    allowed = {*sys.stdlib_module_names, *HEAVY, *PACKAGES, "numpy", "scipy", "yaml"}
    assert not {f"{name_of(file)} imports {library}" for file in LIBRARY_FILES for library in imports(file)
                if library not in allowed}


def test_the_table_in_the_document_is_this_one() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| ([\w ,]+) \| (.+?) \|$", text, re.MULTILINE))
    documented = {library: places for names, places in rows.items() for library in names.split(", ")}
    for library, places in HEAVY.items():
        assert library in documented, f"docs/architecture.md does not say where {library} may be imported"
        assert set(re.findall(r"`([\w/.]+)`", documented[library])) == set(places), library


@pytest.mark.parametrize("package", PACKAGES)
def test_importing_a_package_loads_no_more_than_it_needs(package: str) -> None:
    script = f"import sys, {package}; print(*[name for name in {LIGHT[package]!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []


def test_only_the_command_line_prints_or_exits() -> None:
    calls = {"print", "input", "breakpoint", "exit", "quit", "sys.exit"}
    wrong = [f"{name_of(file)}:{node.lineno}" for file in LIBRARY_FILES if name_of(file) not in COMMAND_LINE
             for node in ast.walk(tree_of(file)) if isinstance(node, ast.Call) and ast.unparse(node.func) in calls]
    assert not wrong


def test_no_error_is_swallowed() -> None:
    too_much = {"Exception", "BaseException"}
    wrong = []
    for file in LIBRARY_FILES:
        for node in ast.walk(tree_of(file)):
            if isinstance(node, ast.ExceptHandler) and (
                node.type is None or too_much & {n.id for n in ast.walk(node.type) if isinstance(n, ast.Name)}
            ):
                wrong.append(f"{name_of(file)}:{node.lineno} catches everything")
    assert not wrong


def test_nothing_is_left_for_later() -> None:
    words = re.compile(r"\b(TODO|FIXME|XXX|NotImplementedError)\b")
    wrong = [f"{name_of(file)}: {found.group()}" for file in LIBRARY_FILES
             for found in [words.search(file.read_text(encoding="utf-8"))] if found]
    vague = [name_of(file) for file in LIBRARY_FILES if file.stem in ("utils", "util", "helpers", "misc", "common")]
    assert not wrong and not vague


def test_everything_public_is_explained() -> None:
    wrong = []
    for file in LIBRARY_FILES:
        tree = tree_of(file)
        if ast.get_docstring(tree) is None:
            wrong.append(name_of(file))
        for node in [*tree.body, *(inner for outer in tree.body if isinstance(outer, ast.ClassDef)
                                   and not outer.name.startswith("_") for inner in outer.body)]:
            public = isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef))
            if public and not node.name.startswith("_") and ast.get_docstring(node) is None:
                wrong.append(f"{name_of(file)}:{node.lineno} {node.name}")
    assert not wrong


def test_no_file_is_too_long() -> None:
    long = {name_of(file): lines for file in our_files() if file.suffix == ".py"
            and (lines := len(file.read_text(encoding="utf-8").splitlines())) > LONGEST_FILE}
    assert not long


def test_no_path_of_anybodys_machine_is_in_a_file() -> None:
    assert MACHINE_PATH.search('open("' + "/home" + '/jane/data.csv")') and not MACHINE_PATH.search("../shared/data")
    wrong = [f"{name_of(file)}: {found.group()}" for file in our_files()
             for found in [MACHINE_PATH.search(file.read_text(encoding="utf-8", errors="replace"))] if found]
    assert not wrong


def test_the_document_names_every_module_and_no_other() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    for package in PACKAGES:
        room = re.search(rf"^### {package}: .*?(?=^#{{2,3}} )", text, re.MULTILINE | re.DOTALL).group()
        named = set(re.findall(r"`(\w+\.py)`", room))
        there = {file.name for file in (ROOT / package).rglob("*.py")} - {"__init__.py"}
        assert named == there, f"{package}: the document misses {there - named}, invents {named - there}"
