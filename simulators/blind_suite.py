"""A blind test of `diagnose`: captures with undeclared faults, the truth in a file that `diagnose` never opens.

`make` writes captures and truth.json; `judge` compares what `diagnose` said with the truth and counts. Seeds are in
three ranges that are never mixed: below 1000 for development, 1000 for CI, 5000 for the reported run.
"""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.capture_schema import Sample
from simulators.faults_undeclared import LISTED, MOSAIC, UNLISTED, Truth
from simulators.undeclared import Bench, Scene, digitize, expose, write_capture

Array = NDArray[np.float64]

#: Chi-square that the fault adds beyond what the free unknowns take up; from here on it is detectable.
DETECTABLE = 50.0
SHARES = {"single": 0.62, "two": 0.12, "none": 0.1, "unlisted": 0.16}
#: Captures of a known and of an unknown sample are equally frequent.
INSTRUMENTS = {"drr": "rgb950.yaml", "mosaic": "mosaic_polarimeter.yaml"}
#: A cause that is not in the list, with names that would still be true.
TRUE_NAMES = {"lamp_beat": {"source_flicker"}}
#: Two of these act through the same numbers and are not drawn together.
ALONE = {"saturation", "angle_per_state", "source_flicker", "stray_light", "rotation_backlash"}


@dataclass(frozen=True)
class Case:
    """One capture of the suite, as the truth file has it."""

    name: str
    group: str
    faults: tuple[Truth, ...]
    sample: str
    instrument: str
    detectable: tuple[float, ...]


@dataclass
class Score:
    """Counts of the suite."""

    single: list[tuple[Case, dict[str, Any], bool]] = field(default_factory=list)
    lines: list[str] = field(default_factory=list)
    numbers: dict[str, float] = field(default_factory=dict)
    confusion: Counter[tuple[str, str]] = field(default_factory=Counter)


def make(folder: Path, count: int, seed: int, configs: Path) -> list[Case]:
    """Write `count` captures and truth.json; the same seed gives the same files."""
    folder.mkdir(parents=True, exist_ok=True)
    groups = [g for g, share in SHARES.items() for _ in range(round(share * count))][:count]
    groups += ["single"] * (count - len(groups))
    names = {"single": [*LISTED, *MOSAIC], "unlisted": list(UNLISTED), "two": list(LISTED)}
    used: Counter[str] = Counter()
    cases = []
    for k, group in enumerate(groups):
        random = np.random.default_rng([seed, k])
        if group in ("single", "unlisted"):
            chosen = [names[group][used[group] % len(names[group])]]
        elif group == "two":
            pair = [n for n in names["two"] if n not in ALONE]
            chosen = [str(c) for c in random.choice(pair, 2, replace=False)]
        else:
            chosen = []
        used[group] += 1
        cases.append(_case(folder, f"case_{k:03d}", group, chosen, random, configs))
    (folder / "truth.json").write_text(json.dumps([asdict(c) for c in cases], indent=1), encoding="utf-8")
    return cases


def _case(folder: Path, name: str, group: str, chosen: list[str], random: np.random.Generator, configs: Path) -> Case:
    mosaic = any(c in MOSAIC for c in chosen)
    air = bool(random.random() < 0.5)
    instrument = INSTRUMENTS["mosaic" if mosaic else "drr"]
    size = 48 if mosaic else 32
    bench = Bench(rows=size, columns=size, mosaic=mosaic, electrons=float(random.uniform(5_000, 25_000)))
    clean = Bench(rows=size, columns=size, mosaic=mosaic, electrons=bench.electrons)
    states = 16 if mosaic else 40
    scene = Scene(random, np.eye(4) if air else None)
    faults, parts = [], []
    for kind in chosen:
        draw = int(random.integers(1 << 31))
        fault = {**LISTED, **MOSAIC, **UNLISTED}[kind]
        faults.append(fault(bench, np.random.default_rng(draw), states))
        alone = Bench(rows=size, columns=size, mosaic=mosaic, electrons=clean.electrons)
        fault(alone, np.random.default_rng(draw), states)
        parts.append(alone)
    angles = state_angles(states, mosaic, bench.zigzag)
    if mosaic:
        angles = {"psg": angles["psg"]}
    detectable = tuple(_excess(b, scene, angles, air, configs / "instruments" / instrument) for b in parts)
    counts = digitize(bench, expose(bench, scene, angles), random)
    text = (configs / "instruments" / instrument).read_text(encoding="utf-8")
    sample = Sample(kind="air" if air else "unknown")
    write_capture(folder / f"{name}.h5", bench, counts, angles, sample, text)
    return Case(name, group, tuple(faults), sample.kind, instrument, detectable)


