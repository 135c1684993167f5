"""Two channels or more see one source: a factor that they share in a state is not a property of the sample."""

import h5py
import numpy as np
import pytest

from processing.instrument.model import InstrumentModel
from processing.reduction.mueller import reduce_mueller
from processing.reduction.mueller_reduction import Choice
from processing.reduction.noise import NoiseModel
from processing.reduction.source_level import SourceMoments
from processing.storage.captures.capture import Capture
from processing.storage.products.images import MuellerImage
from processing.storage.products.product import Step
from processing.yaml_file import dump_yaml

HALF_WAVE = np.array([[1, 0.01, 0, 0.02], [0, 0.98, -0.1, 0], [0.01, -0.1, -0.97, 0.08], [0, 0, -0.08, -0.96]])
DEPOLARIZER = np.array([[1, 0.03, -0.02, 0.01], [0.02, 0.04, 0, 0], [0, 0, 0.03, 0.01], [0.01, 0, 0, 0.02]])
#: Angles of the axes of instruments with two channels or more that see one source.
ANGLES = {
    "drr_wollaston": {"psg": 4.0 * np.arange(46)},
    "dual_beam_charis": {
        "hwp": np.repeat(11.25 * np.arange(8), 8),
        "image_rotator": np.tile(45 + 12.5 * np.arange(8), 8),
    },
    "mosaic_polarimeter": {"psg": 9.0 * np.arange(40)},
}
NOISE = 2e-3


@pytest.fixture
def measured(configs, synthetic_capture, tmp_path):
    """Reduces a sample seen with levels of the source; returns M/m00, its errors and what the product tells."""

    def run(name, sample, level=1.0, pixels=1, noise=NOISE, seed=0, weighted=False, **changed):
        model = InstrumentModel.load(configs / f"instruments/{name}.yaml")
        model = model.model_copy(update={"mosaic": None, "beams": None, "free_source": None} | changed)
        if name == "dual_beam_charis":
            model = model.with_values({"image_rotator": {"retardance_deg": 100.0}})
        model = model.at(662)
        random, angles = np.random.default_rng(seed), ANGLES[name]
        states = len(next(iter(angles.values())))
        signal = model.rows(angles) @ sample.reshape(16) * 1e4 * np.broadcast_to(level, states)[:, None]
        frames = signal[..., None, None] + 1e4 * noise * random.standard_normal((*signal.shape, 1, pixels))
        path = synthetic_capture(
            frames.astype(np.float64),
            angles,
            instrument_yaml=dump_yaml(model),
            channels=tuple(c.name for c in model.channels),
        )
        out = tmp_path / "m.h5"
        with Capture(path) as capture:
            stated = NoiseModel.of_sigma(np.full(states, 1e4 * noise)) if noise else None
            choice = Choice(weighted=weighted, noise=stated if weighted else None)
            facts = reduce_mueller(capture, model, out, (Step("reduce", {}),), choice=choice, overwrite=True)
        image = MuellerImage.load(out)
        return image.values / image.values[0, 0], image.errors / image.values[0, 0], facts

    return run


def flicker(states=46, seed=5):
    random = np.random.default_rng(seed)
    return random.uniform(0.6, 1.4, states)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("name", ["drr_wollaston", "mosaic_polarimeter"])
def test_a_factor_of_each_state_does_not_change_m(name, weighted, measured):
    states = len(next(iter(ANGLES[name].values())))
    steady, _, _ = measured(name, HALF_WAVE, noise=1e-6, weighted=weighted)
    m, _, facts = measured(name, HALF_WAVE, flicker(states), noise=1e-6, weighted=weighted)
    assert m == pytest.approx(steady, abs=3e-5, nan_ok=True)
    assert "projected out" in facts["source"]


def test_the_product_holds_the_levels(measured, tmp_path):
    level = flicker()
    measured("drr_wollaston", HALF_WAVE, level)
    with h5py.File(tmp_path / "m.h5") as h5:
        nodes = {}
        h5.visititems(lambda name, node: nodes.__setitem__(name.rpartition("/")[2], node))
        levels, error = nodes["source_level"][...], nodes["source_level_errors"][...]
    pulls = (levels - level / level.mean()) / error
    assert np.sqrt(np.mean(pulls**2)) == pytest.approx(1, abs=0.35)


@pytest.mark.parametrize(("sample", "pixels"), [(HALF_WAVE, 1), pytest.param(DEPOLARIZER, 40, marks=pytest.mark.long)])
def test_the_error_bars_have_the_levels_in_them(sample, pixels, measured):
    pulls = []
    for seed in range(12):
        m, error, _ = measured("drr_wollaston", sample, flicker(seed=seed), pixels=pixels, seed=seed)
        pulls.append(((m[..., 0, :] - sample[..., None]) / error[..., 0, :]).reshape(16, -1)[1:, 0])
    assert np.sqrt(np.mean(np.square(pulls))) == pytest.approx(1, abs=0.25)


@pytest.mark.long
def test_a_steady_source_costs_little(measured):
    """Light that hardly polarizes does not tell the levels: a source that is steady elsewhere is steady there."""
    ratio = []
    for seed in range(12):
        free, _, _ = measured("drr_wollaston", DEPOLARIZER, seed=seed)
        held, _, _ = measured("drr_wollaston", DEPOLARIZER, seed=seed, free_source=False)
        ratio.append([np.sum((m[..., 0, 0] - DEPOLARIZER) ** 2) for m in (free, held)])
    free, held = np.sqrt(np.mean(ratio, axis=0))
    assert free < 1.3 * held


def test_a_source_that_is_declared_steady_is_not_asked(measured):
    _, _, facts = measured("drr_wollaston", HALF_WAVE, free_source=False)
    assert "source" not in facts


def test_data_without_noise_have_levels_of_one(configs):
    """The residual of such data is rounding of either sign, which differs between processors."""
    model = InstrumentModel.load(configs / "instruments/mosaic_polarimeter.yaml").at(662)
    w = model.rows({"psg": 9.0 * np.arange(40)}).reshape(-1, 16)
    y = w @ HALF_WAVE.reshape(16)
    basis = np.linalg.svd(w)[2][: np.linalg.matrix_rank(w)].T
    for rounding in (-1e-16, 0.0, 1e-16):
        products = np.outer(y, y) + rounding * (y @ y) / len(y) * np.eye(len(y))
        levels = SourceMoments(products, 1000, len(w) // 40).levels(w, basis)
        np.testing.assert_allclose(levels.relative, 1, atol=1e-6)
