"""What frames say against a camera: steps of brightness, mirrored pictures, repeated frames, and no false alarms."""

import re

import numpy as np
import pytest

from processing.instrument.model import InstrumentModel
from processing.reduction.frame_evidence import FrameEvidence, brightness_steps, mirrored_pictures

STATES = 40


@pytest.fixture(scope="module")
def rows(configs):
    model = InstrumentModel.load(configs / "instruments" / "rgb950.yaml").at(662)
    k = np.arange(STATES)
    return model.rows({"psg": 9.0 * k, "psa": 9.0 * 4.91 * k}).reshape(STATES, 16)


def pictures(rows, seed):
    """Pictures (states, 16, 16) of an uneven sample with a flicker of 0.2 % and noise of 0.05 %."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[-1:1:16j, -1:1:16j]
    mueller = np.array([c[0] + c[1] * x + c[2] * y + c[3] * x * y for c in rng.normal(scale=0.1, size=(16, 4))])
    mueller[0] = 1 + 0.3 * x + 0.1 * y
    noise = (1 + 5e-4 * rng.normal(size=(STATES, 16, 16))) * (1 + 2e-3 * rng.normal(size=(STATES, 1, 1)))
    return 1000 * np.einsum("ki,iab->kab", rows, mueller) * noise


def judge(rows, blocks):
    states = np.arange(4, 4 + STATES)
    return mirrored_pictures(states, rows, blocks) or brightness_steps(states, rows, blocks.mean(axis=(1, 2)))


@pytest.mark.parametrize("seed", range(12))
def test_sound_frames_and_a_drifting_lamp_are_no_evidence(rows, seed):
    blocks = pictures(rows, seed)
    assert judge(rows, blocks) == []
    assert judge(rows, blocks * np.linspace(1, 1.08, STATES)[:, None, None]) == []


@pytest.mark.parametrize("seed", [0, 5, 11])
@pytest.mark.parametrize("factor", [2.0, 1.1, 0.9])
def test_one_state_of_another_exposure_is_named(rows, seed, factor):
    blocks, state = pictures(rows, seed), 3 + 3 * seed
    blocks[state] *= factor
    (evidence,) = judge(rows, blocks)
    assert (evidence.kind, evidence.state) == ("brightness", 4 + state)
    assert f"state {4 + state} alone" in evidence.text


@pytest.mark.parametrize("seed", [0, 5, 11])
@pytest.mark.parametrize("factor", [1.1, 1.05, 0.8])
def test_a_gain_that_changes_on_the_way_is_named(rows, seed, factor):
    blocks, state = pictures(rows, seed), 4 + 3 * seed
    blocks[state:] *= factor
    evidence = judge(rows, blocks)
    assert [f.kind for f in evidence] == ["brightness"] * len(evidence)
    assert evidence[0].state == 4 + state
    assert float(re.search(r"is (\S+) times", evidence[0].text)[1]) == pytest.approx(factor, rel=0.02)


@pytest.mark.parametrize("seed", [0, 4])
@pytest.mark.parametrize("flip", [np.s_[:, ::-1], np.s_[::-1, :], np.s_[::-1, ::-1]], ids=["lr", "ud", "180"])
@pytest.mark.parametrize("onwards", [False, True])
def test_a_mirrored_picture_is_named(rows, seed, flip, onwards):
    blocks, state = pictures(rows, seed), 5 + 5 * seed
    for k in range(state, STATES) if onwards else (state,):
        blocks[k] = blocks[k][flip]
    (evidence,) = judge(rows, blocks)
    assert (evidence.kind, evidence.state) == ("picture", 4 + state)


def nearly_symmetric(rows, seed, odd, wander=2.0):
    """Pictures that are even but for a part, with noise of a count and a beam that wanders by a smooth mode."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[-1:1:16j, -1:1:16j]
    mueller = rng.normal(scale=0.1, size=(16, 1, 1)) * (1 + 0.3 * x * x + 0.2 * y * y)
    mueller[0] = 1 - 0.2 * y * y
    mueller += odd * rng.normal(size=(16, 1, 1)) * y
    beam = wander * rng.normal(size=(STATES, 1, 1)) * y
    return 1000 * np.einsum("ki,iab->kab", rows, mueller) + beam + rng.normal(size=(STATES, 16, 16))


def test_a_picture_upside_down_of_a_nearly_symmetric_sample_is_named_where_its_odd_part_shows(rows):
    named = 0
    for seed in range(12):
        blocks, state = nearly_symmetric(rows, seed, odd=0.1), 3 * seed + 2
        assert mirrored_pictures(np.arange(STATES), rows, blocks) == []
        blocks[state] = blocks[state][::-1]
        states = [f.state for f in mirrored_pictures(np.arange(STATES), rows, blocks)]
        assert states in ([state], [])
        named += len(states)
    assert named >= 6


@pytest.mark.long
def test_noise_does_not_hide_a_smooth_odd_part(rows):
    """With the noise of each pattern from its own 23 degrees of freedom, 42 of these 96 were named."""
    named = 0
    for seed in range(96):
        blocks, state = nearly_symmetric(rows, seed, odd=1e-3, wander=0.0), (7 * seed + 3) % STATES
        blocks[state] = blocks[state][::-1]
        states = [f.state for f in mirrored_pictures(np.arange(STATES), rows, blocks)]
        assert states in ([state], [])
        named += len(states)
    assert named >= 46


@pytest.mark.parametrize("odd", [0.0, 1e-3])
def test_a_symmetric_sample_gives_no_false_alarm(rows, odd):
    """With white noise as the measure all 40 of these were called mirrored: a beam that wanders is a smooth pattern."""
    for seed in range(20):
        assert mirrored_pictures(np.arange(STATES), rows, nearly_symmetric(rows, seed, odd)) == []


def frame(seed, shape=(64, 80)):
    return np.random.default_rng(seed).normal(500, 5, shape).astype(np.uint16)


def test_a_frame_that_came_before_is_noticed_whole_and_in_part():
    evidence = FrameEvidence(64.0, None)
    first, second = frame(1), frame(2)
    assert evidence.repeats(first) is None
    assert evidence.repeats(second) is None
    assert "as an earlier one" in evidence.repeats(first)
    torn = frame(3)
    assert evidence.repeats(torn) is None
    half = frame(4)
    half[32:] = torn[32:]
    assert "% of the frame's rows" in evidence.repeats(half)
    # A lens cap, or light everywhere beyond the range, gives frames of one value.
    for _ in range(3):
        assert evidence.repeats(np.full((64, 80), 4095, np.uint16)) is None


def test_numbers_and_times_that_stand_are_noticed():
    evidence = FrameEvidence(64.0, None)
    settings = {"exposure_s": 0.01, "light": True}
    assert evidence.look(0, frame(0), number=1, camera_ns=10, **settings) == []
    assert [f.kind for f in evidence.look(1, frame(1), number=1, camera_ns=20, **settings)] == ["number"]
    assert [f.kind for f in evidence.look(2, frame(2), number=2, camera_ns=20, **settings)] == ["time"]
    # A camera without a clock, or without numbers.
    assert evidence.look(3, frame(3), number=0, camera_ns=0, **settings) == []
    assert evidence.look(4, frame(4), number=0, camera_ns=0, **settings) == []
