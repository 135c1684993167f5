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
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array, BoolArray
from processing.diagnosis.captures.capture_data import CaptureData
from processing.diagnosis.captures.read_capture import FEW_PIXELS
from processing.diagnosis.instrument.features import FEATURES, MARGIN
from processing.diagnosis.instrument.pixel_sums import Pixels, Precision, features_of_pixels, products_of_pixels
from processing.diagnosis.search.range_of import RANK
from processing.diagnosis.search.rules import FOLDS_OF_TILES, TILES
from processing.instrument.changes import places
from processing.storage.captures.capture import CaptureError

#: [intensities of a pixel] Beyond which states are held out, not tiles of the image.
MOST_ROWS_FOR_TILES = 100
#: [parts] The same of the states, of which there are few.
FOLDS_OF_STATES = 5
#: [tiles] Along each side of an image, for effects and structure that vary over it.
MOST_TILES = 16
#: [pixels] Along a side of a tile, between these two.
TILE_PX = 4


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
    s : (T, L, L); noise : (T, L); x, y : (T,) where its light is, from -1 to 1; fold : (T,).
    index : (rows, columns) tile of each pixel; boxes : rows and columns of each tile.
    pick : (rows, columns) pixels that count; pixels : (T,) how many.
    """

    s: Array
    noise: Array
    x: Array
    y: Array
    fold: NDArray[np.int64]
    index: NDArray[np.int64]
    boxes: tuple[tuple[slice, slice], ...]
    pick: NDArray[np.bool_]
    pixels: Array
    #: What `features_of_tiles` keeps, by the numbers of the features.
    features: dict[tuple[int, ...], tuple[Array, Array]] = field(default_factory=dict)


@dataclass(frozen=True)
class Moments:
    """Blocks and tiles of one capture.

    Attributes
    ----------
    tiles, clipped : of pixels without and with a clipped state; None where states are held out.
    counts : (L,) rows of W that count.
    sigma : (L,) noise of each row in the weighted units; shown : (L,) part of its variance that the pixels show.
    relative : turns a weighted square into a square relative to the mean signal.
    spread : mean square over squared mean of the variances: 1 if all pixels and states are equally noisy.
    noise_floor : rms noise over the mean signal.
    """

    blocks: tuple[Block, ...]
    tiles: Tiles | None
    clipped: Tiles | None
    counts: NDArray[np.bool_]
    sigma: Array
    shown: Array
    relative: float
    spread: float
    noise_floor: float
    held_out: str

    def forget_features(self) -> None:
        """Drop the features of the tiles, which are made again where they are asked for."""
        for tiles in filter(None, (self.tiles, self.clipped)):
            tiles.features.clear()


def holds_out_states(data: CaptureData) -> bool:
    """Whether states are held out (few pixels, or many states) instead of tiles of the image."""
    return data.values_per_pixel > MOST_ROWS_FOR_TILES or int(data.usable.sum()) < FEW_PIXELS


def folds_of(captures: Sequence[CaptureData]) -> int:
    """How many parts of the captures are held out in turn."""
    return FOLDS_OF_STATES if any(holds_out_states(c) for c in captures) else FOLDS_OF_TILES


def moments_of(data: CaptureData, folds: int) -> Moments:
    """Build the moments of a capture, to be held out in so many parts.

    Raises CaptureError: no pixel counts.
    """
    pixels, channels = Pixels(data), data.signal.shape[1]
    if not pixels.good.any():
        raise CaptureError(
            f"{data.name}: no pixel is at once bright, away from sharp edges, and {MARGIN} pixels off the image's rim. "
            "Take a larger region of the camera, or one that the sample fills."
        )
    means = pixels.means()
    # Where too much was subtracted a dark state is negative all over; its noise is not less than that of the read-out.
    sigma = np.sqrt(np.maximum(means.share, np.repeat(data.floor, channels) / 2 * means.inverse))
    share = pixels.shared[:, 0, 0]
    tiles, clipped_tiles = None, None
    by_state = holds_out_states(data)
    grid = _Grid.of(*data.usable.shape)
    if by_state:
        fold_of_pixel = np.zeros(data.usable.shape, dtype=np.int64)
        held = f"every state is predicted by a fit to the states of the other parts ({folds} parts, drawn at random)"
    else:
        side = int(np.ceil(np.sqrt(grid.x.size)))
        fold_of_tile = (np.arange(grid.x.size) // side + np.arange(grid.x.size) % side) % folds
        fold_of_pixel = fold_of_tile[grid.index]
        held = f"every tile of the image is predicted by a fit to the other tiles ({folds} parts, interleaved)"
        tiles = _tiles(pixels, pixels.good & ~data.clipped, grid, fold_of_tile)
        if data.clipped.any():
            clipped_tiles = _tiles(pixels, pixels.good & data.clipped, grid, fold_of_tile)
    picks = {
        (fold, clipped): pixels.good & (data.clipped == clipped) & (fold_of_pixel == fold)
        for clipped in (False, True)
        for fold in range(1 if by_state else folds)
    }
    counts = data.row_counts
    mean = float(means.signal[counts].mean())
    noise_floor = float(np.sqrt(np.mean(means.variance[counts]))) / mean
    parts = {part: pick for part, pick in picks.items() if pick.any()}
    return Moments(
        blocks=_blocks(data, pixels, parts, folds * by_state, kind=pixels.precision(abs(noise_floor))),
        tiles=tiles,
        clipped=clipped_tiles,
        counts=counts,
        sigma=sigma,
        shown=share,
        relative=float(np.mean(pixels.scale[pixels.good])) / mean**2,
        spread=float(np.mean(means.share_square[counts] / sigma[counts] ** 4)),
        noise_floor=noise_floor,
        held_out=held,
    )


@dataclass(frozen=True)
class _Grid:
    """Tiles of an image: the tile (rows, columns) of each pixel, the box of each, and its centre (T,) from -1 to 1."""

    index: NDArray[np.int64]
    boxes: tuple[tuple[slice, slice], ...]
    x: Array
    y: Array

    @classmethod
    def of(cls, height: int, width: int) -> _Grid:
        small = min(height, width)
        side = min(MOST_TILES, max(small // TILE_PX, TILES), small)
        r, rows, y = _divide(height, side)
        c, columns, x = _divide(width, side)
        boxes = tuple((down, across) for down in rows for across in columns)
        return cls(r[:, None] * side + c, boxes, np.tile(x, side), np.repeat(y, side))


def _divide(size: int, parts: int) -> tuple[NDArray[np.int64], list[slice], Array]:
    """Which part each pixel of a side is in, the pixels of each part, and their mean place from -1 to 1."""
    number = (np.arange(size) * parts) // size
    ends = np.searchsorted(number, np.arange(parts + 1))
    place = places(1, size)[0][0]
    slices = [slice(int(first), int(last)) for first, last in pairwise(ends)]
    return number, slices, np.array([place[part].mean() for part in slices])


def _tiles(pixels: Pixels, pick: BoolArray, grid: _Grid, fold: NDArray[np.int64]) -> Tiles:
    rows, count = len(pixels.u), grid.x.size
    share = pixels.shared[:, 0, 0]
    s, noise, number = np.zeros((count, rows, rows)), np.zeros((count, rows)), np.zeros(count)
    x, y = grid.x.copy(), grid.y.copy()
    place_x, place_y = places(*pick.shape)
    for t, (down, across) in enumerate(grid.boxes):
        inside = pick[down, across]
        weight = 1 / pixels.scale[down, across][inside]
        part = pixels.u[:, down, across][:, inside] * np.sqrt(weight)
        s[t], number[t] = part @ part.T, weight.size
        noise[t] = pixels.variance(slice(None), down, across)[:, inside] @ weight * share
        # Of a tile at the rim some pixels count, and of those the bright ones: its centre is not where they are.
        light = np.sum(part**2, axis=0)
        if light.any():
            x[t], y[t] = (np.average(place[down, across][inside], weights=light) for place in (place_x, place_y))
    return Tiles(s, noise, x, y, fold, grid.index, grid.boxes, pick, number)


def _blocks(
    data: CaptureData,
    pixels: Pixels,
    picks: dict[tuple[int, bool], BoolArray],
    parts_of_states: int,
    *,
    kind: Precision,
) -> tuple[Block, ...]:
    """Blocks of picks by fold and whether they are clipped; of so many parts of the states each, if any."""
    rows, size = len(pixels.u), len(FEATURES) * len(pixels.u)
    many = {part: pick for part, pick in picks.items() if pick.sum() > size}
    sums = dict(zip(many, products_of_pixels(pixels, [*many.values()], kind), strict=True))
    blocks: list[Block] = []
    for part, pick in picks.items():
        if part in sums:
            root, noise = _square_root(sums[part][0]).reshape(len(FEATURES), rows, -1), sums[part][1]
        else:
            root, noise = features_of_pixels(pixels, pick)
        fold, clipped = part
        blocks += _blocks_of(
            data, root, noise, fold, clipped=clipped, pixels=int(pick.sum()), parts_of_states=parts_of_states
        )
    return tuple(blocks)


def _blocks_of(
    data: CaptureData, z: Array, noise: Array, fold: int, *, clipped: bool, pixels: int, parts_of_states: int
) -> list[Block]:
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


def _square_root(s: Array) -> Array:
    value, vector = np.linalg.eigh(s)
    keep = value > RANK**2 * value[-1]
    return np.asarray(vector[:, keep] * np.sqrt(value[keep]))
