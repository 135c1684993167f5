"""Every code block of README and docs runs as it stands.

A block is a fence with a language. `bash` and `python` run page by page, in a folder that looks like the checkout; a
capture of the tutorial lies in `captures/` where a page takes none of itself. A title that begins with "with" names
files of the reader's, which `own_files` makes; `until Ctrl-C` is a server, which has to answer and to end. `yaml` has a
title that says what it is: `NAME.yaml` is written for the commands that follow, a part of a file is put into that file.
`console` takes minutes and runs with UMOV_SLOW=1 alone; without it its commands, options and scripts must exist.
"""

import contextlib
import glob
import os
import re
import runpy
import shlex
import shutil
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial
import typer
from markdown_it import MarkdownIt
from PIL import Image
from ruamel.yaml import YAML

from acquisition.campaign.plan import Campaign
from acquisition.commands.application import app as acquire_app
from acquisition.commands.application import main as acquire
from acquisition.commands.public_data import app as data_app
from acquisition.commands.public_data import main as data
from acquisition.rig.config import load_rig
from processing.commands.application import app as process_app
from processing.commands.application import main as process
from processing.commands.diagnose import app as diagnose_app
from processing.commands.diagnose import main as diagnose
from processing.geometry.viewing import ViewingGeometry
from processing.storage.products.images import MuellerImage
from simulators.cli import app as simulate_app
from tests.commands import exit_code
from viewer.command import app as view_app

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]
RUNS = {"acquire": acquire, "process": process, "diagnose": diagnose, "data": data}
APPS = {
    "acquire": acquire_app,
    "process": process_app,
    "diagnose": diagnose_app,
    "simulate": simulate_app,
    "view": view_app,
    "data": data_app,
}
MODULES = {"simulate": "simulators.cli", "view": "viewer.command"}
FIRST_CAPTURE = ["./lab", "acquire", "--omega", "35"]
LANGUAGES = {"bash", "python", "console", "yaml", "text"}
SHOWN_FOLDERS = ("configs", "examples", "benchmarks", "tests/data")
SMALLER = {
    "configs/rigs/simulated.yaml": {
        "clock_speed: 10": "clock_speed: 50",
        "rows: 600": "rows: 48",
        "columns: 600": "columns: 48",
    },
    "configs/campaigns/red_sphere.yaml": {"stop: 90": "stop: 20", "[451, 662]": "[662]"},
}
UNTIL_CTRL_C = "until Ctrl-C"
#: Pages whose commands take more than about three seconds of a processor; the README's run always, and are also those
#: of the first tutorial.
LONG = {
    *("acquisition", "calibration", "closing-the-loop", "other-tools", "processing", "quantities", "view"),
    *("tutorial-close-the-loop", "tutorial-first-capture", "adding-a-driver"),
}
SLOW = "UMOV_SLOW"


@dataclass(frozen=True)
class Block:
    """One code block: where it begins, its language, its title and its lines."""

    page: Path
    line: int
    language: str
    title: str
    text: str

    def commands(self) -> list[list[str]]:
        """Words of each command line, without comments; a backslash joins lines."""
        lines = self.text.replace("\\\n", " ").splitlines()
        return [words for line in lines if (words := shlex.split(line, comments=True))]


def shown(block: Block) -> list[list[str]]:
    """Commands of a block that runs."""
    return block.commands() if block.language == "bash" else []


def blocks_of(page: Path) -> list[Block]:
    """Code blocks of a page; one that is made by indentation has no language."""
    blocks = []
    for token in MarkdownIt().parse(page.read_text(encoding="utf-8")):
        if token.type in ("fence", "code_block"):
            language, _, attributes = token.info.partition(" ")
            title = re.search(r'title="([^"]+)"', attributes)
            line = token.map[0] + 1 if token.map else 0
            blocks.append(Block(page, line, language, title[1] if title else "", token.content))
    return blocks


BLOCKS = [block for page in PAGES for block in blocks_of(page)]


def run_by_ci(block: Block) -> bool:
    """Whether CI's script says the same: the tests do not run themselves."""
    lines = (ROOT / ".ci/run").read_text(encoding="utf-8").splitlines()
    return all(shlex.join(words) in lines for words in block.commands())


OWN_POLARIMETER = ROOT / "docs/tutorial-your-own-polarimeter.md"
WITH_CODE = [
    page
    for page in PAGES
    if page != OWN_POLARIMETER and any(b.page == page and b.language in ("bash", "python") for b in BLOCKS)
]


def test_every_block_says_what_it_is() -> None:
    wrong = [
        f"{b.page.name}:{b.line}: {b.language or 'indented, without a language'}"
        for b in BLOCKS
        if b.language not in LANGUAGES or (b.language in ("console", "yaml") and not b.title)
    ]
    assert wrong == []


