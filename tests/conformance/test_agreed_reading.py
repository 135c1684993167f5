"""Readings that have to agree, on calm and on disturbed lines."""

import random

import pytest

from drivers.agreed_reading import AgreeingReadings
from drivers.errors import ReplyError


def _read(readings: AgreeingReadings, values: list[float], *, moving: bool = False) -> tuple[tuple[float, bool], int]:
    queue = list(values)
    answer = readings.read("axis a, read position", lambda: queue.pop(0), lambda: moving, 0.005)
    return answer, len(values) - len(queue)


def test_two_are_enough_on_a_calm_line_and_one_that_stands_alone_is_not_believed() -> None:
    assert _read(AgreeingReadings(), [30.105] * 9) == ((30.105, True), 2)
    (value, confirmed), _ = _read(AgreeingReadings(), [3.105, *[30.105] * 9])
    assert (value, confirmed) == (30.105, True)


def test_a_disturbed_line_is_remembered() -> None:
    readings = AgreeingReadings()
    _read(readings, [3.105, *[30.105] * 9])
    # Two garbled replies may be alike; four are not.
    assert _read(readings, [0.105, 0.105, *[30.105] * 9]) == ((30.105, True), 6)


def test_a_servo_trembles_within_its_tolerance() -> None:
    (value, confirmed), count = _read(AgreeingReadings(), [10.001, 10.003, 10.002, 10.0])
    assert (value, confirmed, count) == (10.002, True, 3)


def test_an_axis_in_motion_is_said_to_move() -> None:
    (_, confirmed), _ = _read(AgreeingReadings(), [float(n) for n in range(20)], moving=True)
    assert not confirmed


def test_readings_that_never_agree_are_an_error() -> None:
    noise = random.Random(1)
    with pytest.raises(ReplyError, match="contradict"):
        _read(AgreeingReadings(), [noise.uniform(0, 360) for _ in range(40)])
