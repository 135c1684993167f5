"""Real benches: six to ten small faults at once, the same in every capture of the bench, by other physics.

A bench is three captures (sphere and flat, unknown; air), a fourth of another sample that no fit sees, and a truth file
apart. Optics, mechanics and detector are the same in all; a source and what drifts are each capture's own. Of every capture there is a
twin without noise, by which the systematic error of a correction is measured.

Seeds below 1000 are for development, those from 1000 on for one reported run each.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from processing.instrument.model import InstrumentModel
from processing.storage.capture_schema import Sample
from simulators.blind.detectable import expected
from simulators.blind.lab_priors import PRIORS, draw_kinds
from simulators.blind.suite import declared_bench, state_angles
from simulators.blind.undeclared_captures import BLACK, Bench, Scene, digitize, expose, write_capture
from simulators.blind.undeclared_faults import LISTED, Truth

Array = NDArray[np.float64]

INSTRUMENT = "rgb950.yaml"
#: Of even and of odd seeds.
WAVELENGTHS_NM = (662.0, 451.0)
STATES = 40
PIXELS = 64
FITTED = ("sphere", "flat", "air")
VALIDATION = "validation"
#: Each capture has these of its own; the others belong to the bench.
OF_THE_CAPTURE = frozenset(
    {"source_drift", "source_flicker", "image_drift", "retardance_drift", "rotation_slip", "angle_per_state"}
)
#: What happens once, in one of the captures.
ONCE = frozenset({"rotation_slip"})
#: Side of the squares of pixels whose mean decides whether a fault matters.
PATCH = 8


class Disc(Scene):
    """A scene on a ball before a dark background: soft rim, darker towards it."""

    def at(self, x: Array, y: Array, levels: Array | None = None) -> Array:
        r = np.hypot(x - 0.5, y - 0.5) / 0.42
        lit = 1 / (1 + np.exp((r - 1) / 0.012))
        fall = 0.4 + 0.6 * np.sqrt(np.maximum(1 - np.minimum(r, 1) ** 2, 0))
        return np.asarray(super().at(x, y, levels) * (0.004 + lit * fall)[..., None, None])


def flat_mueller(random: np.random.Generator) -> Array:
    """Mueller matrix of a white standard: hardly any polarization survives."""
    m = np.diag([1.0, *random.uniform(0.02, 0.15, 3)])
    m[0, 1:], m[1:, 0] = random.uniform(-0.03, 0.03, 3), random.uniform(-0.03, 0.03, 3)
    return m


@dataclass(frozen=True)
class Fault:
    """One fault of a bench, as the truth file has it.

    `capture` is None for what belongs to the bench. `matters` is the largest, over the captures that it acts in, of the
    rms change of M / m00 that it alone makes, in standard errors of a mean over `PATCH` x `PATCH` pixels.
    """

    kind: str
    place: str
    parameters: dict[str, float]
    capture: str | None
    matters: float = 0.0


@dataclass(frozen=True)
class RealBench:
    """A bench of the suite, as the truth file has it."""

    name: str
    seed: int
    instrument: str
    wavelength_nm: float
    faults: tuple[Fault, ...]


@dataclass(frozen=True)
class _Draw:
    """Kind, seed and axis of one fault, before it is applied to a capture."""

    kind: str
    seed: int
    axis: str
    once: str

    def apply(self, bench: Bench, capture: str) -> Fault | None:
        own = self.kind in OF_THE_CAPTURE
        # Another sample is measured later: what is a capture's own is not known of it, and does not act in it.
        if own and (capture == VALIDATION or (self.kind in ONCE and capture != self.once)):
            return None
        bench.axis = self.axis
        random = np.random.default_rng([self.seed, FITTED.index(capture)] if own else self.seed)
        truth: Truth = LISTED[self.kind](bench, random, STATES, PRIORS[self.kind].sizes)
        return Fault(truth.kind, truth.place, truth.parameters, capture if own else None)


def make_bench(folder: Path, seed: int, configs: Path, pixels: int = PIXELS) -> RealBench:
    """Write the captures of one bench under `folder` and its truth under `folder/truth`; same seed, same files."""
    random = np.random.default_rng([seed, 8128])
    name = f"bench_{seed:04d}"
    own, away = folder / name, folder / "truth" / name
    own.mkdir(parents=True, exist_ok=True)
    away.mkdir(parents=True, exist_ok=True)
    text = (configs / "instruments" / INSTRUMENT).read_text(encoding="utf-8")
    model = InstrumentModel.load(configs / "instruments" / INSTRUMENT)
    nm, electrons = WAVELENGTHS_NM[seed % 2], float(random.uniform(10_000, 25_000))
    draws = [
        _Draw(kind, int(random.integers(1 << 31)), str(random.choice(["psg", "psa"])), str(random.choice(FITTED)))
        for kind in draw_kinds(random)
    ]
    scenes = {
        "sphere": Disc(random),
        "flat": Scene(random, flat_mueller(random), brightness=0.3),
        "air": Scene(random, np.eye(4)),
        VALIDATION: Scene(random),
    }

    def bench_with(capture: str, without: int | None = None) -> tuple[Bench, dict[int, Fault]]:
        bench = declared_bench(model.at(nm), nm, pixels, False, electrons)
        done = {i: d.apply(bench, capture) for i, d in enumerate(draws) if i != without}
        return bench, {i: f for i, f in done.items() if f is not None}

    zigzag = any(d.kind == "rotation_backlash" for d in draws)
    angles = state_angles(STATES, False, zigzag)
    w = model.at(nm).rows(angles).reshape(STATES, 16)
    found: dict[tuple[int, str | None], Fault] = {}
    for capture, scene in scenes.items():
        bench, faults = bench_with(capture)
        exposed = expose(bench, scene, angles)
        sample = Sample(kind="air" if capture == "air" else "unknown")
        quiet = np.asarray(np.rint(expected(bench, exposed) + BLACK), dtype=np.uint16)
        write_capture(away / f"{capture}.h5", bench, quiet, angles, sample, text)
        target = away / f"{capture}_noisy.h5" if capture == VALIDATION else own / f"{capture}.h5"
        write_capture(target, bench, digitize(bench, exposed, random), angles, sample, text)
        np.save(away / f"{capture}.npy", true_mueller(scene, pixels))
        for i, fault in faults.items():
            others, _ = bench_with(capture, without=i)
            change = _change(w, expected(bench, exposed), expected(others, expose(others, scene, angles)))
            key = (i, fault.capture)
            size = max(_in_errors(change, w, expected(bench, exposed), bench), found.get(key, fault).matters)
            found[key] = replace(fault, matters=size)
    truth = RealBench(name, seed, INSTRUMENT, nm, tuple(found[k] for k in sorted(found, key=str)))
    (away / "truth.json").write_text(json.dumps(asdict(truth), indent=1), encoding="utf-8")
    return truth


def true_mueller(scene: Scene, pixels: int) -> NDArray[np.float32]:
    """Mueller matrices (4, 4, rows, columns) over m00, where the image stands on average."""
    ys, xs = np.mgrid[0:pixels, 0:pixels] / pixels
    m = scene.at(xs, ys)
    return np.asarray(np.moveaxis(m / m[..., :1, :1], (2, 3), (0, 1)), dtype=np.float32)


def _normalized(w: Array, counts: Array) -> tuple[Array, Array]:
    m = np.tensordot(np.linalg.pinv(w), counts, 1)
    return m / m[0], m[0]


def _change(w: Array, with_it: Array, without: Array) -> Array:
    """Change (16, rows, columns) of M / m00, as the declared model reduces both."""
    return np.asarray(_normalized(w, with_it)[0] - _normalized(w, without)[0])


def _in_errors(change: Array, w: Array, counts: Array, bench: Bench) -> float:
    """Root mean square of the change, in standard errors of a mean over a patch of pixels."""
    variance = counts / bench.gain + (bench.read_noise / bench.gain) ** 2
    errors = np.tensordot(np.linalg.pinv(w) ** 2, variance, 1) / _normalized(w, counts)[1] ** 2
    lit = counts.mean(axis=0) > 0.1 * counts.mean(axis=0).max()
    return float(PATCH * np.sqrt(np.mean((change**2 / errors)[1:, lit])))


def read_truth(folder: Path) -> Iterator[RealBench]:
    """Truth of every bench under a folder, in order of its name."""
    for path in sorted(folder.glob("truth/*/truth.json")):
        raw = json.loads(path.read_text(encoding="utf-8"))
        raw["faults"] = tuple(Fault(**f) for f in raw["faults"])
        yield RealBench(**raw)
