"""Real benches: six to ten small faults at once, the same in every capture of the bench, by other physics.

A bench is three captures (sphere and flat, unknown; air), a fourth of another sample that no fit sees, and a truth file
apart. Optics, mechanics and detector are the same in all; a source and what drifts are each capture's own. Of every
capture there is a twin without noise, by which the systematic error of a correction is measured.

Other groups have one thing wrong on such a bench, or nothing: `GROUPS`. Seeds below 1000 are for development, those
from 1000 on for one reported run each.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.instrument.model import InstrumentModel
from processing.storage.captures.schema import Sample
from simulators.blind.detector_cases import DETECTOR
from simulators.blind.lab_priors import PRIORS, draw_kinds
from simulators.blind.mosaic_faults import MOSAIC as MOSAIC_FAULTS
from simulators.blind.outside_list import EVENTS, OUTSIDE
from simulators.blind.undeclared_captures import (
    TrueBench,
    TrueScene,
    counted,
    declared_bench,
    digitize,
    expected,
    expected_electrons,
    expose,
    state_angles,
    write_capture,
)
from simulators.blind.undeclared_faults import LISTED, UNLISTED, Fault, Truth
from simulators.blind.wiring import MOSAIC_WIRING, WIRING

#: Of even and of odd seeds.
WAVELENGTHS_NM = (662.0, 451.0)
MOSAIC_NM = 662.0
PIXELS = 64
FITTED = ("sphere", "flat", "air")
VALIDATION = "validation"
#: Faults that each capture draws anew; the others belong to the bench.
OF_THE_CAPTURE = frozenset(
    {
        *("source_drift", "source_flicker", "image_drift", "retardance_drift", "rotation_slip", "angle_per_state"),
        *("bad_frame", *EVENTS),
    }
)
#: One thing wrong: kind and how it is made; the seed goes through them in turn.
GROUPS: dict[str, dict[str, Fault]] = {
    "real": {},
    "none": {},
    "single": {**LISTED},
    "mosaic": {**MOSAIC_FAULTS},
    "outside": {**UNLISTED, **OUTSIDE},
    "detector": DETECTOR,
    "wiring": WIRING,
    "mosaic_wiring": MOSAIC_WIRING,
}
#: What happens once, in one of the captures.
ONCE = frozenset({"rotation_slip", "bad_frame"})
#: Side of the squares of pixels whose mean decides whether a fault matters.
PATCH = 8


@dataclass(frozen=True)
class Polarimeter:
    """Whose bench it is.

    Attributes
    ----------
    instrument : file with the plates "psg" and "psa" (of a mosaic "psg" alone) and a polarizer named "analyzer".
    states : of one capture.
    step_deg : of the generator's plate from state to state; by default they divide its turn.
    ratio : the analyzer's plate turns so many times as far.
    """

    instrument: str = "rgb950.yaml"
    states: int = 40
    step_deg: float | None = None
    ratio: float = 4.91


RGB950 = Polarimeter()
MOSAIC = Polarimeter("mosaic_polarimeter.yaml", 16)


class RoundSample(TrueScene):
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
class TrueFault:
    """One fault of a bench, as the truth file has it.

    `capture` is None for what belongs to the bench. `matters` is, for each capture that it acts in, the rms change of
    M / m00 that it makes beside the others, in standard errors of a mean over `PATCH` x `PATCH` pixels.
    """

    kind: str
    place: str
    parameters: dict[str, float]
    capture: str | None
    matters: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class RealBench:
    """A bench of the suite, as the truth file has it."""

    name: str
    group: str
    seed: int
    instrument: str
    wavelength_nm: float
    faults: tuple[TrueFault, ...]


ONE_THING: dict[str, Fault] = {name: fault for group in GROUPS.values() for name, fault in group.items()}


@dataclass(frozen=True)
class _Draw:
    """Kind, seed and axis of one fault, before it is applied to a capture of so many states."""

    kind: str
    seed: int
    axis: str
    once: str
    states: int

    def apply(self, bench: TrueBench, capture: str) -> TrueFault | None:
        is_local = self.kind in OF_THE_CAPTURE
        # Another sample is measured later: a fault of one capture does not act in it.
        if is_local and (capture == VALIDATION or (self.kind in ONCE and capture != self.once)):
            return None
        bench.axis = self.axis
        random = np.random.default_rng([self.seed, FITTED.index(capture)] if is_local else self.seed)
        if self.kind in PRIORS:
            truth: Truth = LISTED[self.kind](bench, random, self.states, PRIORS[self.kind].sizes)
        else:
            truth = ONE_THING[self.kind](bench, random, self.states)
        return TrueFault(truth.kind, truth.place, truth.parameters, capture if is_local else None)


def make_bench(
    folder: Path,
    seed: int,
    configs: Path,
    group: str = "real",
    *,
    pixels: int = PIXELS,
    polarimeter: Polarimeter = RGB950,
) -> RealBench:
    """Write the captures of one bench under `folder` and its truth under `folder/truth`; same seed, same files.

    Parameters
    ----------
    group : one of `GROUPS`.
    pixels : side of the images.
    polarimeter : for all groups but "mosaic" and "mosaic_wiring".
    """
    random = np.random.default_rng([seed, 8128])
    name, mosaic = f"{group}_{seed:04d}", group.startswith("mosaic")
    bench_folder, truth_folder = folder / name, folder / "truth" / name
    bench_folder.mkdir(parents=True, exist_ok=True)
    truth_folder.mkdir(parents=True, exist_ok=True)
    polarimeter = MOSAIC if mosaic else polarimeter
    file = configs / "instruments" / polarimeter.instrument
    text, model = file.read_text(encoding="utf-8"), InstrumentModel.load(file)
    nm = MOSAIC_NM if mosaic else WAVELENGTHS_NM[seed % 2]
    electrons = float(random.uniform(10_000, 25_000))
    draws = [
        _Draw(
            kind,
            int(random.integers(1 << 31)),
            str(random.choice(["psg", "psa"])),
            str(random.choice(FITTED)),
            polarimeter.states,
        )
        for kind in _kinds(group, seed, random)
    ]
    scenes = _scenes(random)
    zigzag = any(d.kind == "rotation_backlash" for d in draws)
    angles = state_angles(polarimeter.states, mosaic, zigzag, polarimeter.step_deg, ratio=polarimeter.ratio)
    if mosaic:
        del angles["psa"]

    def sound() -> TrueBench:
        return declared_bench(model.at(nm), nm, pixels, mosaic, electrons=electrons)

    true_faults: dict[tuple[int, str | None], TrueFault] = {}
    for capture, scene in scenes.items():
        run = _Taken(sound, draws, capture, scene, angles)
        bench, exposed, faults = run.exposed()
        sample = Sample(kind="air" if capture == "air" else "unknown")
        noiseless = counted(bench, expected_electrons(bench, exposed))
        write_capture(truth_folder / f"{capture}.h5", bench, noiseless, angles, sample=sample, instrument=text)
        target = truth_folder / f"{capture}_noisy.h5" if capture == VALIDATION else bench_folder / f"{capture}.h5"
        write_capture(target, bench, digitize(bench, exposed, random), angles, sample=sample, instrument=text)
        np.save(truth_folder / f"{capture}.npy", true_mueller(scene, pixels))
        for i, fault in faults.items():
            first = true_faults.setdefault((i, fault.capture), fault)
            if group in ("real", "single", "outside"):
                w = model.at(nm).rows(angles).reshape(-1, 16)
                first.matters[capture] = run.matters(w, i, expected(bench, exposed))
    truth = RealBench(name, group, seed, file.name, nm, tuple(true_faults[k] for k in sorted(true_faults, key=str)))
    (truth_folder / "truth.json").write_text(json.dumps(asdict(truth), indent=1), encoding="utf-8")
    return truth


def _kinds(group: str, seed: int, random: np.random.Generator) -> list[str]:
    """Kinds of fault of one bench: many small ones, or one of the group, in turn."""
    if group == "real":
        return draw_kinds(random)
    kinds = list(GROUPS[group])
    return [kinds[seed % len(kinds)]] if kinds else []


def _scenes(random: np.random.Generator) -> dict[str, TrueScene]:
    """What stands at the sample's place in each capture."""
    return {
        "sphere": RoundSample(random),
        "flat": TrueScene(random, flat_mueller(random), brightness=0.3),
        "air": TrueScene(random, np.eye(4)),
        VALIDATION: TrueScene(random),
    }


