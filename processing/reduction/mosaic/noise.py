"""Noise of demosaiced Stokes images: how much of each channel's variance arrives in S, for each method.

S at a pixel is a weighted sum of raw pixels around it. The weights depend on where in the super-pixel it lies, so
the covariance of a linear method is, for each of the four positions, a sum over the channels of (3 x 3 matrix) x
(variance of that channel's raw pixels there). The matrices come from sending unit impulses through the method itself.
An adaptive method is linearized about the frame itself.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Image
from processing.reduction.mosaic.demosaic import demosaic, method_of
from processing.reduction.mosaic.layout import PAIRS, MosaicLayout

#: Frame on which impulses are followed, and the level under them.
_SIZE, _LEVEL = 32, 1000.0
#: A step small against the level, on an even scene.
_STEP = 1.0


@lru_cache(maxsize=32)
def noise_gain(layout: MosaicLayout, method: str, solve: tuple[tuple[float, ...], ...]) -> NDArray[np.float64]:
    """Covariance of S for unit variance of one channel: (2, 2, channels, 3, 3), first two axes the pixel's position.

    Parameters
    ----------
    solve : (3, channels) matrix from channel intensities to (S0, S1, S2), as nested tuples.

    For `superpixel` all positions are alike.
    """
    matrix = np.asarray(solve)
    out = np.zeros((2, 2, len(layout.channels), 3, 3))
    flat = np.full((_SIZE, _SIZE), _LEVEL, np.float32)
    still = demosaic(flat, layout, method)
    middle = _SIZE // 2
    for channel, (r, c) in enumerate(layout.offsets):
        poked = flat.copy()
        poked[middle + r, middle + c] += _STEP
        moved = np.einsum("sc,crk->srk", matrix, (demosaic(poked, layout, method) - still) / _STEP)
        if still.shape[1] == _SIZE // 2:
            out[:, :, channel] = np.einsum("sxy,txy->st", moved, moved)
            continue
        for i in range(2):
            for j in range(2):
                part = moved[:, i::2, j::2]
                out[i, j, channel] = np.einsum("sxy,txy->st", part, part)
    return out


@lru_cache(maxsize=32)
def neighbour_correlation(
    layout: MosaicLayout, method: str, solve: tuple[tuple[float, ...], ...], parts: tuple[int, ...] = (1, 2)
) -> NDArray[np.float64]:
    """Correlation of the noise of S1 and S2 between pixels, (2 R + 1, 2 R + 1) by row and column distance.

    Neighbours are made of the same raw pixels. Mean of `parts` of S and of the four positions in the super-pixel, for
    even light; `superpixel` has none.
    """
    matrix = np.asarray(solve)
    flat = np.full((_SIZE, _SIZE), _LEVEL, np.float32)
    still = demosaic(flat, layout, method)
    middle, reach = _SIZE // 2, 2 * method_of(method).reach
    total = np.zeros((2 * reach + 1, 2 * reach + 1))
    for r, c in layout.offsets:
        poked = flat.copy()
        poked[middle + r, middle + c] += _STEP
        moved = np.einsum("sc,crk->srk", matrix, (demosaic(poked, layout, method) - still) / _STEP)
        for image in moved[list(parts)]:
            # Twice as wide, so that what leaves on one side does not come in on the other; scipy.signal takes half a
            # second to import.
            wide = (2 * image.shape[0], 2 * image.shape[1])
            whole = np.fft.irfft2(np.abs(np.fft.rfft2(image, wide)) ** 2, wide)
            total += np.roll(whole, (reach, reach), (0, 1))[: 2 * reach + 1, : 2 * reach + 1]
    return np.asarray(total / total[reach, reach])


def stokes_covariance(
    variance: NDArray[np.float32],
    layout: MosaicLayout,
    method: str,
    solve: NDArray[np.float64],
    *,
    frame: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Covariance (6, rows, columns) of (S0, S1, S2): 00, 11, 22, 01, 02, 12.

    Parameters
    ----------
    variance : (channels, rows, columns), counts^2, of a raw pixel of each channel at the level found there.
    frame : the mosaic frame, on which an adaptive method depends. None: an even scene.
    """
    chosen = method_of(method)
    if frame is not None and chosen.covariance is not None:
        return chosen.covariance(variance, layout, solve, frame)
    if frame is not None and not chosen.linear:
        return _local_covariance(variance, layout, method, solve, frame=frame)
    out = np.empty((len(PAIRS), *variance.shape[1:]), np.float32)
    gain = noise_gain(layout, method, tuple(tuple(float(v) for v in row) for row in solve))
    step = 1 if _halves(method, layout) else 2
    for i in range(step):
        for j in range(step):
            weights = np.array([gain[i, j, :, a, b] for a, b in PAIRS], dtype=np.float32)
            out[:, i::step, j::step] = np.tensordot(weights, variance[:, i::step, j::step], axes=1)
    return out


def _local_covariance(
    variance: NDArray[np.float32], layout: MosaicLayout, method: str, solve: NDArray[np.float64], *, frame: Image
) -> NDArray[np.float32]:
    """Covariance of a method whose weights depend on the frame: it is linearized about the frame, pixel by pixel.

    Each raw pixel is raised by its standard deviation, many at a time, so far apart that no value feels two of them.
    """
    raw = np.empty(frame.shape, np.float32)
    halves = variance.shape[1] < frame.shape[0]
    for k, (r, c) in enumerate(layout.offsets):
        raw[r::2, c::2] = variance[k] if halves else variance[k, r::2, c::2]
    sigma, matrix = np.sqrt(np.maximum(raw, 0)), solve.astype(np.float32)
    still = np.tensordot(matrix, demosaic(frame, layout, method), axes=1)
    out = np.zeros((len(PAIRS), *still.shape[1:]), np.float32)
    apart = 2 * method_of(method).reach + 1
    for i in range(min(apart, frame.shape[0])):
        for j in range(min(apart, frame.shape[1])):
            poked = frame.copy()
            poked[i::apart, j::apart] += sigma[i::apart, j::apart]
            moved = np.tensordot(matrix, demosaic(poked, layout, method), axes=1) - still
            for packed, (a, b) in zip(out, PAIRS, strict=True):
                packed += moved[a] * moved[b]
    return out


@lru_cache(maxsize=32)
def _halves(method: str, layout: MosaicLayout) -> bool:
    """Whether the images of the channels have half the size of the frame."""
    return len(demosaic(np.zeros((4, 4)), layout, method)[0]) == 2
