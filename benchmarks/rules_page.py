"""Write docs/diagnosis-rules.md from the constants of the diagnosis, the comments above them and the tests of them.

PYTHONPATH=. python benchmarks/rules_page.py
"""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "processing/diagnosis/search/rules.py"
TESTS = ROOT / "tests/physics/diagnosis_rules"
PAGE = ROOT / "docs/diagnosis-rules.md"
HEAD = """# Rules of the diagnosis

"The paper" is Q. Jarecki and M. Kupinski, *Efficient Modeling of Depolarizing Mueller BRDFs*.

Every number in `diagnose`, with its unit and its reason. First those that decide: each stands in
`processing/diagnosis/search/rules.py`, and the test that is named with it fails when it is changed by a fifth (a whole
number by one). [Then](#effort-and-memory) what an answer costs: a test changes all of these at once, and the answers
stay. [Last](#fixed-by-what-they-count) numbers that can have no other value. No function holds a number without a name
but the trivial ones that `test_rules.py` lists. This page is made by `python benchmarks/rules_page.py`; the tests are
in `tests/physics/diagnosis_rules`.
"""
EFFORT = """
## Effort and memory

Steps, tolerances, caches, pixels that are looked at. `test_effort.py` makes all of them a quarter larger at once, and a
fifth smaller: verdict, names and answers of its captures stay, and values move by less than a tenth of their errors.

| constant | value | unit | where | reason |
|---|---|---|---|---|
"""
FIXED = """
## Fixed by what they count

No other value would be right.

| constant | value | unit | where | reason |
|---|---|---|---|---|
"""
CONSTANT = re.compile(r"((?:^#:[^\n]*\n)+)^([A-Z_]+) = (.+)$", re.MULTILINE)
SECTION = re.compile(r"^# ---- (.+?) -+$", re.MULTILINE)
DECISION = re.compile(r"^@decides\ndef (test_\w+)\(", re.MULTILINE)


@dataclass(frozen=True)
class Number:
    """A constant that stands beside the rules, as its file has it; `fixed` if it can have no other value."""

    where: str
    name: str
    value: str
    unit: str
    reason: str
    fixed: bool

    @property
    def line(self) -> str:
        """Its line on the page."""
        return f"| `{self.name}` | {self.value} | {self.unit} | `{self.where}` | {self.reason} |\n"


def page() -> str:
    """The page as it should be."""
    text, tests = SOURCE.read_text(encoding="utf-8"), decisions()
    marks = [(m.start(), m) for pattern in (SECTION, CONSTANT) for m in pattern.finditer(text)]
    lines = [HEAD]
    for _, m in sorted(marks, key=lambda mark: mark[0]):
        if m.re is SECTION:
            title = f"{m[1][0].upper()}{m[1][1:]}"
            lines.append(f"\n## {title}\n\n| constant | value | unit | reason | test |\n|---|---|---|---|---|\n")
            continue
        unit, reason = unit_and_reason(m[1].splitlines())
        value = m[3].removeprefix("np.array([").removesuffix("])")
        test = tests.get(f"test_{m[2].lower()}", "")
        lines.append(f"| `{m[2]}` | {value} | {unit} | {reason} | {test} |\n")
    numbers = beside_the_rules()
    effort, fixed = ([n.line for n in numbers if n.fixed is is_fixed] for is_fixed in (False, True))
    return "".join([*lines, EFFORT, *effort, FIXED, *fixed])


def decisions() -> dict[str, str]:
    """Where each test of a rule stands, as pytest calls it."""
    files = sorted(TESTS.glob("test_*.py"))
    return {n: f"`{f.name}::{n}`" for f in files for n in DECISION.findall(f.read_text(encoding="utf-8"))}


def unit_and_reason(comment: list[str]) -> tuple[str, str]:
    """Of the comment lines above a constant; no unit where they do not begin with one."""
    text = " ".join(line.removeprefix("#:").strip() for line in comment)
    unit, bracket, reason = text.partition("] ")
    return (unit.removeprefix("["), reason) if bracket and unit.startswith("[") else ("", text)


def beside_the_rules() -> list[Number]:
    """Every number that has a name elsewhere in the diagnosis; those without a line between them share a comment."""
    out = []
    for file in sorted(set(SOURCE.parents[1].rglob("*.py")) - {SOURCE}):
        text = file.read_text(encoding="utf-8")
        lines, last, comment = text.splitlines(), 0, list[str]()
        for node in ast.parse(text).body:
            if not (isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)):
                continue
            above = node.lineno - 1
            while above and lines[above - 1].startswith("#:"):
                above -= 1
            own = lines[above : node.lineno - 1]
            comment = own or (comment if node.lineno == last + 1 else [])
            last = node.end_lineno or node.lineno
            unit, reason = unit_and_reason(comment)
            if unit and any(isinstance(n, ast.Constant) and isinstance(n.value, int | float) for n in ast.walk(node)):
                where = file.relative_to(SOURCE.parents[1]).as_posix()
                value, fixed = (
                    " ".join((ast.get_source_segment(text, node.value) or "").split()),
                    unit.endswith(", fixed"),
                )
                out.append(Number(where, node.targets[0].id, value, unit.removesuffix(", fixed"), reason, fixed))
    return out


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
