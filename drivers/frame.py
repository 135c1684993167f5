"""A whole frame of a camera, and the mean of several."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.errors import FrameLost
from drivers.top_of_counts import TopOfCounts


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One whole frame.

    Attributes
    ----------
    pixels : ndarray of uint16, shape (height, width)
        Counts, right-aligned to the camera's real bits; owned by the frame, read-only.
    frame_id : int
        The camera's number of the frame; of the last one where several were averaged.
    camera_time_ns : int
        The camera's own clock, in nanoseconds from its own zero: at the exposure where it tells that, else at the
        transfer; 0 for a camera without a clock.
    host_time_s : float
        Unix time at which the software trigger was sent; with a hardware trigger, at which the first packet came.
    complete : bool
        Always True for a frame that a camera hands out.
    """

    pixels: NDArray[np.uint16]
    frame_id: int
    camera_time_ns: int
    host_time_s: float
    complete: bool = True


class FrameAverage:
    """Mean of several frames; a pixel that was saturated once stays saturated, so that masks still see it."""

    def __init__(self, top: TopOfCounts) -> None:
        self._top = top
        self._frames = 0
        self._last: Frame | None = None

    def add(self, frame: Frame) -> None:
        """Add a frame. Raises FrameLost for one that equals the frame before; frames of one value are not judged."""
        pixels = frame.pixels
        if self._last is not None and np.array_equal(pixels, self._last.pixels) and pixels.min() != pixels.max():
            raise FrameLost(
                "camera, frame of an average",
                "it is the same, pixel by pixel, as the one before: the camera or its driver is frozen",
                "Switch the camera off and on",
            )
        if self._last is None:
            self._sum = frame.pixels.astype(np.uint32)
            # The largest of each pixel, because the top may be learnt from a later frame.
            self._largest = frame.pixels.copy()
            self._host_time_s = frame.host_time_s
        else:
            self._sum += frame.pixels
            np.maximum(self._largest, frame.pixels, out=self._largest)
        self._frames += 1
        self._last = frame

    def result(self) -> Frame:
        """The mean, with number and clock of the last frame and the host's time of the first."""
        mean = ((self._sum + self._frames // 2) // self._frames).astype(np.uint16)
        mean[self._largest >= self._top.counts] = self._top.counts
        mean.flags.writeable = False
        assert self._last is not None
        return Frame(mean, self._last.frame_id, self._last.camera_time_ns, self._host_time_s)
