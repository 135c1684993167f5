"""Small pictures for the live page, made when a browser asks for them."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from acquisition.screen.observer import Mosaic
from processing.computing.png import png

#: Longest side of a picture on the page.
LARGEST = 480
BINS = 64


def last_frame_png(pixels: NDArray[np.uint16], black: float, full_scale: int) -> bytes:
    """The frame, grey from black level to full scale (square root), saturated pixels red."""
    counts = np.arange(full_scale + 1, dtype=np.float32)
    tones = (np.sqrt(np.clip((counts - black) / (full_scale - black), 0, 1)) * 255).astype(np.uint8)
    grey = tones[np.minimum(thin_out(pixels), full_scale)]
    if int(pixels.max()) < full_scale:
        return png(grey)
    image = np.repeat(grey[..., np.newaxis], 3, axis=2)
    # A saturated pixel must show even where thinning left it out.
    image[_block_maximum(pixels)[: image.shape[0], : image.shape[1]] >= full_scale] = (255, 40, 40)
    return png(image)


class Modulation:
    """How much each pixel is modulated over a rotation, from its least and most counts so far; thinned frames."""

    def __init__(self) -> None:
        self._states = 0

    def add(self, pixels: NDArray[np.uint16]) -> None:
        """One more state with light."""
        thin = thin_out(pixels)
        if self._states == 0:
            self._low, self._high = thin.copy(), thin.copy()
        else:
            # New arrays: a picture of those before may be in the drawing.
            self._low, self._high = np.minimum(self._low, thin), np.maximum(self._high, thin)
        self._states += 1

    def drawing(self, black: float) -> Callable[[], bytes | None]:
        """Draws (max - min) / (max + min) of the states so far when called; None of fewer than two."""
        if self._states < 2:
            return lambda: None
        low, high = self._low, self._high
        return lambda: _modulation_png(low.astype(np.float32) - black, high.astype(np.float32) - black)


def _modulation_png(low: NDArray[np.float32], high: NDArray[np.float32]) -> bytes:
    return _map_png((high - low) / np.maximum(low + high, 1.0), high)


def dolp_png(pixels: NDArray[np.uint16], mosaic: Mosaic, black: float) -> bytes:
    """Degree of linear polarization of each super-pixel of a 0/45/90/135 mosaic."""
    height, width = len(mosaic), len(mosaic[0])
    rows, columns = pixels.shape[0] // height * height, pixels.shape[1] // width * width
    channel = {
        name: thin_out(pixels[r:rows:height, c:columns:width]).astype(np.float32) - black
        for r, line in enumerate(mosaic)
        for c, name in enumerate(line)
    }
    s1, s2 = channel["0"] - channel["90"], channel["45"] - channel["135"]
    s0 = sum(channel.values(), np.zeros_like(s1)) / 2
    return _map_png(np.hypot(s1, s2) / np.maximum(s0, 1.0), s0)


def _map_png(values: NDArray[np.floating], light: NDArray[np.floating]) -> bytes:
    from matplotlib import colormaps

    # Where there is hardly any light, noise alone would look like full polarization.
    lit = light > 0.02 * float(np.percentile(light, 99.5))
    scaled = np.where(lit, np.clip(values, 0, 1), 0)
    return png(colormaps["viridis"]((scaled * 255).astype(np.uint8), bytes=True)[..., :3])


def histogram(pixels: NDArray[np.uint16], full_scale: int) -> list[int]:
    """Pixels in 64 equal steps of the full scale; the last one ends with the saturated ones."""
    counts, _ = np.histogram(thin_out(pixels), bins=BINS, range=(0, full_scale + 1))
    return [int(n) for n in counts]


def _step(pixels: NDArray[np.uint16]) -> int:
    longest: int = max(pixels.shape)
    return max(1, -(-longest // LARGEST))


def thin_out(pixels: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Every n-th pixel, so that the picture fits the page; a view."""
    step = _step(pixels)
    return pixels[::step, ::step]


def _block_maximum(pixels: NDArray[np.uint16]) -> NDArray[np.uint16]:
    step = _step(pixels)
    rows, columns = -(-pixels.shape[0] // step) * step, -(-pixels.shape[1] // step) * step
    padded = np.zeros((rows, columns), dtype=pixels.dtype)
    padded[: pixels.shape[0], : pixels.shape[1]] = pixels
    blocks = padded.reshape(rows // step, step, columns // step, step)
    return np.asarray(blocks.max(axis=(1, 3)))
