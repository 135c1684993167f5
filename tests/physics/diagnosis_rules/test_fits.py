"""Constants by which values are fitted, and what is told, stored and asked of them."""

from pathlib import Path
from types import SimpleNamespace as Some

import numpy as np
from rule_decisions import Asked, Patch, decides, made
from test_search import rounds
from test_wiring_and_correction import without_name

from processing.diagnosis import instrument_file
from processing.diagnosis.instrument import (
    nameless_effects,
    problem,
    recommend,
    starts,
    systematic,
    telling,
    wiring,
)
from processing.diagnosis.instrument.diagnose import _unexplained
from processing.diagnosis.search import causes, fit, own_minima, reduced_sets
from processing.diagnosis.search.candidate import Candidate, NominalValue
from processing.diagnosis.search.guard import rows_checks
from processing.diagnosis.search.sets import State
from processing.diagnosis.search.space import Space, Sums
from processing.diagnosis.surface import write
from processing.instrument.changes import Conditions
from processing.instrument.effects.base import InstrumentEffect, PointwiseEffect
from processing.instrument.model import InstrumentModel
from processing.reflectance import polarized_diffuse

MODEL = InstrumentModel.load(Path(__file__).parents[3] / "configs/instruments/rgb950.yaml").at(662)


def nominal(field: str, value: float = 1.0) -> Candidate:
    """A nominal value of an element that has another one in the instrument file."""
    element = Some(name="e", **{field: value})
    model = Some(value_of=lambda name: getattr(element, name.rpartition(".")[2]), name="")
    effect = NominalValue(f"e.{field}", model)
    return Candidate(effect, f"e.{field}", effect.parameters(model, None, ""))


def typical(field: str, value: float = 1.0) -> float:
    return float(nominal(field, value).typical[0])


@decides
def test_nominal_deg(m: Patch) -> bool:
    return typical("azimuth_deg") == typical("retardance_deg") == 30.0


@decides
def test_window_deg(m: Patch) -> bool:
    return typical("retardance_deg", 0.0) == 1.0


@decides
def test_nominal_extinction(m: Patch) -> bool:
    return typical("extinction") == 0.1


@decides
def test_nominal_share(m: Patch) -> bool:
    return typical("diattenuation") == typical("depolarization") == 0.01


@decides
def test_nominal_gain(m: Patch) -> bool:
    return typical("gain") == 0.1


def begun(m: Patch, space: Space) -> list[np.ndarray]:
    """Places from which the values of a space are fitted, where none is near enough."""
    places = []

    def minimize(problem: object, space: Space, start: np.ndarray, **of: object) -> Some:
        places.append(start)
        return Some(values=start, excess=1.0, rms=1.0)

    m.setattr(starts, "minimize", minimize)
    starts._searched(None, space, (), Some(values=np.zeros(space.size), excess=0.0))
    return places


@decides
def test_starts(m: Patch) -> bool:
    return len(begun(m, Space((nominal("azimuth_deg"),)))) == 1 + 24


def widths(m: Patch) -> tuple[float, float]:
    """Half widths of the starts of a retardance, near and far."""
    _, *places = begun(m, Space((nominal("retardance_deg"),)))
    shares = np.random.default_rng(0).uniform(-1, 1, 2)
    near, far = np.array([places[0][0], places[1][0]]) / shares
    return round(near, 6), round(far, 6)


@decides
def test_near_deg(m: Patch) -> bool:
    return widths(m)[0] == 20.0


@decides
def test_far_deg(m: Patch) -> bool:
    return widths(m)[1] == 120.0


@decides
def test_few_starts(m: Patch) -> bool:
    asked = []

    def best(problem: object, space: object, places: int) -> Some:
        asked.append(places)
        return Some(values=np.zeros(0))

    m.setattr(wiring, "best_of_starts", best)
    m.setattr(wiring, "_mistakes", lambda problem: ())
    m.setattr(wiring, "_left", lambda *of: 0.0)
    wiring.miswired_train(Some(nominal=lambda: (), undivided=lambda: None, wavelengths_nm=(662.0,)))
    return asked == [5]


@decides
def test_less_from_afar(m: Patch) -> bool:
    def taken(left: float) -> bool:
        m.setattr(starts, "minimize", lambda *of: Some(excess=left, values=np.ones(1)))
        far = made()
        pool = [Candidate(far.effect, "", far.parameters, None, (np.ones(1),))]
        return bool(starts._far(None, pool, Some(excess=100.0)))

    return taken(48.0) and not taken(52.0)


