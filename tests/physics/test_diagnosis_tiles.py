"""Tiles of the image whose retarders are not alike, and derivatives that are summed over the tiles first."""

from collections import defaultdict
from functools import partial

import numpy as np
import pytest
from bench_capture import bench_capture, read
from steady_capture import steady_capture

from processing.diagnosis.instrument.features import DERIVATIVES, FEATURES
from processing.diagnosis.instrument.moments import FOLDS_OF_TILES, moments_of
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.projection import Projected, add_blocks
from processing.diagnosis.instrument.slopes import slopes_of_rows
from processing.diagnosis.instrument.tiles import TileSlopes, add_tiles, features_of_tiles, tile_columns
from processing.diagnosis.search.space import Space, Sums
from processing.instrument.changes import FIELD_TERMS, Changes, field_terms
from processing.instrument.model import AppliedEffect, EffectParameter
from simulators.blind.undeclared_captures import TrueBench


@pytest.fixture(scope="module")
def scene(configs, tmp_path_factory):
    file = configs / "instruments/rgb950.yaml"
    path = bench_capture(tmp_path_factory.mktemp("tiles"), file, TrueBench(rows=32, columns=32), seed=3)
    model, data = read(path, file)
    return model, data, moments_of(data, FOLDS_OF_TILES)


@pytest.mark.parametrize("elements", [("psg_retarder",), ("psg_retarder", "psa_retarder")])
def test_columns_of_every_tile_are_those_of_its_own_retardance(scene, elements):
    model, data, moments = scene
    random = np.random.default_rng(8)
    changes = Changes(data.conditions)
    changes.stray = 0.01
    changes.retardance_rad["psg_retarder"] = random.normal(0, 0.1, data.conditions.states)
    for element in elements:
        changes.field_retardance_rad[element] = random.normal(0, 0.3, 5)
    columns = tile_columns(model, data, moments, changes)
    smooth = field_terms(moments.tiles.x, moments.tiles.y)
    for tile in (0, 37, 63):
        tile_changes = Changes(data.conditions, stray=0.01)
        tile_changes.retardance_rad = defaultdict(lambda: np.zeros(()), changes.retardance_rad)
        for element in elements:
            extra = changes.field_retardance_rad[element] @ smooth[:, tile]
            tile_changes.retardance_rad[element] = tile_changes.retardance_rad[element] + extra
        rows = model.rows(data.conditions.angles_deg, tile_changes).reshape(-1, 16)
        assert columns[tile] == pytest.approx(rows / moments.sigma[:, None], abs=1e-12 / moments.sigma.min())


def test_a_tile_is_where_its_light_is():
    """Pixels at the rim are not used: taken at its centre, the outermost tile made a map over the image too flat."""
    random = np.random.default_rng(4)
    signal = np.tile(random.uniform(0.2, 0.8, (2, 1, 1)), (1, 40, 40)) * np.linspace(1, 2, 40)
    tiles = moments_of(steady_capture(signal, 1e-3), FOLDS_OF_TILES).tiles
    across = np.linspace(-1, 1, 40)[tiles.boxes[0][1]]
    used = tiles.pick[tiles.boxes[0]].any(axis=0)
    assert not used.all()
    light = np.linspace(1, 2, 40)[tiles.boxes[0][1]][used] ** 2
    assert tiles.x[0] == pytest.approx(np.average(across[used], weights=light), abs=1e-3)
    assert tiles.y[0] == pytest.approx(across[used].mean(), abs=1e-3)


def test_many_pixels_of_a_tile_are_as_few_as_their_products_need():
    random = np.random.default_rng(4)
    data = steady_capture(random.uniform(0.2, 0.8, (2, 72, 72)), 1e-3)
    moments = moments_of(data, FOLDS_OF_TILES)
    tiles, sigma = moments.tiles, moments.sigma[:, None]
    _, z, _ = features_of_tiles(data, moments, tiles, [0, FEATURES.index("square")])
    assert z.shape == (256, 2, 2, 4)
    z = z * sigma
    assert z[:, 0] @ z[:, 0].transpose(0, 2, 1) == pytest.approx(tiles.s, rel=1e-6)
    u = data.signal[:, 0, :5, :5].reshape(2, -1)[:, tiles.pick[:5, :5].reshape(-1)].astype(float)
    assert np.sum(z[0, 1, 1] * z[0, 0, 0]) == pytest.approx(1e6 * np.sum(u[1] ** 2 * u[0]), rel=1e-6)
    features, counts, _ = features_of_tiles(data, moments, tiles, [0])
    assert features == (0,)
    counts = counts * sigma
    assert counts @ counts.transpose(0, 1, 3, 2) == pytest.approx(tiles.s[:, None], rel=1e-6)