@pytest.fixture(scope="session")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the files that pages name; the simulated rig is smaller and faster, the campaign shorter."""
    folder = tmp_path_factory.mktemp("checkout")
    for name in SHOWN_FOLDERS:
        target = folder / name
        for path in (ROOT / name).rglob("*"):
            if path.is_file() and "__pycache__" not in path.parts:
                copy = target / path.relative_to(ROOT / name)
                copy.parent.mkdir(parents=True, exist_ok=True)
                copy.write_bytes(path.read_bytes())
    for name, changes in SMALLER.items():
        text = (folder / name).read_text()
        for old, new in changes.items():
            assert old in text
            text = text.replace(old, new)
        (folder / name).write_text(text)
    return folder


@pytest.fixture(scope="session")
def first_capture(checkout: Path) -> Path:
    """The capture of the tutorial's first command."""
    rig = checkout / "configs/rigs/simulated.yaml"
    assert exit_code(acquire, "--omega", 35, "--rig", rig, "--out", checkout / "one") == 0
    (capture,) = (checkout / "one").glob("*omega35.h5")
    return capture


@pytest.fixture
def desk(checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, default_rig: Callable[[Path], None]) -> Path:
    """Where a page's commands run: links to the files of the checkout, nothing else."""
    for name in SHOWN_FOLDERS:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).symlink_to(checkout / name)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    default_rig(checkout / "configs/rigs/simulated.yaml")
    return tmp_path


def run(words: list[str]) -> None:
    """Run a line of a shell block in this process, patterns of file names filled in as a shell does."""
    arguments = [name for word in words[2:] for name in (sorted(glob.glob(word)) if "*" in word else [word])]
    code = exit_code(RUNS[words[1]], *arguments)
    assert code == 0, f"{shlex.join(words)} ended with {code}"


@pytest.fixture
def run_page(
    desk: Path, own_files: dict[str, Callable[[], object]], request: pytest.FixtureRequest
) -> Callable[[Path], None]:
    """Runs the blocks of a page one after the other, where a reader would."""

    def run_blocks(page: Path) -> None:
        blocks = [b for b in BLOCKS if b.page == page]
        if not any(words[:4] == FIRST_CAPTURE and "--mode" not in words for b in blocks for words in shown(b)):
            (desk / "captures").mkdir()
            capture = request.getfixturevalue("first_capture")
            os.link(capture, desk / "captures" / capture.name)
        scope: dict[str, object] = {}
        for block in blocks:
            if block.language == "yaml" and block.title.endswith(".yaml"):
                (desk / block.title).write_text(block.text)
            elif block.language == "bash":
                if block.title.startswith("with "):
                    own_files[block.title]()
                for words in shown(block):
                    assert words[0] == "./lab", f"{shlex.join(words)}: shown commands begin with ./lab"
                    (serve if block.title == UNTIL_CTRL_C else run)(words)
            elif block.language == "python":
                exec(compile(block.text, f"{page.name}:{block.line}", "exec"), scope)

    return run_blocks


@pytest.mark.parametrize(
    "page", [pytest.param(p, id=p.stem, marks=[pytest.mark.long] if p.stem in LONG else []) for p in WITH_CODE]
)
def test_commands_and_python_run_as_they_stand(page: Path, run_page: Callable[[Path], None]) -> None:
    run_page(page)


@pytest.mark.long
def test_the_tutorial_of_an_own_polarimeter_corrects_its_matrix(run_page: Callable[[Path], None], desk: Path) -> None:
    run_page(OWN_POLARIMETER)
    run(["./lab", "process", "reduce", "sample.h5", "--instrument", "my_polarimeter.yaml", "--out", "nominal.h5"])
    sample = runpy.run_path(str(ROOT / "examples/other_lab.py"))["SAMPLE"]
    products = (desk / "nominal.h5", *desk.glob("sample.mueller*.h5"))
    matrices = [MuellerImage.load(path).values.mean(axis=(2, 3)) for path in products]
    nominal, corrected = (np.abs(m / m[0, 0] - sample).max() for m in matrices)
    assert nominal > 0.015
    assert corrected < 0.001
    if screenshots := os.environ.get("UMOV_SCREENSHOTS"):
        (picture,) = desk.glob("sample.mueller*.png")
        shutil.copy(picture, ROOT / screenshots / "own_polarimeter.png")