@decides
def test_fewer_rounds(m: Patch) -> bool:
    # The first of them begins with everything, and the last is averaged.
    return len(rounds(m, known=False, told=False)[0]) == 4 - 1


@decides
def test_exact(m: Patch) -> bool:
    space = Space((made(type("Bent", (PointwiseEffect,), {"undo": None})),))
    asked = object.__new__(problem.InstrumentProblem)
    asked._noise_at, asked.captures = {}, (Some(slope=np.ones(1), noise_estimated=False),)
    return [asked.has_noise_of(space, np.array([size])) for size in (0.29, 0.31)] == [True, False]


@decides
def test_enough_sound(m: Patch) -> bool:
    def fitted(states: int) -> bool:
        added = []
        m.setattr(problem, "add_block", lambda *of: added.append(of))
        m.setattr(problem, "replace", lambda block, rows: Some(rows=rows))
        block = Some(clipped=True, sound=np.arange(states), rows=np.arange(60))
        asked = Some(
            moments=[Some(blocks=[block])],
            _columns_of_one_source=lambda *of: np.ones((60, 16)),
            coefficients=lambda *of: None,
            _rows_apart=lambda k: None,
        )
        changes = Some(drop_clipped=True)
        problem.InstrumentProblem._block_sums(asked, 0, None, None, changes, None, derivatives=False)
        return bool(added)

    return fitted(24) and not fitted(23)


@decides
def test_certain(m: Patch) -> bool:
    def certain(odds: float, other: float) -> list[bool]:
        sets = Asked([odds, other])
        sets.many = np.array([True, True])
        sets.without = lambda state, k: state
        return reduced_sets._worth(sets, State(np.array([1.0, 0.0])))[0].tolist()

    return certain(26.0, -1.0) == [True, False] and certain(24.0, -60.0) == [False, False]


@decides
def test_enough(m: Patch) -> bool:
    def found(left: float) -> float:
        lefts = iter([100.0, left])
        m.setattr(own_minima, "minimize", lambda *of, **how: Some(values=np.zeros(1), excess=next(lefts)))
        asked = object.__new__(own_minima.OwnMinima)
        asked.problem, asked._unit = None, lambda fit: 1.0
        far = made()
        space = Space((Candidate(far.effect, "", far.parameters, None, (np.ones(1),)),))
        return asked._deepest(space, np.zeros(1), 1.0).excess

    return found(99.952) == 100.0 and found(99.948) == 99.948


@decides
def test_shown(m: Patch) -> bool:
    one = [causes.shown(np.array([size]), np.eye(1)) > 1 for size in (2.9, 3.1)]
    # Of a hundred values a chi-square of 100 is chance, and three deviations of it more.
    many = [causes.shown(np.full(100, size), np.eye(100)) > 1 for size in (1.18, 1.20)]
    return one == many == [False, True]


@decides
def test_wiring_scatter(m: Patch) -> bool:
    sums = Sums.empty(1, 0)
    sums.freedom[0] = 50.0
    return wiring._left(Some(sums=lambda *of, **how: sums, noise_known=True, spread=1.0), None, None) == 40.0


@decides
def test_measured(m: Patch) -> bool:
    def rank(least: float) -> int:
        w = np.diag([1.0] * 15 + [least])
        return int(rows_checks("a", w, w)[0].after)

    return [rank(least) for least in (0.9e-6, 1.1e-6)] == [15, 16]


@decides
def test_also_fits(m: Patch) -> bool:
    # Two of chi-square may be lost, and half as much again.
    told = without_name(m, 0.0, 2.9, 3.1)
    return told is not None and told.would_also_fit == ("k0", "k1")


@decides
def test_least_freedom(m: Patch) -> bool:
    sums = Sums.empty(1, 9)
    sums.freedom[0], sums.curvature[0] = 10.0, 1e12 * np.eye(9)
    space = Space((made(size=9),))
    return abs(fit._in_sample(space, fit.Fit(np.zeros(9), sums, 0.0), np.ones(9)).freedom - 2.0) < 1e-6


