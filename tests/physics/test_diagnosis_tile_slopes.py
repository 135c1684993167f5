"""Derivatives that are summed over the tiles first, against those of every tile."""

from functools import partial

import numpy as np
import pytest
from bench_capture import bench_capture, read

from processing.diagnosis.instrument.features import DERIVATIVES, FEATURES
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.projection import Projected
from processing.diagnosis.instrument.slopes import slopes_of_rows
from processing.diagnosis.instrument.tiles import features_of_tiles, tile_columns
from processing.diagnosis.search.space import Space
from processing.instrument.changes import FIELD_TERMS
from processing.instrument.model import AppliedEffect, EffectParameter
from simulators.blind.undeclared_captures import TrueBench

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
    nothing = varying.sums(Space(()), np.zeros(0))
    assert nothing.gradient.shape == (2, 0)
    space = Space(tuple(c for c in problem.pool() if c.kind == "rotation_eccentricity"))
    values = np.zeros(space.size)
    sums = varying.sums(space, values)
    excess, gradient, _, curvature = _tile_by_tile(varying, space, values)
    assert sums.excess == pytest.approx(nothing.excess)
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
