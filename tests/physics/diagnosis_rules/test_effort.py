"""Steps, tolerances, caches: all of them changed at once, `diagnose` gives the same answers."""

import ast
import inspect
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FunctionType, ModuleType

import numpy as np
import pytest
import rules_page
from bench_capture import bench_capture
from rule_decisions import MODULES, Patch

from processing.diagnosis.instrument.run import diagnose_captures
from processing.diagnosis.search import fit, range_of
from processing.diagnosis.search.result import Diagnosis
from processing.diagnosis.surface import naming
from processing.diagnosis.surface.run import diagnose_object
from processing.instrument.model import InstrumentModel
from simulators.bench.scene import Scene
from simulators.blind.sphere_suite import drawn, take
from simulators.blind.undeclared_captures import Bench

#: Part of its standard error by which a value may move.
STILL = 0.1
BY_NAME = {module.__name__: module for module in MODULES}
TREES = {module: ast.parse(Path(module.__file__ or "").read_text(encoding="utf-8")) for module in MODULES}

IMPORTED = [
    (module, node.module, alias)
    for module, tree in TREES.items()
    for node in tree.body
    if isinstance(node, ast.ImportFrom)
    for alias in node.names
]
#: What only large captures reach, at sizes that these reach too.
SMALL: dict[tuple[str, str], int] = {
    ("captured/capture_data.py", "STRIP_ROWS"): 5,
    ("captured/common_rest.py", "PIXELS_OF_SCALE"): 200,
    ("captured/detector_noise.py", "MOST_VALUES"): 15_000,
    ("captured/noise_estimate.py", "PIXELS"): 400,
    ("instrument/pixel_sums.py", "STRIP_PX"): 100,
    ("instrument/pixel_sums.py", "STRIP_ROWS"): 5,
    ("instrument/pixel_sums.py", "TOGETHER"): 70,
    ("instrument/pixel_sums.py", "MANY_PX"): 100,
    ("instrument/pixel_sums.py", "PIXELS_OF_BASIS"): 100,
    ("instrument/problem.py", "MOST_BUILT"): 5,
    ("instrument/tile_sums.py", "TOGETHER"): 7,
}


def changed(value: object, factor: float) -> object:
    """Another value: a whole number by one at least."""
    if not isinstance(value, int):
        return value * factor
    return max(round(value * factor), value + 1) if factor > 1 else max(min(round(value * factor), value - 1), 1)


def users(module: ModuleType, name: str) -> Iterator[tuple[ModuleType, str]]:
    """Where a constant of a module is known, and as what."""
    yield module, name
    for user, of, alias in IMPORTED:
        if of == module.__name__ and alias.name == name:
            yield user, alias.asname or name


def with_default(module: ModuleType, name: str) -> Iterator[tuple[FunctionType, int]]:
    """Functions of a module that have a constant for a default, and the number of that among their defaults."""
    for node in TREES[module].body:
        for k, default in enumerate(node.args.defaults if isinstance(node, ast.FunctionDef) else []):
            if isinstance(default, ast.Name) and default.id == name:
                yield getattr(module, node.name), k


CONSTANTS = [n for n in rules_page.beside_the_rules() if not n.fixed]
MODULE_OF = {n: BY_NAME["processing.diagnosis." + n.where.removesuffix(".py").replace("/", ".")] for n in CONSTANTS}
KNOWN = {n: list(users(MODULE_OF[n], n.name)) for n in CONSTANTS}
DEFAULTS = {n: [found for user, name in KNOWN[n] for found in with_default(user, name)] for n in CONSTANTS}


def change_all(m: Patch, factor: float) -> None:
    """Change every constant that is neither a rule nor fixed."""
    for n in CONSTANTS:
        value = SMALL.get((n.where, n.name), vars(MODULE_OF[n])[n.name])
        value = value if factor == 1 else changed(value, factor)
        for user, name in KNOWN[n]:
            m.setattr(user, name, value)
        for function, k in DEFAULTS[n]:
            defaults = list(function.__defaults__ or ())
            defaults[k] = value
            m.setattr(function, "__defaults__", tuple(defaults))


def unknown_sample(folder: Path, configs: Path) -> Diagnosis:
    """A sample that is not known, a source that drifts, and a generator that wobbles."""
    bench = Bench(rows=24, columns=24, dg=np.deg2rad(128.12))
    bench.level.append(lambda k, a: 1 + 0.02 * k / 40)
    bench.angles.append(lambda k, a: a | {"psg": a["psg"] + np.deg2rad(0.3) * np.cos(a["psg"])})
    return of_air_or_not(folder, configs, bench, air=False)


