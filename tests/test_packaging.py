"""The distribution: four import names of ours, nothing else, and an environment that is not Debian's."""

import importlib
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import numpy as np
import pytest
from setuptools import find_packages

ROOT = Path(__file__).resolve().parents[1]
NAMES = ("drivers", "processing", "simulators", "acquisition")


@pytest.mark.parametrize("name", NAMES)
def test_import_name_comes_from_this_project(name: str) -> None:
    module = importlib.import_module(name)
    assert module.__file__ is not None
    assert Path(module.__file__).is_relative_to(ROOT)


@pytest.mark.parametrize("name", NAMES)
def test_no_other_distribution_installs_the_name(name: str) -> None:
    assert set(packages_distributions().get(name, ["umov"])) == {"umov"}


def test_every_subpackage_is_in_the_wheel() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
    packaged = set(find_packages(str(ROOT), include=settings["tool"]["setuptools"]["packages"]["find"]["include"]))
    folders = {".".join(path.parent.relative_to(ROOT).parts) for name in NAMES for path in (ROOT / name).rglob("*.py")}
    assert folders == packaged


def test_numpy_is_the_locked_one() -> None:
    locked = (ROOT / "requirements.lock").read_text()
    assert f"numpy=={np.__version__} " in locked
    assert "dist-packages" not in str(np.__file__)
