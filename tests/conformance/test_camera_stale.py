"""Which arrivals belong to a trigger, by number and by time."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.aravis_stream import Arrival

SENT_S = 1000.0


@pytest.mark.parametrize(
    ("frame_id", "first_packet_s", "last_id", "stale"),
    [
        (8, 1000.1, 7, False),
        (8, 1000.1, None, False),
        (8, 999.9, 7, True),  # it began before the trigger
        (8, 999.9, None, True),
        (7, 1000.1, 7, True),  # the same number again
        (6, 1000.1, 7, True),  # an older one
        (1, 1000.1, 65535, False),  # numbers go round
        (65535, 1000.1, 2, True),
        (65536, 1000.1, 65535, False),  # extended numbers do not
        (10, 1000.1, 7, False),  # a gap: frames between were lost
        (0, 0.0, 7, False),  # first packet lost: it cannot be told, and such a frame is never whole
    ],
)
def test_number_and_time_decide(frame_id: int, first_packet_s: float, last_id: int | None, stale: bool) -> None:
    arrival = Arrival(None, np.zeros(1, np.uint8), True, "success", frame_id, 0, first_packet_s)
    assert arrival.is_stale(SENT_S, last_id) is stale