def air(folder: Path, configs: Path) -> Diagnosis:
    """A plate of another retardance, in an image that moves."""
    bench = Bench(rows=24, columns=24, dg=np.deg2rad(128.12))
    bench.shift.append(lambda k, a: (0.3 * np.cos(a["psa"]), 0.3 * np.sin(a["psa"])))
    return of_air_or_not(folder, configs, bench, air=True)


def wrong_gain(folder: Path, configs: Path) -> Diagnosis:
    """Nothing is wrong but what is told of the camera."""
    return of_air_or_not(folder, configs, Bench(rows=24, columns=24, declared={"gain_e_per_count": 0.65}), air=True)


def of_air_or_not(folder: Path, configs: Path, bench: Bench, air: bool, calibrate: tuple[str, ...] = ()) -> Diagnosis:
    file = configs / "instruments/rgb950.yaml"
    path = bench_capture(folder, file, bench, air=air)
    declared = InstrumentModel.load(file).model_copy(update={"calibrate": calibrate})
    return diagnose_captures([path], declared)[0].diagnosis


def unknown_noise(folder: Path, configs: Path) -> Diagnosis:
    """The same plate, of a camera of which nothing is told: its noise is estimated."""
    silent = dict.fromkeys(("gain_e_per_count", "read_noise_e", "full_well_e"))
    return of_air_or_not(folder, configs, Bench(rows=24, columns=24, dg=np.deg2rad(128.12), declared=silent), air=True)


def nominal_train(folder: Path, configs: Path) -> Diagnosis:
    """A mount and a retardance are only nominal, and a source drifts."""
    bench = Bench(rows=24, columns=24, dg=np.deg2rad(124.12), og=np.deg2rad(-19.02))
    bench.level.append(lambda k, a: 1 + 0.02 * k / 40)
    return of_air_or_not(folder, configs, bench, True, ("psg_retarder.azimuth_deg", "psg_retarder.retardance_deg"))


def surface(folder: Path, configs: Path) -> Diagnosis:
    """A sphere that is lit from elsewhere."""
    scene = Scene.load(configs / "scenes/red_sphere.yaml")
    declared = InstrumentModel.load(configs / "instruments/linear_stokes.yaml")
    fault = drawn("illumination_azimuth", np.random.default_rng(11), scene, declared)
    take(folder / "capture.h5", fault, declared, 662.0, 35.0, 1)
    return diagnose_object([folder / "capture.h5"], declared, fault.material, scene.object.geometry)[0].diagnosis


def answers(found: Diagnosis) -> list[object]:
    told = [(e.kind, e.element, e.answer, e.indistinguishable_from) for e in found.effects]
    noise = found.noise and found.noise.verdict
    return [found.verdict, noise, found.recommendation, sorted(found.unobservable), sorted(found.calibrated), *told]


def values(found: Diagnosis) -> np.ndarray:
    """Values and standard errors (2, K) of what was found."""
    of_effects = [p for e in found.effects for p in e.parameters.values()]
    told = [(np.atleast_1d(p.value), np.atleast_1d(p.stderr)) for p in (*of_effects, *found.calibrated.values())]
    return np.concatenate([np.zeros((2, 0)), *map(np.stack, told)], axis=1)


Asked = Callable[[Path, Path], Diagnosis]


@pytest.mark.parametrize("asked", [unknown_sample, air, wrong_gain, unknown_noise, nominal_train, surface])
def test_answers_do_not_depend_on_effort(asked: Asked, configs: Path, tmp_path: Path, monkeypatch: Patch) -> None:
    seen = []
    for factor in (1.0, 1.25, 0.8):
        folder = tmp_path / str(factor)
        folder.mkdir()
        with monkeypatch.context() as m:
            change_all(m, factor)
            seen.append(asked(folder, configs))
    assert answers(seen[1]) == answers(seen[0])
    assert answers(seen[2]) == answers(seen[0])
    (value, error), *others = map(values, seen)
    for other, _ in others:
        np.testing.assert_array_less(np.abs(other - value), STILL * error)
    assert len(CONSTANTS) > 60


def test_a_change_reaches_those_who_import_a_constant_and_defaults(monkeypatch: Patch) -> None:
    change_all(monkeypatch, 0.8)
    assert fit.LEAST_GAIN == naming.LEAST_GAIN == pytest.approx(0.008)
    assert inspect.signature(fit.minimize).parameters["steps"].default == fit.STEPS == 12
    assert inspect.signature(range_of.range_of).parameters["least"].default == range_of.RANK == pytest.approx(8e-9)
