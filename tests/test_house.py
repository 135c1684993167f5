"""The house: no circle of imports anywhere, also none of imports inside functions."""

import ast
import re
import runpy
import subprocess
import sys
import tomllib
from fnmatch import fnmatch
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("drivers", "processing", "simulators", "acquisition", "viewer")


@cache
def outline(file: Path) -> tuple[list[str], list[ast.Import | ast.ImportFrom]]:
    """Classes and imports of a module; its tree would stay for garbage collection to walk."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    classes = [node.name for node in tree.body if isinstance(node, ast.ClassDef)]
    return classes, [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]


def imports(root: Path) -> dict[str, set[str]]:
    """Modules of our packages below `root` and what each imports of ours, wherever in the file."""
    files = {
        ".".join(f.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): f
        for package in PACKAGES
        for f in (root / package).rglob("*.py")
    }
    edges = {}
    for module, file in files.items():
        targets = set()
        for node in outline(file)[1]:
            if isinstance(node, ast.ImportFrom) and node.module:
                names = (f"{node.module}.{alias.name}" for alias in node.names)
                targets |= {name if name in files else node.module for name in names}
            elif isinstance(node, ast.Import):
                targets |= {alias.name for alias in node.names}
        edges[module] = {t for t in targets if t in files and t != module}
    return edges


#: A kit asks these names of each module of a kind.
OF_EACH_KIND = {"Config", "Constants", "Model"}


def test_one_class_name_is_one_class():
    places: dict[str, list[str]] = {}
    for package in PACKAGES:
        for file in (ROOT / package).rglob("*.py"):
            for name in outline(file)[0]:
                if name not in OF_EACH_KIND:
                    places.setdefault(name, []).append(str(file.relative_to(ROOT)))
    assert {name: files for name, files in places.items() if len(files) > 1} == {}


def test_no_circle_of_imports():
    try:
        TopologicalSorter(imports(ROOT)).prepare()
    except CycleError as error:
        pytest.fail(f"a circle of imports: {' -> '.join(error.args[1])}")


def test_a_circle_would_be_seen(tmp_path):
    folder = tmp_path / "processing"
    folder.mkdir()
    (folder / "one.py").write_text("from processing import two\n")
    (folder / "two.py").write_text("def late():\n    from processing.one import thing\n")
    with pytest.raises(CycleError):
        TopologicalSorter(imports(tmp_path)).prepare()


@pytest.fixture
def two_tests(tmp_path):
    """Runs pytest over a short and a long test with the tests' own conftest; returns what it prints."""
    (tmp_path / "pytest.ini").write_text("[pytest]\ntestpaths = tests\nmarkers = long\n")
    (tmp_path / "tests").mkdir()
    shared = (ROOT / "tests/conftest.py").read_text(encoding="utf-8")
    (tmp_path / "tests/worker_server.py").write_bytes((ROOT / "tests/worker_server.py").read_bytes())
    # Loading what draws takes most of the time.
    (tmp_path / "tests/conftest.py").write_text(re.sub(r"^import matplotlib.*\n", "", shared, flags=re.M))
    (tmp_path / "tests/test_two.py").write_text(
        "import pytest\n\ndef test_short(): pass\n\n@pytest.mark.long\ndef test_long(): pass\n"
    )
    return lambda *options: (
        subprocess.run(
            [sys.executable, "-m", "pytest", "-q", *options], cwd=tmp_path, capture_output=True, text=True
        ).stdout
    )


def test_long_tests_are_left_out_with_a_line(two_tests):
    output = two_tests("-n", "1")
    assert "1 passed" in output
    assert "1 long tests left out; run them too: ./lab test --all" in output


def test_a_file_that_cannot_be_imported_is_reported(two_tests, tmp_path):
    (tmp_path / "tests/test_three.py").write_text("import nothing_there\n")
    assert "No module named 'nothing_there'" in two_tests("-n", "1")


@pytest.mark.parametrize("options", [("--all",), ("-m", "not other")])
def test_what_is_selected_runs_although_it_is_long(two_tests, options):
    output = two_tests(*options)
    assert "2 passed" in output
    assert "left out" not in output


def test_the_floors_on_the_page_are_those_of_the_contracts():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = project["tool"]["importlinter"]["contracts"]
    floors_of_rooms = {contract["containers"][0]: " > ".join(contract["layers"]) for contract in contracts[1:]}
    page = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    shown = re.findall(r"^([\w.]+):  +(.+?)(?=^[\w.]+: |^```)", page, re.M | re.S)
    assert {room: " ".join(floors.split()) for room, floors in shown} == floors_of_rooms


def cited_outside(text: str) -> list[str]:
    """What a text cites that is not in the repository: papers of the workshop, pages of docs/ that are not there."""
    citations = re.findall(r"shared/\w+\.(?:md|tex)|\b[Tt]raps? \d+", text)
    for page, heading in re.findall(r"docs/([\w/-]+\.md)(?:, \"([^\"]+)\")?", text):
        file = ROOT / "docs" / page
        if not file.exists():
            citations.append(f"docs/{page}")
        elif heading and not re.search(rf"^#+ .*{re.escape(' '.join(heading.split()))}", file.read_text(), re.M):
            citations.append(f'docs/{page}, "{heading}"')
    return citations


