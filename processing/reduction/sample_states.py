"""The states of a capture that look at its sample."""

import numpy as np
from numpy.typing import NDArray

from processing.storage.captures.capture import Capture, CaptureError


def states_of_sample(capture: Capture) -> NDArray[np.int64]:
    """Positions (states,) of the states that look at the sample, or at air where a capture has no others."""
    states = capture.states_with("sample")
    return states if states.size else capture.states_with("air")


def sample_states(capture: Capture) -> NDArray[np.int64]:
    """The same; CaptureError where there are none."""
    states = states_of_sample(capture)
    if states.size == 0:
        raise CaptureError(f"{capture.path} has no state of the sample that is done; there is nothing to reduce.")
    return states
