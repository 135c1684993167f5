"""What `diagnose` said of the blind captures against the truth: counts, the confusion matrix, what went wrong."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import permutations
from typing import Any

import numpy as np

from simulators.blind.detectable import DETECTABLE
from simulators.blind.suite import Case
from simulators.blind.undeclared_faults import Truth

Result = Mapping[str, Any]

#: A cause that is not in the list, with names that would still be true.
TRUE_NAMES = {"lamp_beat": {"source_flicker"}}
#: What is asked of each number; None is only reported.
GOALS: dict[str, tuple[str, float | None]] = {
    "single": ("one effect: right kind, or within the named set", 0.95),
    "exact": ("   of these by its own name", None),
    "set": ("   of these within a named set", None),
    "empirical": ("   of these unexplained, among what the correction could be", None),
    "parameters": ("parameter within 3 standard errors", 0.99),
    "error": ("error after at most 1.1 times the noise floor", 1.0),
    "two": ("two effects at once: both", 0.85),
    "none": ("nothing there: consistent", 0.99),
    "unlisted": ("not in the list, detectable: no wrong name", 0.95),
    "unlisted_all": ("not in the list, all: no wrong name", None),
}


@dataclass
class Score:
    """Marks by name, sizes of the named sets, the confusion matrix, and a line for each wrong answer."""

    marks: dict[str, list[bool]] = field(default_factory=lambda: {name: [] for name in GOALS})
    set_sizes: list[int] = field(default_factory=list)
    confusion: Counter[tuple[str, str]] = field(default_factory=Counter)
    lines: list[str] = field(default_factory=list)

    def share(self, name: str) -> float:
        """Share of right answers; NaN if there was nothing to answer."""
        return float(np.mean(self.marks[name])) if self.marks[name] else float("nan")


def named_sets(result: Result) -> list[set[str]]:
    """For each effect that is named with confidence: its kind and those that it cannot be told from."""
    return [
        {e["kind"], *(text.partition("[")[0] for text in e["indistinguishable_from"])}
        for e in result["effects"]
        if e["confident"]
    ]


def empirical_set(result: Result) -> set[str]:
    """Kinds that an unexplained residual could be, as the empirical correction gives them."""
    empirical = (result.get("unexplained") or {}).get("empirical") or {}
    return {text.partition("[")[0] for text in empirical.get("would_also_fit", ())}


def right_names(kinds: Sequence[str], result: Result) -> bool:
    """Each cause has a named effect of its own, and every named effect is one of the causes."""
    sets = named_sets(result)
    if empirical_set(result) and len(sets) == len(kinds) - 1:
        # One is named; the other is among what the rest could be.
        sets.append(empirical_set(result))
    if any(not s & set(kinds) for s in sets) or len(sets) < len(kinds):
        return False
    return any(all(k in s for k, s in zip(kinds, chosen, strict=True)) for chosen in permutations(sets, len(kinds)))


def judge(cases: Sequence[Case], results: Mapping[str, Result]) -> Score:
    """Count right and wrong answers."""
    score = Score()
    for case in cases:
        result = results[case.name]
        kinds = [t.kind for t in case.faults]
        named = sorted({e["kind"] for e in result["effects"] if e["confident"]})
        row, column = "+".join(sorted(kinds)) or "nothing", "+".join(named) or result["verdict"]
        seen = all(d > DETECTABLE for d in case.detectable)
        if seen:
            score.confusion[row, column] += 1
            score.set_sizes += [1 + len(e["indistinguishable_from"]) for e in result["effects"] if e["confident"]]
        good = _mark(score, case, kinds, result, seen)
        if not good:
            truth = " + ".join(f"{t.kind} ({d:.0f})" for t, d in zip(case.faults, case.detectable, strict=True))
            sets = "; ".join("|".join(sorted(s)) for s in named_sets(result))
            score.lines.append(
                f"{case.name} {case.sample} {case.wavelength_nm:g} nm, truth {truth or row}: "
                f"{result['verdict']} {sets or '-'}"
            )
    return score


def _mark(score: Score, case: Case, kinds: Sequence[str], result: Result, seen: bool) -> bool:
    marks, sets = score.marks, named_sets(result)
    if case.group == "none":
        good = bool(result["verdict"] == "consistent")
        marks["none"].append(good)
        return good
    if case.group == "unlisted":
        good = all(s & TRUE_NAMES.get(kinds[0], set()) for s in sets)
        marks["unlisted_all"].append(good)
        if seen:
            marks["unlisted"].append(good)
        return good
    if not seen:
        # What is too weak to see may stay unnamed; it may not be called by another name.
        return all(s & set(kinds) for s in sets)
    named = right_names(kinds, result) if case.group == "two" or sets else False
    if case.group == "two":
        marks["two"].append(named)
        return named
    empirical = not sets and kinds[0] in empirical_set(result)
    good = named or empirical
    marks["single"].append(good)
    if good:
        exact = named and all(e["kind"] == kinds[0] for e in result["effects"] if e["confident"])
        marks["exact"].append(exact)
        marks["set"].append(named and not exact)
        marks["empirical"].append(empirical)
        if exact:
            marks["parameters"] += _within(case.faults[0], result)
    if named:
        marks["error"].append(result["error_after"]["rms_percent"] <= 1.1 * result["noise_floor_percent"])
    return good


def _within(truth: Truth, result: Result) -> list[bool]:
    out = []
    for effect in result["effects"]:
        if effect["kind"] != truth.kind or (truth.place and effect["element"] != truth.place):
            continue
        for name, value in truth.parameters.items():
            found = effect["parameters"].get(name)
            if found is not None and found["stderr"] is not None:
                out.append(bool(abs(found["value"] - value) <= 3 * found["stderr"]))
    return out


def table(score: Score) -> str:
    """The confusion matrix and the numbers, as text."""
    lines = ["truth -> answer: count (detectable ones, and those with nothing there)"]
    for (row, column), n in sorted(score.confusion.items()):
        lines.append(f"  {row} -> {column}: {n}")
    lines += ["wrong:", *(f"  {line}" for line in score.lines)]
    for name, (text, goal) in GOALS.items():
        marks = score.marks[name]
        if marks:
            wanted = "" if goal is None else f" (goal {100 * goal:.0f} %)"
            lines.append(f"{text}: {100 * score.share(name):.1f} % of {len(marks)}{wanted}")
    if score.set_sizes:
        sizes = np.array(score.set_sizes)
        lines.append(
            f"named effects: {sizes.size}, each with its set {sizes.mean():.2f} on average, {sizes.max()} at most"
        )
    return "\n".join(lines)
