"""What arrives in Aravis' buffers, as counts: only where the camera announces the layout that was set."""

import numpy as np
from numpy.typing import NDArray

from drivers.aravis_stream import Arrival
from drivers.errors import UnknownPixelFormat
from drivers.pixel_formats import PixelFormat


def other_layout(arrival: Arrival, fmt: PixelFormat, size: tuple[int, int]) -> str | None:
    """How the format and the size that came with a frame differ from those set; None if they do not."""
    code, width, height = arrival.image_layout()
    if (code, width, height) == (fmt.code, *size):
        return None
    return (
        f"frame {arrival.frame_id} says code 0x{code:08x}, {width} x {height} pixels,"
        f" but 0x{fmt.code or 0:08x}, {size[0]} x {size[1]} was set"
    )


def counts_of(
    arrival: Arrival, fmt: PixelFormat, size: tuple[int, int], bits: int, *, shift: int, camera: str
) -> NDArray[np.uint16]:
    """Counts (rows, columns) of a whole frame, right-aligned, in memory of their own, read-only.

    Raises
    ------
    UnknownPixelFormat
        The counts contradict `bits` and `shift` of the rig file.
    """
    pixels = fmt.decode(arrival.memory, *size, shift=shift)
    if misalignment := fmt.misalignment(arrival.memory, pixels, bits, shift):
        raise UnknownPixelFormat(
            f"{camera}, {fmt.name} with bits {bits} and shift {shift}",
            misalignment,
            "Correct `bits` and `shift` in the rig file; the camera's manual says how it aligns its data",
        )
    pixels.flags.writeable = False
    return pixels
