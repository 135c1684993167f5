"""States whose counts are cut off at zero: an offset moved the dark part of the image below the smallest count."""

import numpy as np
from numpy.typing import NDArray

from processing.storage.captures.capture import Capture, CaptureError

#: Counts of zero this many standard deviations of the read-out below black are cut off, not noise.
DEVIATIONS = 6.0
#: A state is left out if more than this share of its pixels is cut off.
MOST = 0.01
#: Rows of a frame that are looked at. A frame of fewer than twice as many is read at once.
ROWS = 32


def without_cut_off(capture: Capture, states: NDArray[np.int64]) -> tuple[NDArray[np.int64], list[str]]:
    """The states that are not cut off at zero, and a warning if some are.

    Cut off counts are too high, each by another amount, and no model of the instrument explains them. Raises
    CaptureError: every state is cut off.
    """
    detector = capture.header.detector
    gain, read = detector.gain_e_per_count, detector.read_noise_e or 0.0
    # Where noise alone reaches zero, a count of zero says nothing.
    if not capture.integer_counts or gain is None or detector.black_level_counts <= DEVIATIONS * read / gain:
        return states, []
    height = capture.frame_shape[0]
    every = max(1, height // ROWS)

    def share(state: np.int64) -> float:
        if every == 1:
            return float(np.mean(capture.frames(int(state)) <= 0))
        rows = (slice(row, row + 1) for row in range(0, height, every))
        return float(np.mean([np.mean(capture.frames(int(state), row) <= 0) for row in rows]))

    bad = np.array([share(state) > MOST for state in states])
    if bad.all():
        raise CaptureError(f"{capture.path}: the counts of every state are cut off at zero. Raise the black level.")
    if not bad.any():
        return states, []
    numbers = ", ".join(str(state) for state in states[bad])
    return states[~bad], [
        f"left out, because their counts are cut off at zero: state(s) {numbers}. Raise the black level of the camera"
    ]