def state_angles(states: int, mosaic: bool, zigzag: bool) -> dict[str, Array]:
    """Angles of both axes in degrees; `zigzag` reaches states from both sides."""
    step = 360.0 / states if not mosaic else 180.0 / states
    psg = np.asarray(step * np.arange(states), dtype=np.float64)
    order = np.arange(states)
    if zigzag:
        # Every third step goes back: states are reached from both sides.
        order = np.concatenate([g[::-1] for g in np.array_split(order, max(states // 3, 1))])
    return {"psg": np.asarray(psg[order]), "psa": np.asarray(4.91 * psg[order])}


def _excess(bench: Bench, scene: Scene, angles: dict[str, Array], air: bool, instrument: Path) -> float:
    """Chi-square of the noise-free intensities against the declared model, its free unknowns taken out."""
    from processing.instrument import InstrumentModel

    model = InstrumentModel.load(instrument).at(662.0)
    electrons = np.minimum(expose(bench, scene, angles), bench.full_well)
    for curve in bench.transfer:
        electrons = curve(electrons)
    n = electrons.shape[0]
    w = model.rows(angles)
    if bench.mosaic:
        planes = [electrons[:, r::2, c::2] for r, c in ((1, 1), (0, 1), (0, 0), (1, 0))]
        y = np.stack(planes, axis=1).reshape(n * 4, -1)
    else:
        y = electrons.reshape(n, -1)
    a = w.reshape(-1, 16)
    a = a @ np.eye(4).reshape(16, 1) if air else a
    sigma = np.sqrt(np.maximum(y, 0) + bench.read_noise**2)
    mean = np.sqrt(np.mean(sigma**2, axis=1))
    u, size, _ = np.linalg.svd(a / mean[:, None], full_matrices=False)
    q = u[:, size > 1e-8 * size[0]]
    scaled = y / mean[:, None]
    left = scaled - q @ (q.T @ scaled)
    return float(np.sum((left * mean[:, None] / sigma) ** 2))


def said(result: dict[str, Any]) -> tuple[set[str], set[str]]:
    """Kinds that a diagnosis names, and those that it names or cannot tell from them."""
    named = {e["kind"] for e in result["effects"] if e["confident"]}
    around = {text.partition("[")[0] for e in result["effects"] for text in e["indistinguishable_from"]}
    left = result.get("unexplained") or {}
    empirical = left.get("empirical") or {}
    if result["verdict"] == "unexplained":
        around |= {text.partition("[")[0] for text in empirical.get("would_also_fit", ())}
    return named, named | around


def judge(cases: list[Case], results: dict[str, dict[str, Any]]) -> Score:
    """Count right and wrong answers."""
    score = Score()
    groups: dict[str, list[bool]] = {"single": [], "two": [], "none": [], "unlisted": [], "error": []}
    inside: list[bool] = []
    for case in cases:
        result = results[case.name]
        named, around = said(result)
        kinds = {t.kind for t in case.faults}
        row = "+".join(sorted(kinds)) or "nothing"
        column = "+".join(sorted(named)) or result["verdict"]
        score.confusion[row, column] += 1
        seen = all(d > DETECTABLE for d in case.detectable)
        if case.group == "none":
            good = result["verdict"] == "consistent"
        elif case.group == "unlisted":
            good = not named or named <= TRUE_NAMES.get(next(iter(kinds)), set())
        else:
            if not seen:
                continue
            good = kinds <= around
            if case.group == "single" and named == kinds:
                inside += _within(case.faults[0], result)
                floor = result["noise_floor_percent"]
                groups["error"].append(result["error_after"]["rms_percent"] <= 1.1 * floor)
        groups[case.group].append(good)
        if not good:
            score.lines.append(
                f"{case.name} {case.sample} truth {row} ({', '.join(f'{d:.0f}' for d in case.detectable)}): "
                f"{result['verdict']} {column}"
            )
    for name, marks in groups.items():
        score.numbers[name] = float(np.mean(marks)) if marks else float("nan")
        score.numbers[f"{name}_count"] = len(marks)
    score.numbers["parameters"] = float(np.mean(inside)) if inside else float("nan")
    score.numbers["parameters_count"] = len(inside)
    return score


def _within(truth: Truth, result: dict[str, Any]) -> list[bool]:
    effect = result["effects"][0]
    marks = []
    for name, value in truth.parameters.items():
        found = effect["parameters"].get(name)
        same_place = not truth.place or effect["element"] == truth.place
        if found is not None and found["stderr"] is not None and same_place:
            marks.append(bool(abs(found["value"] - value) <= 3 * found["stderr"]))
    return marks


def table(score: Score) -> str:
    """The confusion matrix and the numbers, as text."""
    lines = ["truth -> answer: count"]
    for (row, column), n in sorted(score.confusion.items()):
        lines.append(f"  {row} -> {column}: {n}")
    lines += ["wrong:", *(f"  {line}" for line in score.lines)]
    wanted = {
        "single": ("right kind or within the named set", 0.95),
        "parameters": ("parameter within 3 standard errors", 0.99),
        "error": ("error after at most 1.1 noise floor", 1.0),
        "two": ("two effects, both", 0.85),
        "none": ("nothing there: consistent", 0.99),
        "unlisted": ("not in the list: no wrong name", 0.95),
    }
    for key, (text, goal) in wanted.items():
        value, n = score.numbers[key], int(score.numbers[f"{key}_count"])
        lines.append(f"{text}: {100 * value:.1f} % of {n} (goal {100 * goal:.0f} %)")
    return "\n".join(lines)
