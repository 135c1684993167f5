"""Every number of processing/diagnosis has a name, decides something or may be another one, and stands on the page."""

import ast
from pathlib import Path

import numpy as np
import pytest
import rules_page
from rule_decisions import MODULES

from processing.diagnosis.search import rules

#: Counts of one to four and halves of them; 16 unknowns of a Mueller matrix; per cent; a quarter turn in degrees; what
#: keeps a divisor from being zero, in double and in single precision.
TRIVIAL = {0, 1, 2, 3, 4, 0.5, 0.25, 16, 100, 90, 1e-300, 1e-12, 1e-30}


def test_every_constant_has_its_decision() -> None:
    decided = [name.removeprefix("test_").upper() for name in rules_page.decisions()]
    assert sorted(decided) == sorted(name for name in vars(rules) if name.isupper())


def test_the_page_lists_them_as_they_are() -> None:
    assert rules_page.PAGE.read_text(encoding="utf-8") == rules_page.page()


def test_every_other_number_has_its_unit_and_its_reason() -> None:
    told = rules_page.beside_the_rules()
    assert len(told) > 80
    assert [n for n in told if not (n.unit and n.reason)] == []


def is_number(value: object) -> bool:
    if isinstance(value, tuple):
        return any(map(is_number, value))
    return isinstance(value, int | float | np.ndarray) and not isinstance(value, bool)


def test_every_constant_that_is_a_number_is_on_the_page() -> None:
    """Also one that is trivial by its size; not what is made of others alone."""
    told = {(n.where, n.name) for n in rules_page.beside_the_rules()}
    hidden = []
    for module in MODULES:
        file = Path(module.__file__ or "")
        where = file.relative_to(rules_page.SOURCE.parents[1]).as_posix()
        for node in ast.parse(file.read_text(encoding="utf-8")).body if file != rules_page.SOURCE else []:
            if isinstance(node, ast.Assign) and any(is_number(getattr(n, "value", None)) for n in ast.walk(node)):
                names = {n.id for target in node.targets for n in ast.walk(target) if isinstance(n, ast.Name)}
                hidden += [(where, n) for n in names if n.isupper() and is_number(vars(module)[n])]
    assert len(hidden) > 80
    assert set(hidden) - told == set()


def hidden_numbers(text: str, named: set[str]) -> list[str]:
    """Lines of a file with a number that is neither trivial nor a part of one of the constants `named`."""
    lines, tree = text.splitlines(), ast.parse(text)
    told = [node for node in tree.body if isinstance(node, ast.Assign) and named & _names(node)]
    # Which of several is no size of anything.
    places = [n.slice for n in ast.walk(tree) if isinstance(n, ast.Subscript)]
    exempt = {id(n) for node in told for n in ast.walk(node)}
    exempt |= {id(n) for place in places for n in _whole(place)}
    numbers = [n for n in ast.walk(tree) if isinstance(n, ast.Constant) and type(n.value) in (int, float)]
    return [lines[n.lineno - 1].strip() for n in numbers if id(n) not in exempt and n.value not in TRIVIAL]


def _names(node: ast.Assign) -> set[str]:
    return {target.id for target in node.targets if isinstance(target, ast.Name)}


def _whole(place: ast.expr) -> list[ast.expr]:
    return place.elts if isinstance(place, ast.Tuple) else [place]


@pytest.mark.parametrize("text", ["if n > 7:\n    pass", "A, B = 5, 6", "x = y[:10]", "def f(a=0.05): ...", "N = 7"])
def test_a_number_that_hides_is_seen(text: str) -> None:
    assert hidden_numbers(text, {"M"}) != []


def test_a_number_with_a_name_does_not_hide() -> None:
    assert hidden_numbers("M = 7\nx = 2 * M + z[5]", {"M"}) == []


def test_no_number_hides() -> None:
    folder = rules_page.SOURCE.parents[1]
    named: dict[str, set[str]] = {}
    for n in rules_page.beside_the_rules():
        named.setdefault(n.where, set()).add(n.name)
    # A report shows, and decides nothing.
    files = [f for f in sorted(folder.rglob("*.py")) if f != rules_page.SOURCE and f.name != "report.py"]
    found = {f.relative_to(folder).as_posix(): f.read_text(encoding="utf-8") for f in files}
    assert len(found) > 70
    hidden = {where: hidden_numbers(text, named.get(where, set())) for where, text in found.items()}
    assert {where: lines for where, lines in hidden.items() if lines} == {}
