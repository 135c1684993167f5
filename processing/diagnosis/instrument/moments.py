"""Second moments of a capture: what makes a fit over all pixels as cheap as over a few hundred.

With the pixels' intensities y (N values each), every sum of squares that a fit needs is tr(P Y Y^T): only the N x N
matrix Y Y^T matters. Corrections of the counts (offset, curvature, image shift) are linear in features of y (1, y^2,
y ln y, dy/dx, ...), so the matrix is kept for y and its features together, as a square root Z with Z Z^T = sum over
pixels. Each pixel is weighted with the inverse of its mean variance; each row later with its own.
The expected noise of every product is kept beside it, so that an excess over the noise has no bias from noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.computing.threads import for_ranges
from processing.diagnosis.captured.capture_data import CaptureData, SharedNoise
from processing.reduction.move_image import noise_taps

#: Features of a signal u (counts over full scale); corrected counts = u + sum of coefficient times feature.
FEATURES = (
    *("counts", "one", "square", "cube", "fourth", "log", "log_square", "log_cube"),
    *("dx", "dy", "dxx", "dxy", "dyy"),
)
#: The last of them are derivatives of the image by position.
DERIVATIVES = 5
TINY = 1e-6
NOTHING_SHARED = SharedNoise()
#: Savitzky-Golay filters of seven points: value (third order), first and second derivative (fourth and fifth order).
VALUE = np.array([-2.0, 3.0, 6.0, 7.0, 6.0, 3.0, -2.0]) / 21
FIRST = np.array([22.0, -67.0, -58.0, 0.0, 58.0, 67.0, -22.0]) / 252
SECOND = np.array([-13.0, 67.0, -19.0, -70.0, -19.0, 67.0, -13.0]) / 132
MARGIN = 3
#: Filters down and across the image of a pixel itself and of its derivatives, in the order of FEATURES.
POINT = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
PATTERNS = ((POINT, POINT), (VALUE, FIRST), (FIRST, VALUE), (VALUE, SECOND), (FIRST, FIRST), (SECOND, VALUE))
#: Parts that are held out in turn: of the image, or of the states (of which there are few, so each part is smaller).
FOLDS_OF_TILES = 2
FOLDS_OF_STATES = 5
#: Pixels that are taken together.
CHUNK = 8192
#: Tiles along each side of the image, for effects and structure that vary over it; of a small image, so many that each
#: has four pixels a side.
TILES, FEWEST_TILES, TILE_PX = 16, 8, 4
#: Captures with more rows, or fewer pixels, than these hold out states, others hold out tiles of the image.
MOST_ROWS_FOR_TILES = 100
FEWEST_PIXELS_FOR_TILES = 64


@dataclass(frozen=True)
class Block:
    """A part of a capture that is fitted or held out together.

    Attributes
    ----------
    z : (features, L, R) pseudo-pixels.
    counts : (L, R') as few pseudo-pixels as the plain counts need.
    noise : (L, features, features) expected noise of z z^T, row by row.
    rows : (L',) the rows of the capture that belong to this block.
    clipped : pixels of which some state is at the top of the range.
    sound : (L',) rows of states in which no pixel is clipped; all rows in a block that is not clipped.
    pixels : how many pixels stand behind it.
    """

    fold: int
    z: Array
    counts: Array
    noise: Array
    rows: NDArray[np.int64]
    clipped: bool
    pixels: int
    sound: NDArray[np.int64]


@dataclass(frozen=True)
class Tiles:
    """Second moments of the plain counts in tiles of the image.

    Attributes
    ----------
    s : (T, L, L); noise : (T, L); x, y : (T,) centres from -1 to 1; fold : (T,).
    index : (rows, columns) tile of each pixel; pick : (rows, columns) pixels that count; pixels : (T,) how many.
    """

    s: Array
    noise: Array
    x: Array
    y: Array
    fold: NDArray[np.int64]
    index: NDArray[np.int64]
    pick: NDArray[np.bool_]
    pixels: Array
    #: `tile_products` that were asked for before.
    products: dict[tuple[int, ...], tuple[Array, Array]] = field(default_factory=dict)


@dataclass(frozen=True)
class Moments:
    """Blocks and tiles of one capture.

    Attributes
    ----------
    tiles, clipped : of pixels without and with a clipped state; None where states are held out.
    counts : (L,) rows of W that count.
    sigma : (L,) noise of each row in the weighted units; left : (L,) part of its variance that the pixels show.
    relative : turns a weighted square into a square relative to the mean signal.
    spread : mean square over squared mean of the variances: 1 if all pixels and states are equally noisy.
    noise_floor : rms noise over the mean signal.
    """

    blocks: tuple[Block, ...]
    tiles: Tiles | None
    clipped: Tiles | None
    counts: NDArray[np.bool_]
    sigma: Array
    left: Array
    relative: float
    spread: float
    noise_floor: float
    held_out: str


def holds_out_states(data: CaptureData) -> bool:
    """Whether states are held out (few pixels, or many states) instead of tiles of the image."""
    return data.values_per_pixel > MOST_ROWS_FOR_TILES or int(data.usable.sum()) < FEWEST_PIXELS_FOR_TILES


def moments_of(data: CaptureData, folds: int) -> Moments:
    """Build the moments of a capture, to be held out in so many parts."""
    n, c, height, width = data.signal.shape
    rows = n * c
    u = data.signal.reshape(rows, height, width)
    variance, scale = _variance(data)
    good = data.usable & (scale > 0) & inside(height, width)
    # Where too much was subtracted a dark state is negative all over; its noise is not less than that of the read-out.
    least = np.repeat(data.floor, c)[:, None] / 2
    mean_variance = np.mean(variance[:, good] / scale[good], axis=1)
    sigma = np.sqrt(np.maximum(mean_variance, np.mean(least / scale[good], axis=1)))
    shared = np.stack([shared_noise(x, y, data.shared) for x, y in data.row_moved_px])
    left = shared[:, 0, 0]
    shown = variance * left[:, None, None]
    tiles, clipped_tiles = None, None
    by_state = holds_out_states(data)
    index, x, y = _grid(height, width)
    if by_state:
        fold_of_pixel = np.zeros((height, width), dtype=np.int64)
        held = f"every state is predicted by a fit to the states of the other parts ({folds} parts, drawn at random)"
    else:
        side = int(np.ceil(np.sqrt(x.size)))
        fold_of_tile = (np.arange(x.size) // side + np.arange(x.size) % side) % folds
        fold_of_pixel = fold_of_tile[index]
        held = f"every tile of the image is predicted by a fit to the other tiles ({folds} parts, interleaved)"
        tiles = _tiles(u, shown, scale, good & ~data.clipped, index, x, y, fold_of_tile)
        if data.clipped.any():
            clipped_tiles = _tiles(u, shown, scale, good & data.clipped, index, x, y, fold_of_tile)
    blocks: list[Block] = []
    around = image_derivatives(u).reshape(DERIVATIVES, rows, -1)
    for clipped in (False, True):
        for fold in range(1 if by_state else folds):
            pick = good & (data.clipped == clipped) & (fold_of_pixel == fold)
            if pick.any():
                blocks += _blocks(data, around, variance, shared, scale, pick, fold, clipped, folds if by_state else 0)
    counts = data.row_counts
    variance = variance[counts][:, good]
    share = variance / scale[good] / sigma[counts, None] ** 2
    mean = float(np.mean(u[counts][:, good]))
    relative = float(np.mean(scale[good])) / mean**2
    floor = float(np.sqrt(np.mean(variance))) / mean
    return Moments(
        tuple(blocks), tiles, clipped_tiles, counts, sigma, left, relative, float(np.mean(share**2)), floor, held
    )


def tile_products(data: CaptureData, tiles: Tiles, used: Sequence[int]) -> tuple[Array, Array]:
    """Second moments (T, F L, F L) of some features together in every tile, and their noise (T, L, F, F).

    `used` are numbers of FEATURES in ascending order, of which the counts are the first.
    """
    if tuple(used) == (0,):
        return tiles.s, tiles.noise[..., None, None]
    if tuple(used) not in tiles.products:
        tiles.products[tuple(used)] = _products(data, tiles, list(used))
    return tiles.products[tuple(used)]


def _products(data: CaptureData, tiles: Tiles, used: list[int]) -> tuple[Array, Array]:
    rows, count = data.values_per_pixel, tiles.x.size
    variance, scale = _variance(data)
    shared = np.stack([shared_noise(x, y, data.shared) for x, y in data.row_moved_px])
    around = image_derivatives(data.signal.reshape(rows, *data.signal.shape[2:])).reshape(DERIVATIVES, rows, -1)
    s, noise = np.zeros((count, len(used) * rows, len(used) * rows)), np.zeros((count, rows, len(used), len(used)))
    for t in range(count):
        p = np.flatnonzero((tiles.index == t) & tiles.pick)
        z, of_pixels = _weighted(data, around, variance, shared, scale, p)
        flat = z[used].reshape(len(used) * rows, -1)
        s[t], noise[t] = flat @ flat.T, of_pixels[:, used][:, :, used]
    return s, noise


def _weighted(
    data: CaptureData,
    around: NDArray[np.float32],
    variance: Array,
    shared: Array,
    scale: Array,
    pixels: NDArray[np.int64],
) -> tuple[Array, Array]:
    """Weighted features (F, L, P) of some pixels, and the noise (L, F, F) of their products."""
    rows = data.values_per_pixel
    weight = 1 / np.sqrt(scale.reshape(-1)[pixels])
    z = np.empty((len(FEATURES), rows, pixels.size))
    z[:-DERIVATIVES], slopes = features(data.signal.reshape(rows, -1)[:, pixels].astype(np.float64))
    z[-DERIVATIVES:] = around[:, :, pixels]
    z *= weight
    return z, _noise(slopes, variance.reshape(rows, -1)[:, pixels] * weight**2, shared)


def _variance(data: CaptureData) -> tuple[Array, Array]:
    """Variance (L, rows, columns), and its mean over the rows of W, with which pixels are weighted."""
    variance = data.variance().reshape(data.values_per_pixel, *data.signal.shape[2:])
    return variance, variance.mean(axis=0)


def inside(height: int, width: int) -> NDArray[np.bool_]:
    """Pixels whose derivatives need nothing beyond the edge; all of them where the image is too small for that."""
    out = np.ones((height, width), dtype=bool)
    if min(height, width) > 2 * MARGIN + 2:
        out[:MARGIN], out[-MARGIN:], out[:, :MARGIN], out[:, -MARGIN:] = False, False, False, False
    return out


def _grid(height: int, width: int) -> tuple[NDArray[np.int64], Array, Array]:
    small = min(height, width)
    side = min(TILES, max(small // TILE_PX, FEWEST_TILES), small)
    r = (np.arange(height) * side) // height
    c = (np.arange(width) * side) // width
    index = r[:, None] * side + c[None, :]
    count = np.bincount(index.reshape(-1), minlength=side * side)
    xs = np.broadcast_to(np.linspace(-1, 1, width) if width > 1 else np.zeros(1), (height, width))
    ys = np.broadcast_to((np.linspace(-1, 1, height) if height > 1 else np.zeros(1))[:, None], (height, width))
    x = np.bincount(index.reshape(-1), xs.reshape(-1), side * side) / count
    y = np.bincount(index.reshape(-1), ys.reshape(-1), side * side) / count
    return index, x, y


def _tiles(
    u: NDArray[np.float32],
    variance: Array,
    scale: Array,
    pick: NDArray[np.bool_],
    index: NDArray[np.int64],
    x: Array,
    y: Array,
    fold: NDArray[np.int64],
) -> Tiles:
    rows = u.shape[0]
    s, noise, pixels = np.zeros((x.size, rows, rows)), np.zeros((x.size, rows)), np.zeros(x.size)
    for t in range(x.size):
        r, c = np.nonzero((index == t) & pick)
        part = u[:, r, c] / np.sqrt(scale[r, c])
        s[t], pixels[t] = part @ part.T, r.size
        noise[t] = np.sum(variance[:, r, c] / scale[r, c], axis=1)
    return Tiles(s, noise, x, y, fold, index, pick, pixels)


def _blocks(
    data: CaptureData,
    around: NDArray[np.float32],
    variance: Array,
    shared: Array,
    scale: Array,
    pick: NDArray[np.bool_],
    fold: int,
    clipped: bool,
    parts_of_states: int,
) -> list[Block]:
    rows = data.values_per_pixel
    size = len(FEATURES) * rows
    flat = np.flatnonzero(pick.reshape(-1))
    pixels = flat.size
    # By the first pixel, so that the sums do not depend on which thread was first.
    parts: dict[int, tuple[Array, Array]] = {}

    def add(start: int, stop: int) -> None:
        noise = np.zeros((rows, len(FEATURES), len(FEATURES)))
        products = np.zeros((size, size))
        for first in range(start, stop, CHUNK):
            z, of_pixels = _weighted(data, around, variance, shared, scale, flat[first : min(first + CHUNK, stop)])
            z = z.reshape(size, -1)
            products += z @ z.T
            noise += of_pixels
        parts[start] = products, noise

    if pixels > size:
        for_ranges(pixels, add, align=CHUNK, smallest=2 * CHUNK)
        total, noise = (sum(each[1:], each[0]) for each in zip(*(parts[k] for k in sorted(parts)), strict=True))
        root = _square_root(total)
    else:
        root, noise = _weighted(data, around, variance, shared, scale, flat)
    z = root.reshape(len(FEATURES), rows, -1)
    counts = _square_root(z[0] @ z[0].T)
    use = data.row_counts
    free = use & np.repeat(~data.clipped_states, data.signal.shape[1]) if clipped else use
    if not parts_of_states:
        return [Block(fold, z, counts, noise, np.flatnonzero(use), clipped, pixels, np.flatnonzero(free))]
    states, channels = data.signal.shape[:2]
    halves = np.random.default_rng(0).permutation(states) % parts_of_states
    rows_of = [use & np.repeat(halves == f, channels) for f in range(parts_of_states)]
    return [
        Block(f, z, counts, noise, np.flatnonzero(p), clipped, pixels, np.flatnonzero(p & free))
        for f, p in enumerate(rows_of)
    ]


def shared_noise(x_px: float, y_px: float, mixed: SharedNoise = NOTHING_SHARED) -> Array:
    """Covariance (6, 6) of the noise of a pixel and its derivatives in a frame that was moved back by so many pixels.

    For unit noise of wide patterns, which moving the frame, and what was `mixed` before, make alike among neighbours.
    """
    across = np.stack([np.convolve(kernel, noise_taps(x_px, mixed.right)) for _, kernel in PATTERNS])
    down = np.stack([np.convolve(kernel, noise_taps(y_px, mixed.down)) for kernel, _ in PATTERNS])
    return np.asarray((across @ across.T) * (down @ down.T) / mixed.wide)


def _noise(slopes: Array, share: Array, shared: Array) -> Array:
    """Expected noise (L, F, F) of products of features, summed over pixels; neighbours count as noisy as the pixel."""
    plain = len(slopes)
    out = np.zeros((share.shape[0], len(FEATURES), len(FEATURES)))
    out[:, :plain, :plain] = np.einsum("flp,glp,lp->lfg", slopes, slopes, share, optimize=True) * shared[:, :1, :1]
    cross = np.einsum("flp,lp->lf", slopes, share)[:, :, None] * shared[:, :1, 1:]
    out[:, :plain, plain:], out[:, plain:, :plain] = cross, cross.transpose(0, 2, 1)
    out[:, plain:, plain:] = share.sum(axis=1)[:, None, None] * shared[:, 1:, 1:]
    return out


def features(u: Array) -> tuple[Array, Array]:
    """Features of signals that need no neighbours, (F - 5, ...), and their derivatives by the signal."""
    z, slope = np.empty((2, len(FEATURES) - DERIVATIVES, *u.shape))
    # Products: numpy's powers beyond the second take ten times as long.
    log, square = np.log(np.maximum(u, TINY)), u * u
    cube, log_square = square * u, log * log
    z[0], slope[0] = u, 1.0
    z[1], slope[1] = 1.0, 0.0
    z[2], slope[2] = square, 2 * u
    z[3], slope[3] = cube, 3 * square
    z[4], slope[4] = square * square, 4 * cube
    z[5], slope[5] = u * log, log + 1
    z[6], slope[6] = u * log_square, log_square + 2 * log
    z[7], slope[7] = u * log_square * log, log_square * log + 3 * log_square
    return z, slope


def image_derivatives(u: NDArray[np.floating]) -> NDArray[np.float32]:
    """dx, dy, dxx, dxy, dyy (5, L, rows, columns) of images (L, rows, columns); zero if the image is too small."""
    from scipy.ndimage import correlate1d

    out = np.zeros((DERIVATIVES, *u.shape), dtype=np.float32)
    if min(u.shape[1:]) <= 2 * MARGIN + 2:
        return out
    for k, (along_y, along_x) in enumerate(PATTERNS[1:]):
        out[k] = correlate1d(correlate1d(u, along_x, axis=2), along_y, axis=1)
    return out


def _square_root(s: Array) -> Array:
    value, vector = np.linalg.eigh(s)
    keep = value > 1e-15 * value[-1]
    return np.asarray(vector[:, keep] * np.sqrt(value[keep]))
