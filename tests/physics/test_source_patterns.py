"""A source that beats beside the turn of a plate is not called after the plate."""

from types import SimpleNamespace

import numpy as np
import pytest

from processing.diagnosis.instrument.source_patterns import beat_explains_as_well
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.causes import causes
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.sampling import sample
from processing.diagnosis.search.sets import Group, Noise, Quadratic, Sets, State
from processing.diagnosis.search.space import Space
from processing.effect import Parameter
from processing.instrument.applied_effects import instrument_effects

STATES = 40


def seen_in(cycles, captures=1, beside=None, shared=False):
    """Posterior of a plate's transmission, where the source in truth beats so often in each capture.

    `shared` : beside a value of the instrument that is nearly such a wave, with another sign in every other capture.
    """
    effects, k = instrument_effects(), np.arange(STATES)
    turn = 2 * np.pi * k / STATES
    plate = np.stack([np.cos(turn), np.sin(turn), np.cos(2 * turn), np.sin(2 * turn)], axis=1)
    design = np.hstack([np.tile(plate, (captures, 1)), np.eye(captures * STATES)])
    level = np.concatenate([np.cos(2 * np.pi * cycles * k / STATES + phase) for phase in (0.3 * np.arange(captures))])
    noise = np.random.default_rng(5).standard_normal(level.size)
    if shared:
        signs = np.repeat((-1.0) ** np.arange(captures), STATES)
        design = np.column_stack([design, signs * np.tile(np.cos(2 * turn) + 0.2 * np.cos(3 * turn), captures)])
        level = np.tile(plate[:, 2], captures) + design[:, -1]
    data = 8 * (level if beside is None else np.tile(plate @ beside, captures)) + noise
    form = Quadratic(float(data @ data - data.size), -design.T @ data, design.T @ design)

    def parameters(count):
        return tuple(Parameter("p", "1", -50, 50, 1.0) for _ in range(count))

    flicker = [Candidate(effects["source_flicker"], "", parameters(STATES), n) for n in range(captures)]
    path = [Candidate(effects["path_retardance"], "", parameters(1))] if shared else []
    space = Space((Candidate(effects["retarder_transmission"], "plate", parameters(4)), *flicker, *path))
    groups = [
        Group(np.arange(4)),
        Group(np.arange(4, 4 + level.size)),
        *(Group(np.array([4 + level.size])) for _ in path),
    ]
    sets = Sets(form, groups, Noise(known=True, directions=30.0, slack=1e9))
    there = State(np.array([3.0, 0.0, *(3.0 for _ in path)]))
    samples = sample(sets, there, 1)
    samples = SimpleNamespace(**{**vars(samples), "best": there, "any_of": lambda members: 1.0})
    members = ((0,), tuple(range(1, captures + 1)), *((captures + 1,) for _ in path))
    return Posterior(space, members, sets, samples, np.zeros(space.size), np.eye(1), {})


def turning(captures=1):
    """What beat_explains_as_well asks of the problem: a plate that turns once."""
    angles = {"plate": 360.0 * np.arange(STATES) / STATES}
    plates = [SimpleNamespace(axis="plate", ratio=1.0), SimpleNamespace(axis=None)]
    return SimpleNamespace(
        captures=[SimpleNamespace(conditions=SimpleNamespace(angles_deg=angles)) for _ in range(captures)],
        model=SimpleNamespace(elements=lambda: plates),
    )


@pytest.mark.parametrize(("cycles", "beats"), [(2.0, False), (1.0, False), (2.06, True), (2.2, True), (1.7, True)])
def test_a_beat_beside_a_harmonic_of_the_turn_is_told_from_it(cycles, beats):
    found = seen_in(cycles)
    assert beat_explains_as_well(turning(), found, causes(found, 0.0)[0]) == beats


def test_what_turns_alike_in_all_captures_is_the_plate():
    found = seen_in(1.0, captures=3, beside=np.array([0.3, 0.4, -0.2, 0.5]))
    assert not beat_explains_as_well(turning(3), found, causes(found, 0.0)[0])


def test_what_captures_share_beside_a_plate_makes_no_beat_of_it():
    """A value that all captures share looks like a wave of one phase in one and of another in the other: not twice."""
    found = seen_in(2.0, captures=2, shared=True)
    assert not beat_explains_as_well(turning(2), found, causes(found, 0.0)[0])
