"""What a diagnosis leaves uncertain shows in the error bars of `process reduce`, apart from the noise."""

import h5py
import numpy as np
import pytest
from bench_capture import bench_capture

from processing.instrument.model import AppliedEffect, EffectParameter, InstrumentModel, SystematicError
from processing.reduction.mueller import reduce_mueller
from processing.storage.capture import Capture
from processing.storage.product import Step
from simulators.blind.undeclared_captures import Bench


def uncertain(kind: str, element: str | None, **values: float) -> SystematicError:
    parameters = {name: EffectParameter(value=value, unit="degree") for name, value in values.items()}
    effect = AppliedEffect(kind=kind, element=element, parameters=parameters)
    return SystematicError(directions=((effect,),), rms_over_m00=0.01, wavelength_nm=662.0)


@pytest.fixture
def air(configs, tmp_path):
    """Air through a generator retarder of 1 degree more than declared."""
    bench = Bench(rows=16, columns=16, dg=np.deg2rad(128.12))
    return bench_capture(tmp_path, configs / "instruments/rgb950.yaml", bench, air=True, seed=2)


def reduced(air, model, out):
    with Capture(air) as capture:
        reduce_mueller(capture, model.at(662), out, (Step("reduce", {}),))
    found = {}
    with h5py.File(out) as h5:
        h5.visititems(lambda name, node: found.__setitem__(name.rpartition("/")[2], node))
        return {name: node[...] for name, node in found.items() if name.startswith("mueller")}


def test_the_error_is_what_one_standard_deviation_does(air, configs, tmp_path):
    model = InstrumentModel.load(configs / "instruments/rgb950.yaml")
    known = reduced(air, model, tmp_path / "plain.h5")
    assert "mueller_systematic" not in known
    open_end = model.model_copy(update={"systematic": (uncertain("psg_retardance", "psg_retarder", retardance=1.0),)})
    found = reduced(air, open_end, tmp_path / "open.h5")
    # One degree is what is wrong here, so error and standard error are alike.
    m, error = (found[name].mean(axis=(2, 3)) for name in ("mueller", "mueller_systematic"))
    wrong = np.abs(m / m[0, 0] - np.eye(4))
    assert error[0, 0] == 0
    assert error / m[0, 0] == pytest.approx(wrong, abs=0.002)
    assert wrong.max() > 0.01


def test_two_directions_add_in_squares_and_other_wavelengths_have_none(air, configs, tmp_path):
    model = InstrumentModel.load(configs / "instruments/rgb950.yaml")
    first = uncertain("psg_retardance", "psg_retarder", retardance=1.0)
    second = uncertain("psa_azimuth", "psa_retarder", azimuth=0.5)
    one, two, both = (
        reduced(air, model.model_copy(update={"systematic": s}), tmp_path / f"{k}.h5")["mueller_systematic"]
        for k, s in enumerate(((first,), (second,), (first, second)))
    )
    assert both == pytest.approx(np.hypot(one, two), rel=1e-4, abs=1e-3)
    assert model.model_copy(update={"systematic": (first,)}).at(451).systematic == ()