def serve(words: list[str]) -> None:
    """Start a server by a line of a shell block, ask it something, and end it as a user does."""
    begin = [sys.executable, "-c", f"from {MODULES[words[1]]} import main; main()", *words[2:]]
    with subprocess.Popen(begin, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            address = server.stdout.readline().split()[-1]
            if address.startswith("http"):
                with urllib.request.urlopen(address) as page:
                    assert page.status == 200
            else:
                # A controller's pseudo-terminal; the line is the question for everybody's state on a Zaber chain.
                with serial.Serial(address, 115200) as port:
                    port.write(b"/\n")
                    assert port.readline().startswith(b"@01 0 OK")
        finally:
            server.send_signal(signal.SIGINT)
    assert server.returncode in (0, 130), shlex.join(words)


@pytest.mark.long
def test_the_documented_report(
    checkout: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture,
    request: pytest.FixtureRequest,
) -> None:
    """The example of closing-the-loop.md ends applied and right; its picture is of the rig's own size."""
    screenshots = os.environ.get("UMOV_SCREENSHOTS")
    (block,) = (b for b in BLOCKS if b.page.stem == "closing-the-loop" and "report.html" in b.text)
    shutil.copytree((ROOT if screenshots else checkout) / "configs", tmp_path / "configs")
    monkeypatch.chdir(tmp_path)
    change, *commands = block.text.replace("\\\n", " ").splitlines()
    subprocess.run(["bash", "-ec", change], check=True)
    for line in commands:
        run(shlex.split(line))
    out = capfd.readouterr().out
    assert "SIMULATED data, RGB950: explained\n" in out
    (cause,) = re.findall(r"^\d\. .*\n.*\n.*", out, re.M)
    assert cause.startswith("1. beam_wander of psa_retarder (sure")
    assert cause.endswith("   applied")
    for name in ("x_cos", "y_sin"):
        value, error = (float(text) for text in re.search(rf"{name} (\S+) ± (\S+)", cause).groups())
        assert value == pytest.approx(0.2, abs=3 * error)
        assert error < 0.01
    if screenshots:
        path = ROOT / screenshots / "diagnose_report.png"
        page = request.getfixturevalue("browser").new_page(viewport={"width": 1000, "height": 900})
        page.goto(f"file://{tmp_path}/report.html")
        page.screenshot(path=path, full_page=True)
        Image.open(path).convert("RGB").quantize(192).save(path, optimize=True)


SLOW_BLOCKS = [
    pytest.param(b, id=f"{b.page.stem}-{b.line}") for b in BLOCKS if b.language == "console" and not run_by_ci(b)
]


@pytest.mark.skipif(not os.environ.get(SLOW), reason=f"takes minutes each; {SLOW}=1 runs them")
@pytest.mark.timeout(0)
@pytest.mark.parametrize("block", SLOW_BLOCKS)
def test_what_takes_minutes_runs_as_it_stands(block: Block, desk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (desk / "tests/data").unlink()
    (desk / "tests").rmdir()
    for name, target in {"lab": ROOT / "lab", "tests": ROOT / "tests", ".venv": Path(sys.prefix)}.items():
        (desk / name).symlink_to(target)
    monkeypatch.delenv(SLOW)
    # A group of its own: what a line leaves in the background ends with it.
    with subprocess.Popen(["bash", "-ec", block.text], start_new_session=True) as shell:
        try:
            assert shell.wait() == 0
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(shell.pid, signal.SIGKILL)


@pytest.mark.parametrize("block", SLOW_BLOCKS)
def test_what_takes_minutes_exists(block: Block) -> None:
    for words in block.commands():
        script = ""
        for word in (word.rstrip(";") for word in words):
            if word.startswith(("benchmarks/", "examples/", "tests/", "configs/")):
                assert (ROOT / word).exists(), word
                script = (ROOT / word).read_text() if word.endswith(".py") else script
            elif word.startswith("--") and "benchmarks/" in shlex.join(words):
                assert f'"{word}"' in script, word
        if words[0] == "./lab" and words[1] in APPS:
            require_options(words[1], words[2:])


def require_options(name: str, words: list[str]) -> None:
    """Assert that a command takes the options it is shown with; nothing is run."""
    command: Any = typer.main.get_command(APPS[name])
    if hasattr(command, "commands") and not words[0].startswith("-"):
        assert words[0] in command.commands, f"{name} has no command {words[0]!r}"
        command = command.commands[words[0]]
    options = {option for parameter in command.params for option in parameter.opts}
    assert {word for word in words if word.startswith("--")} <= options


@pytest.mark.parametrize("block", [b for b in BLOCKS if b.language == "yaml"], ids=lambda b: f"{b.page.stem}-{b.line}")
def test_yaml_is_valid_where_it_belongs(block: Block, tmp_path: Path) -> None:
    if block.title.endswith(".yaml"):
        assert block.title in "".join(b.text for b in BLOCKS if b.page == block.page and b.language == "bash")
        return
    files = {
        "in a rig file": (ROOT / "configs/rigs/simulated.yaml", load_rig),
        "in a campaign file": (ROOT / "configs/campaigns/red_sphere.yaml", Campaign.load),
        "a geometry file": (None, ViewingGeometry.load),
    }
    base, load = files[block.title]
    yaml = YAML()
    part = yaml.load(block.text)
    if base is None:
        path = tmp_path / "whole.yaml"
    else:
        # Beside the file, for its relative paths.
        path = tmp_path / base.parent.name / base.name
        for folder in ("instruments", "scenes", "plans"):
            (tmp_path / folder).symlink_to(ROOT / "configs" / folder)
        path.parent.mkdir()
        document = yaml.load(base)
        merge(document, part)
        part = document
    with path.open("w") as file:
        yaml.dump(part, file)
    load(path)


def merge(document: dict, part: dict) -> None:
    """Put a part of a file into it; sections are merged, lists and values replaced."""
    for key, value in part.items():
        if isinstance(value, dict) and isinstance(document.get(key), dict):
            merge(document[key], value)
        else:
            document[key] = value
