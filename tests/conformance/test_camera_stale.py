"""Which arrivals belong to a trigger: frame numbers, and the camera's clock against the host's."""

import numpy as np
import pytest

from drivers.aravis_stream import Arrival
from drivers.camera_clock import CameraClock

EXPOSURE_S = 0.02
HOST_ZERO_S = 1.7e9


@pytest.mark.parametrize(
    ("frame_id", "last_id", "follows"),
    [
        (8, 7, True),
        (8, None, True),
        (7, 7, False),  # the same number again
        (6, 7, False),  # an older one
        (1, 65535, True),  # numbers go round
        (65535, 2, False),
        (65536, 65535, True),  # extended numbers do not
        (10, 7, True),  # a gap: frames between were lost
        (0, 7, True),  # first packet lost: it cannot be told, and such a frame is never whole
    ],
)
def test_frame_numbers(frame_id: int, last_id: int | None, follows: bool) -> None:
    arrival = Arrival(None, np.zeros(1, np.uint8), True, "success", frame_id, 0, 0.0)
    assert arrival.follows(last_id) is follows


def _stamps(start_s: float, late_s: float, exposure_s: float = EXPOSURE_S, rate: float = 1.0) -> tuple[int, float]:
    """Camera stamp of the start, from the camera's own zero, and when the host saw the first packet."""
    return 5_000_000_000 + round(start_s * rate * 1e9), HOST_ZERO_S + start_s + exposure_s + 0.004 + late_s


def test_a_frame_that_the_host_saw_late_is_dated_by_the_camera() -> None:
    clock = CameraClock("camera")
    rng = np.random.default_rng(1)
    for start_s in np.arange(0.0, 30.0, 0.5):
        stamp_ns, seen_s = _stamps(start_s, rng.exponential(0.01))
        assert clock.came_s(stamp_ns, seen_s, EXPOSURE_S) >= HOST_ZERO_S + start_s + EXPOSURE_S
    stamp_ns, seen_s = _stamps(30.0, late_s=0.8)
    assert clock.came_s(stamp_ns, seen_s, EXPOSURE_S) == pytest.approx(HOST_ZERO_S + 30.0 + EXPOSURE_S, abs=0.02)


@pytest.mark.parametrize("rate", [1 - 2e-4, 1 + 2e-4])
@pytest.mark.parametrize("of_start", [True, False])
def test_genuine_frames_pass_with_drift_and_changing_exposures(rate: float, of_start: bool) -> None:
    clock = CameraClock("camera")
    rng = np.random.default_rng(2)
    for number, start_s in enumerate(np.arange(0.0, 7200.0, 6.0)):
        exposure_s = (0.02, 0.5, 2.0)[number % 3]
        stamp_ns, seen_s = _stamps(start_s, rng.exponential(0.02), exposure_s, rate)
        if not of_start:
            stamp_ns += round(exposure_s * 1e9)
        assert clock.came_s(stamp_ns, seen_s, exposure_s) >= HOST_ZERO_S + start_s + exposure_s


@pytest.mark.parametrize("ticks_per_s", [0.0, 125e6, 8e9])
def test_a_clock_of_another_unit_is_not_believed(ticks_per_s: float, caplog: pytest.LogCaptureFixture) -> None:
    clock = CameraClock("camera")
    misdated = 0
    for start_s in np.arange(0.0, 60.0, 0.5):
        seen_s = HOST_ZERO_S + start_s + EXPOSURE_S
        if clock.came_s(1000 + round(start_s * ticks_per_s), seen_s, EXPOSURE_S) < seen_s - 1e-3:
            misdated += 1
            clock.forget()  # the driver loses such a frame and starts again
    assert misdated <= 4
    assert "no longer helps" in caplog.text


def test_a_camera_without_stamps_is_dated_by_the_host() -> None:
    clock = CameraClock("camera")
    assert [clock.came_s(0, seen_s, EXPOSURE_S) for seen_s in (HOST_ZERO_S, HOST_ZERO_S + 1)] == [
        HOST_ZERO_S,
        HOST_ZERO_S + 1,
    ]
