"""The distribution: six import names of ours, nothing else, and an environment that is not Debian's."""

import importlib
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import packages_distributions
from pathlib import Path

import numpy as np
import pytest
from setuptools import find_packages

ROOT = Path(__file__).resolve().parents[1]
NAMES = ("umov", "drivers", "processing", "simulators", "acquisition", "viewer")


@pytest.mark.parametrize("name", NAMES)
def test_import_name_comes_from_this_project(name: str) -> None:
    module = importlib.import_module(name)
    assert module.__file__ is not None
    assert Path(module.__file__).is_relative_to(ROOT)


def test_no_other_distribution_installs_our_names() -> None:
    owners = packages_distributions()
    assert {name: set(owners.get(name, ["umov"])) for name in NAMES} == {name: {"umov"} for name in NAMES}


def test_every_subpackage_is_in_the_wheel() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
    packaged = set(find_packages(str(ROOT), **settings["tool"]["setuptools"]["packages"]["find"]))
    folders = {".".join(path.parent.relative_to(ROOT).parts) for name in NAMES for path in (ROOT / name).rglob("*.py")}
    # What judges the program is in the repository alone.
    assert folders - packaged == {"simulators.blind"}
    assert packaged <= folders


def test_no_script_hides_a_program_of_debian() -> None:
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    # vim's is `view`.
    assert set(scripts) == {"umov", "acquire", "process", "diagnose", "simulate"}


def test_numpy_is_the_locked_one() -> None:
    locked = (ROOT / "requirements.lock").read_text()
    assert f"numpy=={np.__version__} " in locked
    assert "dist-packages" not in str(np.__file__)


def test_who_has_what_the_tests_need_has_what_the_commands_need() -> None:
    """`./lab` installs nothing more then."""
    commands, tests = (
        {*re.findall(r"^[\w.-]+==\S+", (ROOT / name).read_text(), re.M)}
        for name in ("requirements.lock", "requirements-dev.lock")
    )
    assert commands
    assert commands <= tests


@pytest.mark.long
def test_the_wheel_works_where_there_is_no_checkout(tmp_path: Path) -> None:
    # From a copy: a build leaves folders behind, and what an earlier one left would get into the wheel.
    source = tmp_path / "source"
    for name in (*NAMES, "configs"):
        shutil.copytree(ROOT / name, source / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    build = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--no-deps",
        "--no-build-isolation",
        "--quiet",
        "-w",
        tmp_path,
        source,
    ]
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("umov-*.whl")
    with zipfile.ZipFile(wheel) as file:
        file.extractall(tmp_path / "installed")
        # Pages are made of more than Python.
        carried = set(file.namelist())
    pages = {f"viewer/{f.relative_to(ROOT / 'viewer')}" for f in (ROOT / "viewer").rglob("*.*") if f.suffix != ".pyc"}
    assert not [name for name in carried if name.startswith("simulators/blind")]
    assert pages | {"processing/reports/design/umov.css", "processing/reports/design/page.html"} <= carried
    environment = os.environ | {"PYTHONPATH": str(tmp_path / "installed")}
    # The folder stands in for site-packages; the lines below fail where the checkout is imported instead.
    code = (
        "import acquisition, sys; assert acquisition.__file__.startswith(sys.argv[1]);"
        "from acquisition.commands.application import main; main(['--omega', '35', '--dry-run'])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "installed")],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "nothing was moved" in done.stdout
    program = "from processing.commands.program import main; main(['view', '-h'])"
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.stdout.startswith("Usage: umov view "), done.stderr


@pytest.mark.parametrize(
    ("typed", "meant"), [("aquire", "acquire"), ("proces", "process"), ("veiw", "view"), ("reduce", None), ("x", None)]
)
def test_lab_asks_whether_a_command_near_by_was_meant(typed: str, meant: str | None) -> None:
    done = subprocess.run([ROOT / "lab", typed], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    hint = f" Did you mean '{meant}'?" if meant else ""
    assert done.stderr == f"lab: there is no command '{typed}'.{hint} ./lab help lists them.\n"
