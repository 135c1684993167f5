"""Figures over many benches: how good M is, how often its intervals hold, how often a name is right."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from simulators.blind.bench_judge import BenchJudgement, TrueCause

#: Errors of M / m00 below this are the rounding of counts, not the instrument.
FLOOR = 2e-5
#: An error of M counts as reached up to this many times that of the fit with the true set; the second is listed too.
REACHED, NEARLY = 1.2, 2.0
#: A fault matters from so many standard errors of M on.
MATTERS = 1.0
#: Edges of the bins of probability in the reliability table.
BINS = (0.0, 0.5, 0.7, 0.8, 0.9, 0.97, 0.99, 1.0)


@dataclass(frozen=True)
class Bin:
    """Causes reported with a probability in a range: their number, mean probability, and true share."""

    low: float
    high: float
    count: int
    told: float
    true: float


def is_worse(before: float, after: float) -> bool:
    """Whether an error of M has grown by more than rounding."""
    return after > before + FLOOR


def sure_and_wrong(j: BenchJudgement) -> list[TrueCause]:
    """Causes, of the bench or of its wiring, that are called sure and are not there."""
    return [c for c in (*j.causes, *j.wiring) if c.certainty == "sure" and not c.right]


def reliability(judgements: Sequence[BenchJudgement]) -> list[Bin]:
    """Reported against true causes, by probability; a cause is true if it or another of its set is present."""
    causes = [c for j in judgements for c in j.causes if c.certainty != "unknown"]
    p = np.array([c.probability for c in causes])
    true = np.array([c.right_set for c in causes], dtype=float)
    bin_of = np.clip(np.digitize(p, BINS) - 1, 0, len(BINS) - 2)
    bins = []
    for k, (low, high) in enumerate(pairwise(BINS)):
        mask = bin_of == k
        if mask.any():
            bins.append(Bin(low, high, int(mask.sum()), float(p[mask].mean()), float(true[mask].mean())))
    return bins


def _share(values: Sequence[bool]) -> str:
    return f"{100 * float(np.mean(values)):.1f} % of {len(values)}" if values else "none"


def _share_right(certainty: str, judgements: Sequence[BenchJudgement], right: Callable[[TrueCause], bool]) -> str:
    return _share([right(c) for j in judgements for c in j.causes if c.certainty == certainty])


def table(judgements: Sequence[BenchJudgement]) -> str:
    """The figures of one group and one choice of captures, as text."""
    crashed = [j for j in judgements if j.verdict.startswith("crashed")]
    seconds = [j.seconds for j in judgements]
    lines = [
        f"benches: {len(judgements)}, crashed {len(crashed)}, nothing written {sum(not j.written for j in judgements)}",
        f"time: median {np.median(seconds):.1f} s, at most {max(seconds):.1f} s",
        *_matrix_lines(judgements),
        *_name_lines(judgements),
    ]
    lines += [f"  {_line(j)}" for j in judgements]
    return "\n".join(lines)


def _matrix_lines(judgements: Sequence[BenchJudgement]) -> list[str]:
    fitted = [j for j in judgements if np.isfinite(j.oracle)]
    lines = []
    for name in ("declared", "corrected", "oracle"):
        values = [getattr(j, name) for j in judgements]
        if np.isfinite(values).any():
            low, middle, high = np.nanpercentile(values, [10, 50, 90])
            lines.append(f"error of M/m00, {name}: median {middle:.5f} ({low:.5f} to {high:.5f})")
    reached, nearly = ([j.corrected <= times * j.oracle + FLOOR for j in fitted] for times in (REACHED, NEARLY))
    worse = [any(is_worse(*pair) for pair in j.own.values()) for j in judgements]
    reduced = [j for j in judgements if np.isfinite(j.coverage_pixels)]
    patches = 100 * sum(j.coverage_patches for j in reduced) / max(len(reduced), 1)
    pixels = 100 * sum(j.coverage_pixels for j in reduced) / max(len(reduced), 1)
    return [
        *lines,
        f"at most {REACHED} times the fit with the true set: {_share(reached)} (goal 90 %); "
        f"{NEARLY:g} times: {_share(nearly)}",
        f"M worse than uncorrected: {sum(is_worse(j.declared, j.corrected) for j in judgements)} (goal 0); "
        f"of the captures themselves: {sum(worse)}",
        f"within 95 % intervals: {patches:.1f} % of means of patches, {pixels:.1f} % of pixels (goal 93 to 97 %)",
    ]


def _name_lines(judgements: Sequence[BenchJudgement]) -> list[str]:
    outcomes = [m.told for j in judgements for m in j.matters if m.size > MATTERS]
    lines = [
        f"called sure, and right: {_share_right('sure', judgements, lambda c: c.right)} (goal 99 %)",
        f"called likely, and right: {_share_right('likely', judgements, lambda c: c.right)}",
        f"called one of a set, and right: {_share_right('one_of', judgements, lambda c: c.right_set)}",
        f"benches without a sure wrong name: {_share([not sure_and_wrong(j) for j in judgements])}",
        f"faults that matter: named {_share([t == 'named' for t in outcomes])}, "
        f"named or in a named set {_share([t != 'missed' for t in outcomes])} (goal 80 %)",
    ]
    wired = [any(w.right for w in j.wiring) for j in judgements if "wiring" in j.group]
    if wired:
        lines.append(f"mistake of wiring told: {_share(wired)}")
    if any(j.group == "detector" for j in judgements):
        noise = _share([j.noise == "not_as_declared" for j in judgements])
        lines.append(f"noise told as not declared: {noise}; left out: {_share([bool(j.left_out) for j in judgements])}")
    lines += [
        f"told with {100 * b.low:.0f} to {100 * b.high:.0f} %: {b.count}, on average {100 * b.told:.1f} %, "
        f"true {100 * b.true:.1f} %"
        for b in reliability(judgements)
    ]
    return lines


def _line(j: BenchJudgement) -> str:
    errors = ", ".join(c.label for c in sure_and_wrong(j))
    missed = ", ".join(f"{m.label} {m.size:.1f}" for m in j.matters if m.size > MATTERS and m.told == "missed")
    return (
        f"{j.name} {j.given:6s} {j.verdict:16s} {j.seconds:6.1f} s  M {j.declared:.5f} -> {j.corrected:.5f} "
        f"(true set {j.oracle:.5f}){' WORSE' if is_worse(j.declared, j.corrected) else ''}"
        f"{f'; sure and wrong: {errors}' if errors else ''}{f'; missed: {missed}' if missed else ''}"
    )
