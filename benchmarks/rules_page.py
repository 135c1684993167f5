"""Write docs/diagnosis-rules.md from the constants of the diagnosis and the comments above them.

python benchmarks/rules_page.py
"""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "processing/diagnosis/search/rules.py"
PAGE = ROOT / "docs/diagnosis-rules.md"
HEAD = """# Rules of the diagnosis

"The paper" is Q. Jarecki and M. Kupinski, *Efficient Modeling of Depolarizing Mueller BRDFs*.

Every constant by which `diagnose` decides, with its unit and its reason. This page is made of
`processing/diagnosis/search/rules.py` by `python benchmarks/rules_page.py`. A test changes each by a fifth (a whole
number by one) and holds that a decision is another one then (`tests/physics/diagnosis_rules`). [Last](#beside-the-code)
stand numbers that are no such rule: steps and tolerances of the fits, sizes below which nothing can be told, memory.
"""
BESIDE = """
## Beside the code

Of all other files of `processing/diagnosis`: steps, memory, formulas, and the least data that can tell anything. No
test changes these one by one.

| constant | value | where | what it is |
|---|---|---|---|
"""
CONSTANT = re.compile(r"((?:^#:[^\n]*\n)+)^([A-Z_]+) = (.+)$", re.MULTILINE)
NUMBER = re.compile(r"([A-Z][A-Z_]+) = (-?[0-9][0-9_.e-]*|\(-?[0-9][0-9_.e, -]*\))$")
SECTION = re.compile(r"^# ---- (.+?) -+$", re.MULTILINE)


def page() -> str:
    """The page as it should be."""
    text = SOURCE.read_text(encoding="utf-8")
    marks = [(m.start(), m) for pattern in (SECTION, CONSTANT) for m in pattern.finditer(text)]
    lines = [HEAD]
    for _, m in sorted(marks, key=lambda mark: mark[0]):
        if m.re is SECTION:
            lines.append(
                f"\n## {m[1][0].upper()}{m[1][1:]}\n\n| constant | value | unit | reason |\n|---|---|---|---|\n"
            )
            continue
        comment = " ".join(line.removeprefix("#:").strip() for line in m[1].splitlines())
        unit, _, reason = comment.removeprefix("[").partition("] ")
        value = m[3].removeprefix("np.array([").removesuffix("])")
        lines.append(f"| `{m[2]}` | {value} | {unit} | {reason} |\n")
    return "".join([*lines, BESIDE, *beside_the_code()])


def beside_the_code() -> list[str]:
    """A line for each number that has a name elsewhere in the diagnosis; those of one comment share it."""
    lines = []
    for file in sorted(set(SOURCE.parents[1].rglob("*.py")) - {SOURCE}):
        where, comment, old = file.relative_to(SOURCE.parents[1]).as_posix(), "", False
        for line in file.read_text(encoding="utf-8").splitlines():
            if line.startswith("#:"):
                comment, old = "" if old else comment, False
                comment += line.removeprefix("#:")
            elif named := NUMBER.match(line):
                lines.append(f"| `{named[1]}` | {named[2]} | `{where}` | {comment.strip()} |\n")
                old = True
            else:
                comment, old = "", False
    return lines


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
