"""Constants by which captures can show an effect, or tell it from another."""

from types import SimpleNamespace as Some

import numpy as np
from rule_decisions import Patch, decides, made

from processing.diagnosis.instrument import recommend, telling
from processing.diagnosis.search import evidence
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.sets import Group, Quadratic
from processing.diagnosis.search.space import Space
from processing.instrument.effects.base import ImageShift


def unseen(candidate: Candidate, information: float, noise: float = 0.0) -> bool:
    sets = Some(form=Quadratic(0.0, np.zeros(1), np.eye(1) * information), groups=[Group(np.array([0]))])
    problem = Some(noise_information=lambda space, values: np.eye(1) * noise)
    return bool(telling.unobservable(problem, Some(space=Space((candidate,)), sets=sets)))


@decides
def test_seen(m: Patch) -> bool:
    return unseen(made(), 3.8) and not unseen(made(), 4.2)


@decides
def test_visible_fault(m: Patch) -> bool:
    said = []
    for told in (15.0, 17.0):
        sets = Some(form=Quadratic(0.0, np.zeros(1), np.eye(1) * told), groups=[Group(np.array([0]))])
        found = Some(sets=sets, space=Space((made(),)), samples=Some(best=Some(unit=1.0)))
        said.append(bool(evidence.would_be_seen(found)))
    return said == [False, True]


@decides
def test_noise_error(m: Patch) -> bool:
    return unseen(made(ImageShift), 9.5, 200.0) and not unseen(made(ImageShift), 10.5, 200.0)


@decides
def test_apart(m: Patch) -> bool:
    said = []
    for power in (0.29, 0.31):
        m.setattr(recommend, "_power", lambda *a, p=power: p)
        said.append(recommend._capture(Some(captures=[]), None, None, [made(), made()], []).split()[0])
    return said == ["No", "Capture"]


@decides
def test_visible(m: Patch) -> bool:
    axes = np.eye(2)
    return [recommend._sine(s * axes[:, :1], s * axes[:, 1:]) for s in (0.9e-4, 1.1e-4)] == [0.0, 1.0]
