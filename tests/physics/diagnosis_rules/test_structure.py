"""Constants by which an image is divided, its structure is tested, and its edges are asked."""

from types import SimpleNamespace as Some

import numpy as np
from rule_decisions import Patch, decides
from test_reading import signals

from processing.diagnosis.instrument import edges, moments, structure


def found_in(rows: int, height: int, width: int, unused: int = 0) -> dict[str, float]:
    """Tests of a residual of noise, without so many pixels of its last row."""
    r = np.random.default_rng(0).normal(size=(rows, height, width)).astype(np.float32)
    good = np.ones((height, width), dtype=bool)
    good[-1, :unused] = False
    r[:, ~good] = np.nan
    around, expected = np.where(good, 1 + np.arange(width) / width, 0), np.where(good, 1, 0)
    wide = [np.broadcast_to(x, r.shape).astype(np.float32) for x in (around, expected)]
    images = structure.Images(r, *wide, good)
    return structure._tests(images, np.ones(rows), np.zeros((rows, 2)), 1, 1.0, True)[0]


@decides
def test_fewest_for_patterns(m: Patch) -> bool:
    return "patches" in found_in(5, 5, 6) and "patches" not in found_in(5, 5, 6, unused=1)


@decides
def test_fewest_pairs(m: Patch) -> bool:
    return "neighbours, rows" in found_in(1, 12, 10, 9) and "neighbours, rows" not in found_in(1, 12, 10, 10)


@decides
def test_patches(m: Patch) -> bool:
    # Without any residual each patch lacks the noise of one.
    return structure._patches(np.zeros((1, 72, 72)), np.ones((1, 72, 72)), 1.0)[0] == -64


@decides
def test_harmonics(m: Patch) -> bool:
    angles = np.arange(0.0, 360.0, 5.0)
    states = np.cos(np.deg2rad(4 * angles)) + np.cos(np.deg2rad(5 * angles))
    return structure._harmonics(states, angles).round(9).tolist() == [0, 0, 0, 1]


@decides
def test_fewest_at_edges(m: Patch) -> bool:
    """Edges that are asked are those of a model."""

    class AskedError(Exception):
        pass

    def changes(*of: object) -> None:
        raise AskedError

    def asked(pixels: int) -> bool:
        steep = np.zeros((20, 20), dtype=bool)
        steep[8, 4 : 4 + pixels] = True
        still = Some(steep=steep, clipped=np.zeros_like(steep), wavelength_nm=662.0)
        space = Some(candidates=(), slices=())
        try:
            edges._of_capture(Some(still=[still], moments=[None], changes=changes), 0, space, np.zeros(0), [])
        except AskedError:
            return True
        return False

    return asked(10) and not asked(9)


def held_out_states(states: int, pixels: int) -> bool:
    return moments.holds_out_states(signals(np.ones((states, 1, pixels))))


@decides
def test_most_rows_for_tiles(m: Patch) -> bool:
    return held_out_states(101, 1000) and not held_out_states(100, 1000)


@decides
def test_fewest_pixels_for_tiles(m: Patch) -> bool:
    return held_out_states(20, 63) and not held_out_states(20, 64)


@decides
def test_folds_of_tiles(m: Patch) -> bool:
    return moments.folds_of([signals(np.ones((20, 1, 1000)))]) == 2


@decides
def test_folds_of_states(m: Patch) -> bool:
    return moments.folds_of([signals(np.ones((20, 1, 10)))]) == 5


def tiles(side: int) -> int:
    """Tiles along each side of an image."""
    return round(np.sqrt(moments._Grid.of(side, side).x.size))


@decides
def test_most_tiles(m: Patch) -> bool:
    return tiles(400) == 16


@decides
def test_fewest_tiles(m: Patch) -> bool:
    return tiles(20) == 8


@decides
def test_tile_px(m: Patch) -> bool:
    return tiles(48) == 12