def test_every_picture_is_on_a_page_and_has_its_command():
    images = ROOT / "docs/images"
    pictures = {str(f.relative_to(images)) for ending in ("png", "svg") for f in images.rglob(f"*.{ending}")}
    pages = "".join(f.read_text(encoding="utf-8") for f in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md")))
    assert {name for name in pictures if f"images/{name})" not in pages} == set()
    table = (ROOT / "docs/testing.md").read_text(encoding="utf-8").split("## Pictures")[1].split("## ")[0]
    for names, command, run in (line.split("|")[1:4] for line in table.splitlines() if line.startswith("| `")):
        for pattern in re.findall("`(.+?)`", names):
            named = {name for name in pictures if fnmatch(name, pattern)}
            assert named, pattern
            pictures -= named
        for file in re.findall(r"[\w/]+\.py", command + run):
            assert list(ROOT.glob(f"tests/*/{file}")) or (ROOT / file).exists(), file
    assert pictures == set()


@pytest.mark.parametrize("folder", [*PACKAGES, "tests", "benchmarks", "configs", "docs"])
def test_nothing_cites_what_is_not_here(folder):
    files = [f for ending in ("py", "md", "yaml") for f in sorted((ROOT / folder).rglob(f"*.{ending}"))]
    assert files
    this = Path(__file__)
    wrong = {str(f.relative_to(ROOT)): cited_outside(f.read_text(encoding="utf-8")) for f in files if f != this}
    assert {name: citations for name, citations in wrong.items() if citations} == {}


def test_a_citation_that_leads_outside_is_seen():
    assert cited_outside("see ../shared/notes.md, trap 8, docs/no-such-page.md") == [
        "shared/notes.md",
        "trap 8",
        "docs/no-such-page.md",
    ]
    assert cited_outside('docs/conventions.md, "No such heading"')
    assert not cited_outside('docs/conventions.md, "Frames"')


def test_a_page_names_modules_that_exist():
    folders = [*PACKAGES, "tests", "benchmarks", "examples", ".ci"]
    modules = [f"/{path.relative_to(ROOT)}" for folder in folders for path in (ROOT / folder).rglob("*.py")]
    wrong = [
        f"{page.name}: {name}"
        for page in (ROOT / "docs").glob("*.md")
        for name in re.findall(r"`([\w./-]+\.py)`", page.read_text(encoding="utf-8"))
        if not any(module.endswith(f"/{name}") for module in modules)
    ]
    assert wrong == []


def test_a_page_that_speaks_of_the_paper_names_it():
    pages = [page for page in (ROOT / "docs").rglob("*.md") if re.search(r"\b[Tt]he paper\b", page.read_text("utf-8"))]
    assert pages
    assert [page.name for page in pages if "Jarecki" not in page.read_text("utf-8")] == []


def test_the_table_of_devices_names_a_document_of_every_kind():
    rows = re.findall(r"^\| ([\w, ]+) \| (.+?) \| .+ \|$", (ROOT / "docs/devices.md").read_text("utf-8"), re.MULTILINE)
    named = {kind for kinds, document in rows if document.strip("-") for kind in kinds.split(", ")}
    kinds = {
        file.stem for family in ("axes", "cameras", "sources") for file in (ROOT / "drivers" / family).glob("[!_]*.py")
    }
    # A lamp without a cable has no protocol.
    assert kinds - named == {"manual"}


def test_every_page_of_the_docs_is_in_the_site():
    named = set(re.findall(r"[\w/-]+\.md", (ROOT / "mkdocs.yml").read_text(encoding="utf-8")))
    pages = {str(page.relative_to(ROOT / "docs")) for page in (ROOT / "docs").rglob("*.md")}
    # Made of the notebooks when the site is built.
    assert named == pages | {f"notebook-{page.stem}.md" for page in (ROOT / "examples").glob("*.ipynb")}


@pytest.mark.parametrize(
    ("text", "mistake"),
    [
        ("# Title\n\n*Reference.* " + "word\n" * 31, "31 words"),
        ("# Title\n\n*Reference.* " + ("word\n" * 19 + "end. Then ") * 9, "mean length"),
        ("# Title\n\n*Reference.* A gap stands beside the text.", '"beside"'),
        ("# Title\n\nA page without its purpose.", "purpose"),
        ("# Title\n\n*Explanation.*" + "\nWord and word." * 900, "an explanation of"),
        ("# Title\n\n*Reference.* A line.\n" + "word, " * 10 + "characters" * 10 + " end.", "longer than 120"),
    ],
)
def test_what_a_page_does_against_the_language_is_seen(text, mistake):
    prose = runpy.run_path(str(ROOT / ".ci/prose.py"))
    mistakes = prose["mistakes"]("docs/page.md", text)
    assert any(mistake in line for line in mistakes)
    spared = "# " + "Title " * 40 + "\n\n*Reference.* One sentence.\n\n| " + "cell " * 40 + "|\n|---|\n"
    assert not prose["mistakes"]("docs/page.md", spared)


def _kinds_by_name(folder: Path) -> list[str]:
    """Where the kind of an effect or candidate is compared with a string."""
    lines = []
    for path in sorted(folder.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            sides = [node.left, *node.comparators] if isinstance(node, ast.Compare) else []
            kind = any(isinstance(side, ast.Attribute) and side.attr == "kind" for side in sides)
            if kind and any(isinstance(side, ast.Constant) and isinstance(side.value, str) for side in sides):
                lines.append(f"{path.name}:{node.lineno}")
    return lines


@pytest.mark.parametrize("room", ["search", "instrument", "surface"])
def test_the_diagnosis_asks_for_types_and_not_for_names_of_effects(room):
    """An effect is a file that can be added and deleted: nothing else knows its name."""
    assert _kinds_by_name(ROOT / "processing" / "diagnosis" / room) == []


def test_a_kind_that_is_compared_with_a_name_is_seen(tmp_path):
    (tmp_path / "x.py").write_text('def f(c):\n    return c.kind == "slip"\n')
    assert _kinds_by_name(tmp_path) == ["x.py:2"]
