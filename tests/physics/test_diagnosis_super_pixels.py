"""A polarization camera behind a turning plate: the four polarizers of a super-pixel look at places apart.

On an object whose light changes from pixel to pixel, or ends at an edge, that alone is no fault of the instrument.
"""

import numpy as np
import pytest

from processing.diagnosis.instrument.diagnose import diagnose_captures
from processing.diagnosis.search.result import Diagnosis
from processing.instrument.model import InstrumentModel
from processing.storage.captures.schema import Sample
from simulators.blind import undeclared_captures as blind

RAW, ELECTRONS, READ, GAIN, BLACK = 96, 60_000.0, 2.3, 4.0, 100
ANGLES = {"psa": np.arange(0, 180, 22.5)}


def curved_light(rim: float) -> np.ndarray:
    """(4, rows, columns) Stokes vectors of a small ball: brightness and polarization change over a few pixels.

    Beyond the rim, in radii of its light, it is dark.
    """
    y, x = (np.indices((RAW, RAW)) - (RAW - 1) / 2) / (RAW / 2.5)
    radius, around = np.hypot(x, y), np.arctan2(y, x)
    s0, degree = 0.02 + np.exp(-(radius**2)), 0.4 * radius**2 / (1 + radius**2)
    s0 = np.where(radius < rim, s0, 0.02)
    return np.stack([s0, s0 * degree * np.cos(2 * around), s0 * degree * np.sin(2 * around), 0.1 * s0 * x])


@pytest.fixture
def diagnosed(synthetic_capture, configs):
    """What `diagnose` says of a capture of the curved light by a camera whose channel at 45 degrees has some gain."""
    model = InstrumentModel.load(configs / "instruments/polarization_camera_retarder.yaml")

    def diagnose(gain: float, rim: float = np.inf) -> Diagnosis:
        random, light = np.random.default_rng(5), curved_light(rim)
        analyzers = model.analyzer_states(ANGLES) * np.array([1, gain, 1, 1])[:, None]
        frames = np.empty((len(ANGLES["psa"]), 1, RAW, RAW))
        for k, channel in enumerate(model.channels):
            (r, c), *_ = np.argwhere(np.array(model.mosaic) == channel.name)
            pixels = (slice(None), slice(r, None, 2), slice(c, None, 2))
            frames[:, 0, *pixels[1:]] = np.einsum("ns,syx->nyx", analyzers[:, k], light[pixels])
        electrons = random.poisson(ELECTRONS * frames) + random.normal(0, READ, frames.shape)
        detector = {"gain_e_per_count": GAIN, "read_noise_e": READ, "black_level_counts": BLACK, "bits": 16}
        path = synthetic_capture(
            np.round(electrons / GAIN + BLACK).astype(np.uint16), ANGLES, mosaic=model.mosaic, detector=detector
        )
        return diagnose_captures([path], model)[0].diagnosis

    return diagnose


def test_places_apart_are_no_fault(diagnosed):
    assert diagnosed(1.0, 1.0).verdict == "consistent"


@pytest.mark.long
def test_a_fault_beside_them_is_found(diagnosed):
    diagnosis = diagnosed(1.01)
    assert diagnosis.verdict == "explained"
    (gain,) = diagnosis.effects
    assert gain.kind == "channel_gain"
    estimate = gain.parameters["channel_45"]
    assert estimate.value == pytest.approx(0.01, abs=4 * estimate.stderr)
    assert estimate.stderr < 3e-4


class SmoothScene(blind.TrueScene):
    """The same materials, twice as far apart."""

    def at(self, x, y, levels=None):
        return super().at(0.45 * x, 0.45 * y, levels)


@pytest.mark.parametrize(
    "seed",
    [
        # With a wide prior of the levels of the source: the less light, the less evidence each of them costs.
        pytest.param(502_003, id="less light"),
        # With the model linearized about levels that are noise: the more light, the smaller they are.
        pytest.param(500_055, id="more light"),
        # With a search that begins at levels that are noise.
        pytest.param(500_017, id="begin"),
    ],
)
def test_dim_light_is_not_taken_for_an_offset(configs, tmp_path, seed):
    """A disc of 50 to 70 counts of 65,535: the offset of typical size is as large."""
    file, random = configs / "instruments/mosaic_polarimeter.yaml", np.random.default_rng(divmod(seed, 1000))
    electrons, counts = (np.exp(random.uniform(*np.log(limits))) for limits in ((5e3, 5e4), (40, 160)))
    radius, states = random.uniform(20, 40), int(random.integers(8, 25))
    side = 2 * int(np.ceil(1.2 * radius)) + 8
    model = InstrumentModel.load(file)
    bench = blind.declared_bench(model.nominal_at(662.0), 662.0, side, True, electrons=electrons)
    bench.gain, bench.full_well = electrons / counts, 1e9
    bench.read_noise = random.uniform(0.2, 2) * bench.gain
    disc = np.hypot(*(np.indices((side, side)) - (side - 1) / 2)) < radius
    bench.light.append(lambda state, light: light * disc)
    scene = SmoothScene(random, None, random.uniform(0, 0.8))
    psg = {"psg": blind.state_angles(states, True, False)["psg"]}
    frames, path = blind.digitize(bench, blind.expose(bench, scene, psg), random), tmp_path / "dim.h5"
    blind.write_capture(path, bench, frames, psg, sample=Sample(), instrument=file.read_text())
    diagnosis = diagnose_captures([path], model)[0].diagnosis
    assert diagnosis.verdict == "consistent"
    assert not diagnosis.effects