@pytest.mark.parametrize("shifted", [False, True])
def test_tiles_that_are_all_alike_say_what_the_blocks_say(scene, shifted):
    model, data, _ = scene
    random = np.random.default_rng(9)
    if shifted:
        data = data.moved_back(random.uniform(-0.5, 0.5, (data.conditions.states, 2)))
    moments = moments_of(data, FOLDS_OF_TILES)
    a = model.rows(data.conditions.angles_deg).reshape(-1, 16) / moments.sigma[:, None]
    rows = a.shape[0]
    c, dc = np.zeros((len(FEATURES), rows)), np.zeros((4, len(FEATURES), rows))
    c[0], c[FEATURES.index("square")], c[FEATURES.index("dx")] = 1.0, 0.02, random.normal(0, 0.1, rows)
    dc[2, FEATURES.index("one")] = 1.0
    dc[3, FEATURES.index("dy")] = random.normal(size=rows)
    da = np.zeros((4, *a.shape))
    da[:2] = random.normal(size=(2, *a.shape))
    blocks, tiles = Sums.empty(FOLDS_OF_TILES, 4), Sums.empty(FOLDS_OF_TILES, 4)
    for block in moments.blocks:
        add_blocks([block], a, c, da, dc=dc, moments=moments, out=blocks)
    count = moments.tiles.x.size
    none, counted = np.zeros(0, dtype=int), np.array([2, 3])
    slopes = TileSlopes(da[:, None], np.ones((1, count)), none, np.zeros((0, count, *a.shape)), counted, dc[counted])
    add_tiles(data, moments, moments.tiles, np.broadcast_to(a, (count, *a.shape)), c=c, slopes=slopes, out=tiles)
    for name in ("excess", "freedom", "square", "count", "gradient", "curvature"):
        expected = getattr(blocks, name)
        assert getattr(tiles, name) == pytest.approx(expected, rel=1e-6, abs=1e-6 * np.abs(expected).max()), name


KINDS = ("field_retardance", "psg_retardance", "rotation_eccentricity", "retarder_diattenuation", "stray_light")
KINDS_OF_COUNTS = ("detector_offset", "beam_wander")


@pytest.fixture(scope="module")
def problem(configs, tmp_path_factory):
    file = configs / "instruments/rgb950.yaml"
    path = bench_capture(tmp_path_factory.mktemp("tiles"), file, TrueBench(rows=32, columns=32), seed=3)
    model, data = read(path, file)
    return InstrumentProblem(model, [data])


@pytest.mark.parametrize("varying", [0, 1, 2])
def test_sums_over_tiles_are_those_of_every_tile_by_itself(problem, varying):
    pool = [c for c in problem.pool() if c.kind in KINDS + KINDS_OF_COUNTS]
    space = Space(tuple(sorted(pool, key=lambda c: c.kind != "field_retardance")))
    assert {c.kind for c in space.candidates} == {*KINDS, *KINDS_OF_COUNTS}
    values = 0.3 * space.joined("typical") * np.random.default_rng(5).normal(size=space.size)
    for candidate, part in list(space.pairs)[varying:]:
        if candidate.kind == "field_retardance":
            values[part] = 0.0
    sums = problem.sums(space, values)
    plain = problem.sums(space, values, derivatives=False)
    excess, gradient, stretch, curvature = _tile_by_tile(problem, space, values)
    assert sums.excess == pytest.approx(excess, rel=1e-7)
    if varying:
        assert plain.excess == pytest.approx(excess, rel=1e-7)
    # The unknown sample takes up what some values do; of these only rounding is left, far below what their prior tells.
    size = np.sqrt(np.einsum("fkk->fk", curvature)) + 1 / space.joined("typical")
    assert np.abs(sums.gradient - gradient) == pytest.approx(0, abs=1e-9 * np.abs(gradient).max())
    assert sums.stretch == pytest.approx(stretch, abs=1e-9 * np.abs(stretch).max())
    assert (sums.curvature - curvature) / (size[:, :, None] * size[:, None]) == pytest.approx(0, abs=1e-7)


def test_an_instrument_that_varies_of_itself_needs_no_value_for_it(problem):
    terms = {n: EffectParameter(value=0.5, unit="degree") for n in FIELD_TERMS}
    field = AppliedEffect(kind="field_retardance", element="psg_retarder", parameters=terms)
    varying = InstrumentProblem(problem.model.model_copy(update={"effects": (field,)}), problem.captures)
    baseline = varying.sums(Space(()), np.zeros(0))
    assert baseline.gradient.shape == (2, 0)
    space = Space(tuple(c for c in problem.pool() if c.kind == "rotation_eccentricity"))
    values = np.zeros(space.size)
    sums = varying.sums(space, values)
    excess, gradient, _, curvature = _tile_by_tile(varying, space, values)
    assert sums.excess == pytest.approx(baseline.excess)
    assert sums.excess == pytest.approx(excess, rel=1e-7)
    assert sums.gradient == pytest.approx(gradient, rel=1e-6)
    assert sums.curvature == pytest.approx(curvature, rel=1e-6, abs=1e-9 * curvature.max())


def _tile_by_tile(problem, space, values):
    """Excess, half gradient, stretch and curvature of each fold, with every derivative of every tile."""
    data, moments, model = problem.captures[0], problem.moments[0], problem.models[0]
    columns, changes_of = partial(tile_columns, model, data, moments), partial(problem.changes, 0, space)
    a, c = columns(changes_of(values)), problem.coefficients(0, changes_of(values))
    da = slopes_of_rows(changes_of, model, data.conditions, space, values=values, a=a, columns=columns)
    dc = problem.slopes_of_counts(0, space, values, c)
    tiles, use = moments.tiles, moments.counts
    features, z, noise = features_of_tiles(data, moments, tiles, range(len(FEATURES)))
    around = np.array(features) >= len(FEATURES) - DERIVATIVES
    excess, (gradient, stretch) = np.zeros(2), np.zeros((2, 2, space.size))
    curvature = np.zeros((2, space.size, space.size))
    for t, fold in enumerate(tiles.fold):
        tile = slice(t, t + 1)
        part = Projected(z[tile], noise[tile], a[tile][:, use], c[None][:, :, use], around=around)
        excess[fold] += np.sum(part.residual**2) - part.expected.sum()
        slopes = part.slopes(da[:, tile][:, :, use], dc[:, None][..., use])
        for total, of_one in zip((gradient, stretch, curvature), slopes, strict=True):
            total[fold] += of_one
    return excess, gradient, stretch, curvature
