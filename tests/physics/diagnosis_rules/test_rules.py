"""Every constant of processing/diagnosis/search/rules.py decides something, and stands on its page."""

import re
from pathlib import Path

import rules_page

from processing.diagnosis.search import rules

DECISION = re.compile(r"^@decides\ndef test_(\w+)\(", re.MULTILINE)


def test_every_constant_has_its_decision() -> None:
    files = Path(__file__).parent.glob("test_*.py")
    decided = [name.upper() for file in files for name in DECISION.findall(file.read_text(encoding="utf-8"))]
    assert sorted(decided) == sorted(name for name in vars(rules) if name.isupper())


def test_the_page_lists_them_as_they_are() -> None:
    assert rules_page.PAGE.read_text(encoding="utf-8") == rules_page.page()


def test_every_other_number_says_what_it_is() -> None:
    told = [line.strip().strip("|").split("|") for line in rules_page.beside_the_code()]
    assert len(told) > 50
    assert [cells[0] for cells in told if len(cells) != 4 or not cells[3].strip()] == []