@dataclass(frozen=True)
class _Taken:
    """One capture of a bench: as it is, and as it would be without one of its faults."""

    sound: Callable[[], TrueBench]
    draws: Sequence[_Draw]
    capture: str
    scene: TrueScene
    angles: dict[str, Array]

    def exposed(self, without: int | None = None) -> tuple[TrueBench, Array, dict[int, TrueFault]]:
        """The bench, electrons (N, rows, columns) without noise, and its faults."""
        bench = self.sound()
        done = {i: d.apply(bench, self.capture) for i, d in enumerate(self.draws) if i != without}
        return bench, expose(bench, self.scene, self.angles), {i: f for i, f in done.items() if f is not None}

    def matters(self, w: Array, fault: int, counts: Array) -> float:
        """Change of M / m00 that one fault makes, in standard errors of a mean over a patch; rms over lit pixels."""
        bench, without, _ = self.exposed(fault)
        change = _normalized(w, counts)[0] - _normalized(w, expected(bench, without))[0]
        variance = counts / bench.gain + (bench.read_noise / bench.gain) ** 2
        errors = np.tensordot(np.linalg.pinv(w) ** 2, variance, 1) / _normalized(w, counts)[1] ** 2
        lit = counts.mean(axis=0) > 0.1 * counts.mean(axis=0).max()
        return float(PATCH * np.sqrt(np.mean((change**2 / errors)[1:, lit])))


def true_mueller(scene: TrueScene, pixels: int) -> NDArray[np.float32]:
    """Mueller matrices (4, 4, rows, columns) over m00, where the image stands on average."""
    ys, xs = np.mgrid[0:pixels, 0:pixels] / pixels
    m = scene.at(xs, ys)
    return np.asarray(np.moveaxis(m / m[..., :1, :1], (2, 3), (0, 1)), dtype=np.float32)


def _normalized(w: Array, counts: Array) -> tuple[Array, Array]:
    m = np.tensordot(np.linalg.pinv(w), counts, 1)
    return m / m[0], m[0]


def read_truth(folder: Path, name: str = "*") -> Iterator[RealBench]:
    """Truth of the benches under a folder, in order of their names; or of one."""
    for path in sorted(folder.glob(f"truth/{name}/truth.json")):
        raw = json.loads(path.read_text(encoding="utf-8"))
        raw["faults"] = tuple(TrueFault(**f) for f in raw["faults"])
        yield RealBench(**raw)
