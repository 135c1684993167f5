"""What a diagnosis leaves uncertain shows in the error bars of `process reduce`, apart from the noise."""

import h5py
import numpy as np
import pytest
from bench_capture import bench_capture

from processing.diagnosis.instrument.diagnose import diagnose_captures
from processing.diagnosis.instrument_file import write_instrument
from processing.instrument.model import AppliedEffect, EffectParameter, InstrumentModel, SystematicError
from processing.reduction.mueller import reduce_mueller
from processing.reduction.stokes import reduce_stokes
from processing.reduction.systematic import Systematic
from processing.storage.captures.capture import Capture
from processing.storage.products.product import Product, Step
from processing.yaml_file import dump_yaml
from simulators.blind.undeclared_captures import TrueBench


def uncertain(kind: str, element: str | None, **values: float) -> SystematicError:
    parameters = {name: EffectParameter(value=value, unit="degree") for name, value in values.items()}
    effect = AppliedEffect(kind=kind, element=element, parameters=parameters)
    return SystematicError(directions=((effect,),), rms_over_m00=0.01, wavelength_nm=662.0)


@pytest.fixture
def air(configs, tmp_path):
    """Air through a generator retarder of 1 degree more than declared."""
    bench = TrueBench(rows=16, columns=16, dg=np.deg2rad(128.12))
    return bench_capture(tmp_path, configs / "instruments/rgb950.yaml", bench, air=True, seed=2)


def reduced(air, model, out):
    with Capture(air) as capture:
        reduce_mueller(capture, model.at(662), out, (Step("reduce", {}),))
    nodes = {}
    with h5py.File(out) as h5:
        h5.visititems(lambda name, node: nodes.__setitem__(name.rpartition("/")[2], node))
        return {name: node[...] for name, node in nodes.items() if name.startswith("mueller")}


def test_the_error_is_what_one_standard_deviation_does(air, configs, tmp_path):
    model = InstrumentModel.load(configs / "instruments/rgb950.yaml")
    exact = reduced(air, model, tmp_path / "plain.h5")
    assert "mueller_systematic" not in exact
    open_end = model.model_copy(update={"systematic": (uncertain("psg_retardance", "psg_retarder", retardance=1.0),)})
    product = reduced(air, open_end, tmp_path / "open.h5")
    # One degree is what is wrong here, so error and standard error are alike.
    m, error = (product[name].mean(axis=(2, 3)) for name in ("mueller", "mueller_systematic"))
    wrong = np.abs(m / m[0, 0] - np.eye(4))
    assert error[0, 0] == 0
    assert error / m[0, 0] == pytest.approx(wrong, abs=0.002)
    assert wrong.max() > 0.01


@pytest.mark.parametrize(
    ("calibrate", "lasting", "is_corrected_later"),
    [
        # The next sample of `test_instrument_chain.py` says the same.
        pytest.param((), True, True, marks=pytest.mark.long),
        ((), False, False),
        pytest.param(("psg_retarder.retardance_deg",), False, True, marks=pytest.mark.long),
    ],
)
def test_what_is_not_corrected_in_a_later_capture_is_in_its_error_bar(
    calibrate, lasting, is_corrected_later, air, configs, tmp_path, monkeypatch
):
    """It was in none: M of the next capture was wrong by 35 of them. Fitted values of the train count there too."""
    file = configs / "instruments/rgb950.yaml"
    declared = InstrumentModel.load(file).model_copy(update={"calibrate": calibrate})
    monkeypatch.setattr("processing.diagnosis.instrument.diagnose.lasts", lambda *_: lasting)
    judged, _ = diagnose_captures([air], declared)
    write_instrument(tmp_path / "new.yaml", declared, judged.diagnosis)
    corrected = InstrumentModel.load(tmp_path / "new.yaml")
    bench = TrueBench(rows=16, columns=16, dg=np.deg2rad(128.12))
    later = bench_capture(tmp_path / "next", file, bench, air=True, seed=3).rename(tmp_path / "later.h5")
    for path, is_corrected in ((air, True), (later, is_corrected_later)):
        product = reduced(path, corrected, path.with_suffix(".m.h5"))
        m, error = (product[name].mean(axis=(2, 3)) for name in ("mueller", "mueller_systematic"))
        wrong, error = np.abs(m / m[0, 0] - np.eye(4)).max(), error.max() / m[0, 0]
        assert wrong < 0.002 if is_corrected else wrong > 0.01
        assert error == pytest.approx(0.0 if is_corrected else wrong, abs=0.002)


def test_two_directions_add_in_squares_and_other_wavelengths_have_none(air, configs, tmp_path):
    model = InstrumentModel.load(configs / "instruments/rgb950.yaml")
    first = uncertain("psg_retardance", "psg_retarder", retardance=1.0)
    second = uncertain("psa_azimuth", "psa_retarder", azimuth=0.5)
    first_error, second_error, total = (
        reduced(air, model.model_copy(update={"systematic": s}), tmp_path / f"{k}.h5")["mueller_systematic"]
        for k, s in enumerate(((first,), (second,), (first, second)))
    )
    assert total == pytest.approx(np.hypot(first_error, second_error), rel=1e-4, abs=1e-3)
    assert model.model_copy(update={"systematic": (first,)}).at(451).systematic == ()


