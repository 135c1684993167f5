"""Rows of every tile of an image over which a retardance varies, from those at a few retardances.

A retarder's Mueller matrix is linear in 1, cosine and sine of its retardance: its values at three of them tell all
others. What is quadratic in the rows has twice the frequency as well, and needs five.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from processing.arrays import Array
from processing.diagnosis.captured.capture_data import CaptureData
from processing.diagnosis.instrument.moments import Moments, Tiles
from processing.instrument.changes import Changes
from processing.instrument.model import InstrumentModel
from processing.reduction.effects_of_capture import extra_retardance, with_extra

#: [1, fixed] Frequency of what is linear in the rows.
LINEAR = 1
#: [1, fixed] Frequency of what is quadratic in the rows.
QUADRATIC = 2


def tile_columns(model: InstrumentModel, data: CaptureData, moments: Moments, changes: Changes) -> Array:
    """A (tiles, L, K) where a retardance varies over the image, rows in units of their noise."""
    if moments.tiles is None:
        raise ValueError("a capture that holds out states has no tiles")
    shares = shares_of_tiles(moments.tiles, changes, LINEAR)
    return np.asarray(np.tensordot(shares, columns_at_nodes(model, data, moments, changes), axes=(0, 0)))


def shares_of_tiles(tiles: Tiles, changes: Changes, frequencies: int) -> Array:
    """What share (n, tiles) each tile has of the rows at each node, or of what so many frequencies tell of them."""
    return _shares(extra_retardance(changes, tiles.x, tiles.y), frequencies)


def columns_at_nodes(model: InstrumentModel, data: CaptureData, moments: Moments, changes: Changes) -> Array:
    """A (n, L, K) with every retardance that varies at one of a few values, rows in units of their noise."""
    nodes, angles = _nodes(len(changes.field_retardance_rad), LINEAR), data.conditions.angles_deg
    w = np.stack([model.rows(angles, with_extra(changes, node)).reshape(-1, 16) for node in nodes])
    a = w if data.sample is None else (w @ data.sample)[..., None]
    return np.asarray(a * (data.row_exposure / moments.sigma)[:, None])


def at_more_nodes(linear: Array, elements: int) -> Array:
    """What is linear in the rows (..., n, L, K) at the nodes that the quadratic needs, of so many elements."""
    shares = _shares(_nodes(elements, QUADRATIC).T, LINEAR)
    flat = linear.reshape(*linear.shape[:-2], -1)
    return np.asarray(shares.T @ flat).reshape(*linear.shape[:-3], shares.shape[1], *linear.shape[-2:])


def _shares(extra: Array, frequencies: int) -> Array:
    """Shares (n, P) of the nodes at extra retardances (elements, P)."""
    apart = extra - _nodes(len(extra), frequencies)[:, :, None]
    waves = 1 + 2 * sum(np.cos(m * apart) for m in range(1, frequencies + 1))
    return np.asarray(np.prod(waves / (2 * frequencies + 1), axis=1))


def _nodes(elements: int, frequencies: int) -> Array:
    """Retardances (n, elements), all combinations of 2 frequencies + 1 equally spaced ones, radians."""
    count = 2 * frequencies + 1
    around = 2 * np.pi * np.arange(count) / count
    return np.array(list(product(around, repeat=elements))).reshape(count**elements, elements)
