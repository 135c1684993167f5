"""Constants by which pixels of an object are taken, and what is told of its surface."""

from types import SimpleNamespace as Some

import numpy as np
import pytest
from rule_decisions import Patch, decides, made

from processing.arrays import Array
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.fit import Fit
from processing.diagnosis.search.space import Space, Sums
from processing.diagnosis.surface import data as surface_data
from processing.diagnosis.surface import naming, quantities, standard_errors, view
from processing.diagnosis.surface.problem import SurfaceProblem
from processing.effect import Parameter
from processing.errors import ProcessError
from processing.reflectance.changes import ReflectanceChanges
from processing.reflectance.effects.base import BentValley


def picked(size: int, usable: Array | None = None) -> Array:
    """Pixels (400, 400) that are used of an object that is a square of so many pixels a side."""
    mask = np.zeros((400, 400), dtype=bool)
    mask[20 : 20 + size, 20 : 20 + size] = True
    clean = np.zeros_like(mask)
    data = Some(usable=~clean if usable is None else usable, clipped=clean, binned=1, name="a")
    seen = Some(at=lambda omega: Some(mask=mask))
    return surface_data._pick(data, np.ones((1, 1, 400, 400), dtype=np.float32), seen, 35.0, 1)


def rim(size: int) -> int:
    """Pixels that are left out at its rim."""
    line = np.zeros((400, 400), dtype=bool)
    line[20 + size // 2] = True
    return int(np.flatnonzero(picked(size, line)[20 + size // 2])[0]) - 20


@decides
def test_rim_of_object(m: Patch) -> bool:
    return rim(290) == 10


@decides
def test_rim_px(m: Patch) -> bool:
    return rim(60) == 6


@decides
def test_most_of_object(m: Patch) -> bool:
    def used(pixels: int) -> int:
        some = np.zeros((400, 400), dtype=bool)
        some[100:300, 100:300] = np.arange(200 * 200).reshape(200, 200) < pixels
        return int(picked(360, some).sum())

    return used(4000) == 4000 and used(4001) < 2000


@decides
def test_tiles_of_object(m: Patch) -> bool:
    where = np.argwhere(np.ones((720, 720), dtype=bool))
    return np.unique(surface_data._tiles(where)[0]).size == 64


@decides
def test_fewest_of_object(m: Patch) -> bool:
    def enough(pixels: int) -> bool:
        some = Some(y=np.zeros((pixels, 4)))
        seen = Some(kept=lambda polarized: some, polarized=lambda flat: None)
        asked = Some(captures=[seen], rows=lambda *of: np.zeros((4, 16)), changes=lambda *of: (None, None))
        try:
            return len(SurfaceProblem._polarized(asked)) == 1
        except ProcessError:
            return False

    return enough(100) and not enough(99)


def support() -> tuple[float, float]:
    """Depth of the support of an object of half a width of one, and its radius."""
    depth, parts = view._support(1.0, ReflectanceChanges())
    return float(depth), float(np.hypot(*parts[-1, [0, 2]]) / np.sqrt(1 - 0.5 / len(parts)))


@decides
def test_support_depth(m: Patch) -> bool:
    return support()[0] == 2.0


@decides
def test_support_deg(m: Patch) -> bool:
    depth, radius = support()
    return abs(np.rad2deg(np.arctan(radius / depth)) - 35) < 0.1


EFFECT = made(type("Valley", (BentValley,), {"bend": None, "places_on": None})).effect
VALLEY = Space((Candidate(EFFECT, "", (Parameter("p", "1", -10.0, 10.0, 1.0),)),))


def fit(excess: float = 0.0) -> Fit:
    sums = Sums.empty(1, 1)
    sums.curvature[0] = 1e4
    return Fit(np.array([0.5]), sums, excess)


@decides
def test_along_valley(m: Patch) -> bool:
    begun = []

    def minimize(problem: object, space: Space, start: Array, **how: object) -> Fit:
        begun.append(float(start[0]))
        return fit()

    m.setattr(naming, "minimize", minimize)
    naming._deepest(None, VALLEY, fit())
    return begun == [1.5, -0.5]


def error(m: Patch, rises: float) -> tuple[float, list[float]]:
    """Standard error of a value in a valley whose excess rises by a part of what its curvature promises.

    And where it is asked, from the minimum.
    """
    asked = []

    def minimize(problem: object, space: Space, start: Array, **how: object) -> Fit:
        asked.append(float(start[0] - 0.5))
        return fit(rises * 1e4 * asked[-1] ** 2)

    m.setattr(standard_errors, "minimize", minimize)
    problem = Some(noise_information=lambda *of: np.zeros((1, 1)))
    return float(standard_errors.standard_errors(problem, VALLEY, fit(), 1.0)[0]), asked


@decides
def test_errors_away(m: Patch) -> bool:
    return error(m, 1.1)[1] == pytest.approx([0.03, -0.03], rel=1e-3)


@decides
def test_most_doublings(m: Patch) -> bool:
    return error(m, 0.0)[0] == pytest.approx(0.01 * 32, rel=1e-3)


@decides
def test_shows_xi0(m: Patch) -> bool:
    strength = np.array([19.0, 21.0])
    here = Some(alpha_0=np.full(2, 0.5), alpha_id=np.full(2, 0.5), strength=strength, residual=np.zeros((2, 4)))
    problem = Some(
        pixels=lambda *of: here,
        captures=[Some(y=np.ones((2, 4)))],
        sigma=[np.ones((2, 4))],
        rows=lambda *of: np.eye(4, 16),
        changes=lambda *of: (None, None),
    )
    return np.isnan(quantities.quantities(problem, 0, Space(()), np.zeros(0))[1]).tolist() == [True, False]
