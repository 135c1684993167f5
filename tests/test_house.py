"""The house: no circle of imports anywhere, also none of imports inside functions."""

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("drivers", "processing", "simulators", "acquisition")


def imports(root: Path) -> dict[str, set[str]]:
    """Modules of our packages below `root` and what each imports of ours, wherever in the file."""
    files = {
        ".".join(f.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): f
        for package in PACKAGES
        for f in (root / package).rglob("*.py")
    }
    found = {}
    for module, file in files.items():
        targets = set()
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                whole = (f"{node.module}.{alias.name}" for alias in node.names)
                targets |= {name if name in files else node.module for name in whole}
            elif isinstance(node, ast.Import):
                targets |= {alias.name for alias in node.names}
        found[module] = {t for t in targets if t in files and t != module}
    return found


@pytest.mark.xfail(strict=True, reason="instrument.model and instrument.effects.base import each other")
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
