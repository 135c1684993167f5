"""A blind test of `diagnose`: captures with undeclared faults, the truth in a file that `diagnose` never opens.

`make` writes captures and truth.json; `blind_judge` compares what `diagnose` said with the truth. Seeds below 1000 are
for development, 1000 is for CI, any other is for one reported run.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from processing.arrays import Array
from processing.instrument.model import InstrumentModel, Polarizer, Retarder
from processing.storage.captures.schema import Sample
from simulators.blind.detectable import evidence, expected
from simulators.blind.mosaic_faults import MOSAIC
from simulators.blind.undeclared_captures import Bench, Scene, digitize, expose, write_capture
from simulators.blind.undeclared_faults import LISTED, UNLISTED, Fault, Truth

SHARES = {"single": 0.62, "two": 0.12, "none": 0.1, "unlisted": 0.16}
INSTRUMENTS = {"drr": "rgb950.yaml", "mosaic": "mosaic_polarimeter.yaml"}
FAULTS: dict[str, Fault] = {**LISTED, **MOSAIC, **UNLISTED}
#: One pair in so many is drawn for the polarization camera.
MOSAIC_PAIRS = 5


@dataclass(frozen=True)
class Case:
    """One capture of the suite, as the truth file has it.

    `detectable` is the chi-square that each fault adds beyond what the free unknowns and the other fault take up.
    """

    name: str
    group: str
    faults: tuple[Truth, ...]
    sample: str
    instrument: str
    wavelength_nm: float
    detectable: tuple[float, ...]


def make(
    folder: Path, count: int, seed: int, configs: Path, only: str | None = None, beside: str | None = None
) -> list[Case]:
    """Write `count` captures and truth.json; the same seed gives the same files.

    Parameters
    ----------
    only : one of `SHARES`, to draw that kind of case alone.
    beside : one of `LISTED`, to draw that fault and another one in every case.
    """
    only = "two" if beside else only
    folder.mkdir(parents=True, exist_ok=True)
    shares = SHARES if only is None else {only: 1.0}
    groups = [g for g, share in shares.items() for _ in range(round(share * count))][:count]
    groups += ["single"] * (count - len(groups))
    used: Counter[str] = Counter()
    cases = []
    for k, group in enumerate(groups):
        random = np.random.default_rng([seed, k])
        chosen = _chosen(group, used[group], random)
        if beside:
            chosen = [beside, str(random.choice([n for n in LISTED if n != beside]))]
        used[group] += 1
        cases.append(_case(folder, f"case_{k:03d}", group, chosen, random, configs))
    (folder / "truth.json").write_text(json.dumps([asdict(c) for c in cases], indent=1), encoding="utf-8")
    return cases


def _chosen(group: str, number: int, random: np.random.Generator) -> list[str]:
    if group == "single":
        names = [*LISTED, *MOSAIC]
        return [names[number % len(names)]]
    if group == "unlisted":
        return [list(UNLISTED)[number % len(UNLISTED)]]
    if group == "none":
        return []
    if number % MOSAIC_PAIRS == MOSAIC_PAIRS - 1:
        # A polarization camera has no turning analyzer.
        others = [n for n in LISTED if not n.startswith(("psa_", "analyzer_"))]
        first = str(random.choice(list(MOSAIC)))
        return [first, str(random.choice([n for n in (*MOSAIC, *others) if n != first]))]
    return [str(c) for c in random.choice(list(LISTED), 2, replace=False)]


def _case(folder: Path, name: str, group: str, chosen: list[str], random: np.random.Generator, configs: Path) -> Case:
    mosaic = any(c in MOSAIC for c in chosen)
    instrument = INSTRUMENTS["mosaic" if mosaic else "drr"]
    text = (configs / "instruments" / instrument).read_text(encoding="utf-8")
    model = InstrumentModel.load(configs / "instruments" / instrument)
    # Captures of a known and of an unknown sample are equally frequent.
    air = bool(random.random() < 0.5)
    nm = float(random.choice(list(model.wavelengths_nm or (662.0,))))
    size = 48 if mosaic else int(random.choice([32, 40, 48]))
    electrons = float(random.uniform(5_000, 25_000))
    states = 16 if mosaic else 40
    scene = Scene(random, np.eye(4) if air else None)
    draws = [int(random.integers(1 << 31)) for _ in chosen]

    def bench_with(use: Sequence[int]) -> tuple[Bench, list[Truth]]:
        bench = declared_bench(model.at(nm), nm, size, mosaic, electrons)
        return bench, [FAULTS[chosen[i]](bench, np.random.default_rng(draws[i]), states) for i in use]

    bench, faults = bench_with(range(len(chosen)))
    angles = state_angles(states, mosaic, bench.zigzag)
    if mosaic:
        angles = {"psg": angles["psg"]}
    exposed = expose(bench, scene, angles)
    counts = digitize(bench, exposed, random)
    sample = Sample(kind="air" if air else "unknown")
    path = folder / f"{name}.h5"
    write_capture(path, bench, counts, angles, sample, text)
    detectable = []
    for i in range(len(chosen)):
        others = [k for k in range(len(chosen)) if k != i]
        without, truths = bench_with(others)
        light = expected(without, expose(without, scene, angles)) if others else None
        detectable.append(evidence(path, model.at(nm), expected(bench, exposed), faults[i], light, truths))
    return Case(name, group, tuple(faults), sample.kind, instrument, nm, tuple(detectable))


def declared_bench(model: InstrumentModel, nm: float, size: int, mosaic: bool, electrons: float) -> Bench:
    """A bench that is what its model (resolved at the wavelength) declares."""
    bench = Bench(rows=size, columns=size, mosaic=mosaic, electrons=electrons, wavelength_nm=nm)
    for element in model.elements():
        azimuth = _radians(element.azimuth_deg)
        if isinstance(element, Retarder):
            retardance = _radians(element.retardance_deg)
            if element.axis == "psg":
                bench.og, bench.dg = azimuth, retardance
            else:
                bench.oa, bench.da = azimuth, retardance
        elif isinstance(element, Polarizer) and element.name == "analyzer":
            bench.lp = azimuth
    return bench


def _radians(value_deg: float | dict[float, float]) -> float:
    if isinstance(value_deg, dict):
        raise ValueError("the model is not resolved at a wavelength")
    return float(np.deg2rad(value_deg))


def state_angles(
    states: int, mosaic: bool, zigzag: bool, step_deg: float | None = None, ratio: float = 4.91
) -> dict[str, Array]:
    """Angles of both axes in degrees; `zigzag` reaches states from both sides. Steps divide a turn, or half of it."""
    step = step_deg or (180.0 if mosaic else 360.0) / states
    psg = np.asarray(step * np.arange(states), dtype=np.float64)
    order = np.arange(states)
    if zigzag:
        # Every third step goes back: states are reached from both sides.
        order = np.concatenate([g[::-1] for g in np.array_split(order, max(states // 3, 1))])
    return {"psg": np.asarray(psg[order]), "psa": np.asarray(ratio * psg[order])}
