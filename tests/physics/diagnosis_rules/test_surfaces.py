"""Constants of surfaces."""

from types import SimpleNamespace as Some

import numpy as np
from rule_decisions import QUIET, Asked, Patch, cause, decides

from processing.diagnosis.search import own_minima
from processing.diagnosis.search.sets import State
from processing.diagnosis.surface import data as surface_data
from processing.diagnosis.surface import diagnose


def own(**known: object) -> own_minima.OwnMinima:
    out = object.__new__(own_minima.OwnMinima)
    vars(out).update(known)
    return out


@decides
def test_leaders(m: Patch) -> bool:
    beside = lambda here: (Asked([1.0] * 30), State(np.zeros(30)))  # noqa: E731
    return len(own(beside=beside)._promising(Some(groups=frozenset()))) == 12


def worth(odds: float, left: float) -> bool:
    more = Some(score_at=lambda unit: odds, at_bound=False, left=left)
    return own(left=lambda v: v.left, noise=QUIET)._worth(more, Some(score_at=lambda unit: 0.0, left=100.0))


@decides
def test_imitates(m: Patch) -> bool:
    return worth(21.0, 0.0) and not worth(19.0, 0.0)


@decides
def test_explains(m: Patch) -> bool:
    return worth(100.0, 68.0) and not worth(100.0, 72.0)


@decides
def test_left_over(m: Patch) -> bool:
    return [diagnose._explains([], [{"a": 1000.0}], [{"a": y}]) for y in (28.0, 32.0)] == [True, False]


@decides
def test_most_effects(m: Patch) -> bool:
    nothing = [{"a": 0.0}]
    return [diagnose._explained_by_few([cause()] * n, nothing, nothing) for n in (3, 4)] == [True, False]


@decides
def test_as_likely(m: Patch) -> bool:
    problem = Some(captures=[0], rows=lambda k, changes: np.eye(4, 16), changes=lambda *a: (None, None))
    before = [Some(excess=1.0, freedom=1.0, rms=rms) for rms in (0.020, 0.0225)]
    return [diagnose._degeneracy_in_doubt(problem, Some(before=b, base=None)) for b in before] == [True, False]


@decides
def test_dark(m: Patch) -> bool:
    signal = np.ones((1, 1, 200, 200), dtype=np.float32)
    signal[..., 20:80, 20:80], signal[..., 120:180, 120:180] = 0.09, 0.11
    clean = np.zeros((200, 200), dtype=bool)
    data = Some(usable=~clean, clipped=clean, binned=1, name="a")
    view = Some(at=lambda omega: Some(mask=~clean))
    picked = surface_data._pick(data, signal, view, 35.0, 1)
    return not picked[30:70, 30:70].any() and bool(picked[130:170, 130:170].any())


@decides
def test_least_modulation(m: Patch) -> bool:
    said = []
    for square in (3.9, 4.1):
        y = 10.0 + np.sqrt(square) / 2 * np.array([[1.0, -1.0, 1.0, -1.0]])
        tile = Some(variance=np.ones((1, 4)), y=y, tile=np.zeros(1, dtype=int))
        said.append(bool(surface_data.SurfaceData.polarized(tile, np.ones(4))[0]))
    return said == [False, True]
