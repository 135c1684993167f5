"""The largest count that a camera can send, which need not be the largest that its pixel format holds.

A converter of 10 bits behind a 12-bit format gives counts in steps of 4 that end at 4092. Data that are left-aligned
in 16 bits end at 65520. A digital gain below 1, or a full well, ends anywhere. Where the counts end is learnt from the
step that all of them have, and from a pile-up: pixels at one largest count, and hardly any just below it.
"""

import numpy as np
from numpy.typing import NDArray

# Fewer pixels at the largest count than this are the tail of a distribution.
_PILE = 20
# How many times more they must be than those of any of so many steps below.
_FACTOR, _STEPS_BELOW = 5, 8
# Different counts in a frame that show noise, and the pixels among which they are counted.
_LEVELS, _SAMPLE = 64, 20_000


class TopOfCounts:
    """Step and end of counts in the frames of one pixel format so far.

    Parameters
    ----------
    bits : real bits of the format: no count is larger than ``2**bits - 1``.
    converter_bits : bits of the converter, where the camera tells them; counts are taken to be left-aligned until one
        is not.

    Examples
    --------
    >>> top = TopOfCounts(12, None)
    >>> top.look(np.arange(0, 4096, 4, dtype=np.uint16))
    >>> top.step, top.counts
    (4, 4092)
    """

    def __init__(self, bits: int, converter_bits: int | None = None) -> None:
        self._bits = bits
        self._assumed = 1 << max(0, bits - converter_bits) if converter_bits else 1
        self._seen_bits = 0
        self._step_is_known = False
        self._noise_seen = False
        self._pile: int | None = None
        # Largest counts with a pile of pixels and nothing near below: one alone may be an even patch of a sample.
        self._candidates: dict[int, int] = {}
        self._largest = 0

    @property
    def step(self) -> int:
        """Difference of neighbouring counts: a power of two."""
        return self._seen_bits & -self._seen_bits if self._step_is_known else self._assumed

    @property
    def counts(self) -> int:
        """The largest count; a pixel there is saturated."""
        return self._pile if self._pile is not None else self._end_of_format

    @property
    def _end_of_format(self) -> int:
        return ((1 << self._bits) - 1) // self.step * self.step

    def look(self, pixels: NDArray[np.uint16]) -> None:
        """Learn from a frame, as the camera sent it: not averaged, not corrected."""
        if self.step > 1 or not self._step_is_known:
            self._look_at_steps(pixels)
        largest = int(pixels.max())
        if self._pile is not None and largest > self._pile:
            # It was a patch of equal pixels.
            self._pile = None
        if largest > self._largest:
            self._largest = largest
            self._candidates.clear()
        if largest < self.counts and largest == self._largest:
            self._look_for_pile(pixels, largest)

    def _look_at_steps(self, pixels: NDArray[np.uint16]) -> None:
        self._seen_bits |= int(np.bitwise_or.reduce(pixels, axis=None))
        flat = pixels.reshape(-1)
        levels = np.unique(flat[:: max(1, flat.size // _SAMPLE)]).size
        self._noise_seen |= levels >= _LEVELS
        # Sixteen different counts that all have a zero bit by chance: once in 65,000.
        self._step_is_known |= bool(self._seen_bits) and (levels >= 16 or self._seen_bits & 1 == 1)

    def _look_for_pile(self, pixels: NDArray[np.uint16], largest: int) -> None:
        at_largest = int(np.count_nonzero(pixels == largest))
        if at_largest < _PILE:
            return
        step = self.step
        lowest = max(0, largest - _STEPS_BELOW * step)
        lower_counts = np.bincount(pixels[(pixels >= lowest) & (pixels < largest)].reshape(-1) - lowest, minlength=1)
        if at_largest < _FACTOR * int(lower_counts.max()):
            return
        if lower_counts.any():
            self._pile = largest
            return
        self._candidates[largest] = self._candidates.get(largest, 0) + 1
        if self._noise_seen and self._candidates[largest] > 1:
            self._pile = largest