def stored(m: Patch, covariance: np.ndarray, sizes: int = 1) -> list[list[str]]:
    """Places that are in each direction that is stored of such a covariance of values that M follows alike."""
    n = len(covariance)
    space = Space(tuple(made(InstrumentEffect, place=str(k)) for k in range(n)))
    m.setattr(systematic, "mueller_slopes", lambda *of: (np.stack([np.eye(n)] * 16), 1.0))
    m.setattr(systematic, "_unseen", lambda found: np.zeros((n, n)))
    m.setattr(systematic, "_as_effects", lambda space, direction, matters, names: tuple(np.flatnonzero(matters)))
    m.setattr(systematic, "SystematicError", lambda **told: Some(**told))
    found = Some(
        space=space,
        values=np.zeros(n),
        covariance=covariance,
        members=tuple((k,) for k in range(n)),
        samples=Some(probability=np.ones(n)),
    )
    asked = Some(captures=[Some(name="a")], wavelengths_nm=(662.0,))
    told = systematic.systematic_error(asked, found, Some(space=Space(()), fit=Some(values=None)))
    return [list(direction) for direction in told.error.directions]


@decides
def test_stored_share(m: Patch) -> bool:
    return [len(stored(m, np.diag([share, 1 - share]))) for share in (0.996, 0.994)] == [1, 2]


@decides
def test_most_stored(m: Patch) -> bool:
    return len(stored(m, np.eye(30))) == 20


@decides
def test_small_part(m: Patch) -> bool:
    def together(part: float) -> int:
        direction = np.array([1.0, part])
        return len(stored(m, np.outer(direction, direction) + 1e-9 * np.eye(2))[0])

    return [together(part) for part in (0.029, 0.031)] == [1, 2]


def ranked(m: Patch) -> tuple[int, int]:
    """Causes that are told with what each explains alone, and as tried."""
    groups = [Some(index=np.array([k])) for k in range(30)]
    form = Some(gradient=np.arange(30.0), curvature=np.eye(30))
    found = Some(sets=Some(form=form, groups=groups, free=np.ones(30, dtype=bool)), label=lambda k: made(place=str(k)))
    before = Some(excess=1e6, freedom=1.0, rms=0.01)
    used = Some(found=found, solved=Some(before=before), asked=Some(captures=[]), after=[])
    m.setattr("processing.diagnosis.instrument.diagnose.empirical", lambda *of: None)
    return len(telling.ranking(found, before)), len(_unexplained(used, Some(named=())).tried)


@decides
def test_most_ranked(m: Patch) -> bool:
    return ranked(m)[0] == 10


@decides
def test_most_tried(m: Patch) -> bool:
    return ranked(m)[1] == 5


@decides
def test_clearly_more(m: Patch) -> bool:
    def asked(more: float) -> str:
        powers = iter([0.5, 0.5 + more, 0.0, 0.0, 0.0])
        m.setattr(recommend, "_power", lambda *of: next(powers))
        return recommend._capture(Some(captures=[]), None, None, [made(), made()], [])

    return "air" in asked(0.14) and "polarizer at 0" in asked(0.16)


@decides
def test_least_turn_deg(m: Patch) -> bool:
    def asked(turn: float) -> bool:
        plate = next(e for e in MODEL.elements() if e.name == "psg_retarder")
        angles = {axis: np.linspace(0, turn / plate.ratio, 40) for axis in MODEL.axes}
        conditions = Conditions(angles, 40, ("camera",), np.zeros(40), 1000.0)
        return "psg_retarder" in nameless_effects.WaveOfAPlate("azimuth", 3).places(MODEL, conditions)

    return asked(185.0) and not asked(175.0)


@decides
def test_same_nm(m: Patch) -> bool:
    entry = Some(value=(1.0,), wavelengths_nm=(662.0,))
    kept = [instrument_file._merged({662.0 + apart: 2.0}, entry, (662.0,)) for apart in (0.45, 0.55)]
    material = Some(constants={}, name="a")
    constants = {"n": 1.5, "k": 0.0, "a": 0.0, "b": 2.0}
    found = Some(wavelengths_nm=(662.0,), constants=constants, captures=[])
    written = []
    for apart in (0.45, 0.55):
        material.constants = {662.0 + apart: polarized_diffuse.Constants(**constants)}
        written.append(len(write.corrected_material(material, found).constants))
    return [len(values) for values in kept] == written == [1, 2]
