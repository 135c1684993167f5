"""Derivatives of the rows of every tile of an image by each value, as far as they are the same in all tiles."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.captured.capture_data import CaptureData
from processing.diagnosis.instrument.moments import Moments
from processing.diagnosis.instrument.slopes import ChangesOf, fitted, slopes_of_rows, stepped
from processing.diagnosis.instrument.tile_rows import (
    QUADRATIC,
    at_more_nodes,
    columns_at_nodes,
    shares_of_tiles,
    tile_columns,
)
from processing.diagnosis.search.space import Space
from processing.instrument.effects.base import CountsEffect, FieldEffect
from processing.instrument.model import InstrumentModel


@dataclass(frozen=True)
class TileSlopes:
    """Derivatives of a capture with tiles by K values.

    Attributes
    ----------
    at_nodes : (K, n, L, K') of the rows at each node; zero for the values that follow.
    shares : (n, tiles) what each tile has of what is linear or quadratic in them.
    fields : (J,) values whose derivative differs from tile to tile; da : (J, tiles, L, K') of the rows.
    counted : (C,) values of corrections of the counts; dc : (C, F, L) of the coefficients.
    """

    at_nodes: Array
    shares: Array
    fields: NDArray[np.int64]
    da: Array
    counted: NDArray[np.int64]
    dc: Array

    def of_rows(self, rows: NDArray[np.int64], features: NDArray[np.int64]) -> TileSlopes:
        """Of some rows and some features alone."""
        dc = self.dc[:, features][..., rows]
        return replace(self, at_nodes=self.at_nodes[:, :, rows], da=self.da[:, :, rows], dc=dc)


def slopes_of_tiles(
    model: InstrumentModel,
    data: CaptureData,
    moments: Moments,
    changes_of: ChangesOf,
    space: Space,
    values: Array,
    a: Array,
    dc: Array,
) -> TileSlopes:
    """Derivatives at values (K,), where the rows are a (tiles, L, K'), with those dc (K, F, L) of the coefficients."""
    if moments.tiles is None:
        raise ValueError("a capture that holds out states has no tiles")
    changes, conditions = changes_of(values), data.conditions
    columns = partial(columns_at_nodes, model, data, moments)
    apart = CountsEffect, FieldEffect
    at_nodes = slopes_of_rows(changes_of, model, conditions, space, values, columns(changes), columns, apart)
    fields = {
        part.start + j: (tile_columns(model, data, moments, changes_of(moved)) - a) / step
        for candidate, part in fitted(space)
        if isinstance(candidate.effect, FieldEffect)
        for j, (moved, step) in enumerate(stepped(candidate, part, values))
    }
    counted = np.flatnonzero(np.any(dc, axis=(1, 2)))
    return TileSlopes(
        at_more_nodes(at_nodes, len(changes.field_retardance_rad)),
        shares_of_tiles(moments.tiles, changes, QUADRATIC),
        np.array(list(fields), dtype=np.int64),
        np.array(list(fields.values())).reshape(-1, *a.shape),
        counted,
        dc[counted],
    )