#: An instrument, angles of its axes, and a value of its train that is uncertain by so much.
PARTIAL = {
    "rotating_retarder_stokes": ({"psa": 22.5 * np.arange(16)}, ("psa_retarder.azimuth_deg", 0.4), "mueller"),
    "rotating_analyzer": ({"psa": 30.0 * np.arange(6)}, ("analyzer.azimuth_deg", 0.5), "mueller"),
    "linear_mueller": (
        {"psg": np.repeat([0.0, 60, 120, 20], 4), "psa": np.tile([0.0, 60, 120, 100], 4)},
        ("analyzer.azimuth_deg", 0.5),
        "mueller",
    ),
    "mosaic_polarimeter": ({"psg": 22.5 * np.arange(8)}, ("psg_retarder.azimuth_deg", 0.5), "mueller"),
    "polarization_camera_retarder": ({"psa": 20.0 * np.arange(9)}, ("psa_retarder.azimuth_deg", 0.4), "mueller"),
    "linear_stokes": ({}, ("micropolarizer_45.azimuth_deg", 0.5), "stokes"),
}
SAMPLE = np.array([[1, 0.2, -0.1, 0.05], [0.15, 0.6, 0.1, -0.2], [-0.3, 0.05, 0.5, 0.1], [0.2, 0.1, -0.15, 0.4]])


def product_of(synthetic_capture, tmp_path, signal, angles, model, name):
    """Every dataset of the product of a capture without noise, of signals (states, channels)."""
    states = len(signal)
    mosaic = None
    if model.mosaic is not None:
        where = {channel: (r, c) for r, line in enumerate(model.mosaic) for c, channel in enumerate(line)}
        frames = np.zeros((states, 1, 8, 8), np.float32)
        for k, channel in enumerate(c.name for c in model.channels):
            r, c = where[channel]
            frames[:, 0, r::2, c::2] = signal[:, k, None, None]
        mosaic = model.mosaic
    else:
        frames = np.broadcast_to(signal[..., None, None], (*signal.shape, 4, 4)).astype(np.float32)
    path = synthetic_capture(frames, angles, title=name, mosaic=mosaic, instrument_yaml=dump_yaml(model))
    out = tmp_path / f"{name}.h5"
    with Capture(path, by_super_pixel=bool(angles)) as capture:
        reduce = reduce_mueller if angles or mosaic is None else reduce_stokes
        reduce(capture, model, out, (Step("reduce", {}),))
    nodes = {}
    with h5py.File(out) as h5:
        h5.visititems(lambda key, node: nodes.__setitem__(key.rpartition("/")[2], node))
        return {key: node[...] for key, node in nodes.items() if isinstance(node, h5py.Dataset)}


@pytest.mark.parametrize("instrument", PARTIAL)
def test_a_nominal_value_that_is_open_shows_in_whatever_the_instrument_determines(
    instrument, configs, synthetic_capture, tmp_path
):
    """One standard deviation of a value that `calibrate` lists moves the product by one systematic standard error."""
    angles, (value, error), kind = PARTIAL[instrument]
    model = InstrumentModel.load(configs / f"instruments/{instrument}.yaml").at(662)
    off = model.with_values({value.split(".")[0]: {value.split(".")[1]: model.value_of(value) + error}})
    states = max([np.size(v) for v in angles.values()], default=1)
    signal = off.rows(angles or {"": np.zeros(states)}) @ SAMPLE.reshape(16) * 1000
    open_end = model.model_copy(update={"systematic": (uncertain("calibrate", value, value=error),)})
    product = product_of(synthetic_capture, tmp_path, signal, angles, open_end, "nominal")
    exact = product_of(synthetic_capture, tmp_path, signal, angles, off, "exact")
    if kind == "stokes":
        for name in ("s1", "s2"):
            moved = np.abs(product[name] / product["s0"] - exact[name] / exact["s0"]).mean()
            assert (product[f"{name}_systematic"] / product["s0"]).mean() == pytest.approx(moved, abs=3e-4)
        for name, unit in (("dolp", 1.0), ("aolp_deg", 60.0)):
            moved = np.abs(product[name] - exact[name]).mean()
            assert product[f"{name}_systematic"].mean() == pytest.approx(moved, abs=3e-4 * unit, rel=0.03)
        return
    is_determined = np.isfinite(product["mueller"]).all(axis=(2, 3))
    assert np.array_equal(np.isfinite(product["mueller_systematic"]).all(axis=(2, 3)), is_determined)
    moved = np.abs(product["mueller"] / product["mueller"][0, 0] - exact["mueller"] / exact["mueller"][0, 0])[
        is_determined
    ]
    errors = (product["mueller_systematic"] / product["mueller"][0, 0])[is_determined]
    assert moved.max() > 0.003
    assert errors == pytest.approx(moved, abs=3e-4)


def test_a_product_holds_the_directions_that_its_errors_are_made_of(air, configs, tmp_path):
    """Also those that bend the counts: what is read back moves M as the reduction did."""
    bent = uncertain("detector_nonlinearity", None, lost_at_full_scale=0.02)
    turned = uncertain("psg_retardance", "psg_retarder", retardance=0.3)
    error = bent.model_copy(update={"directions": (*bent.directions, *turned.directions)})
    model = InstrumentModel.load(configs / "instruments/rgb950.yaml").model_copy(update={"systematic": (error,)})
    stored = reduced(air, model, tmp_path / "m.h5")
    with Product(tmp_path / "m.h5") as product:
        systematic = Systematic.of_product(product)
        names = ("detector_nonlinearity", "psg_retardance psg_retarder")
        assert systematic.labels == tuple(f"{name} ({model.at(662).identity})" for name in names)
        values = product.get("mueller").reshape(16, -1)
    moves = list(systematic.moves(values))
    assert np.abs(moves[0]).max() > 0.001 * values[0].mean()
    errors = systematic.errors(values).reshape(stored["mueller_systematic"].shape)
    assert errors == pytest.approx(stored["mueller_systematic"], rel=1e-3, abs=1e-3)
