"""Every effect of the folder: nothing at zero, units and bounds that make sense, a derivative that is one, a cause."""

import numpy as np
import pytest

from processing.effect import EffectError
from processing.instrument.applied_effects import apply_to, changes_at, changes_of, instrument_effects
from processing.instrument.changes import Changes
from processing.instrument.model import AppliedEffect, EffectParameter, InstrumentModel
from processing.reflectance.effects.base import reflectance_effects
from simulators.conformance import EffectConformance, ReflectanceEffectConformance
from simulators.conformance.effect import small_capture

INSTRUMENT_KINDS = list(instrument_effects())
REFLECTANCE_KINDS = list(reflectance_effects())


#: Instruments that have a place for every effect between them; the first that has one is taken.
INSTRUMENTS = (("rgb950", 662), ("mosaic_polarimeter", 662), ("drr_imaging_630nm", 630))


class TestEveryEffectOfTheInstrument(EffectConformance):
    @pytest.fixture(params=INSTRUMENT_KINDS)
    def kind(self, request):
        return request.param

    @pytest.fixture
    def case(self, kind, configs):
        for file, wavelength_nm in INSTRUMENTS:
            model, capture = small_capture(InstrumentModel.load(configs / f"instruments/{file}.yaml").at(wavelength_nm))
            if instrument_effects()[kind].places(model, capture.conditions):
                break
        return model, capture


class TestEveryEffectOfTheReflectance(ReflectanceEffectConformance):
    @pytest.fixture(params=REFLECTANCE_KINDS)
    def kind(self, request):
        return request.param


def test_an_effect_of_one_capture_holds_for_that_capture_only(configs):
    model, capture = small_capture(InstrumentModel.load(configs / "instruments/rgb950.yaml").at(662))
    drift = AppliedEffect(
        kind="source_drift",
        scope="capture",
        captures=("one",),
        parameters={n: EffectParameter(value=v, unit="1") for n, v in (("fraction", 0.1), ("curvature", 0.0))},
    )
    changed = model.model_copy(update={"effects": (drift,)})
    assert np.ptp(changes_of(changed, capture.conditions, "one").gain) == pytest.approx(0.1)
    assert np.ptp(changes_of(changed, capture.conditions, "another").gain) == 0
    angles = capture.conditions.angles_deg
    assert changed.rows(angles, changes_at(changed, angles)) == pytest.approx(model.rows(angles))


def test_rows_of_an_instrument_with_effects_need_their_changes(configs):
    model, capture = small_capture(InstrumentModel.load(configs / "instruments/rgb950.yaml").at(662))
    turned = AppliedEffect(
        kind="psg_azimuth", element="psg_retarder", parameters={"azimuth": EffectParameter(value=1.0, unit="degree")}
    )
    changed = model.model_copy(update={"effects": (turned,)})
    angles = capture.conditions.angles_deg
    with pytest.raises(ValueError, match="has effects"):
        changed.rows(angles)
    assert np.abs(changed.rows(angles, changes_at(changed, angles)) - model.rows(angles)).max() > 1e-3


@pytest.mark.parametrize(("kind", "element"), [("gremlin", None), ("psg_azimuth", "lens"), ("psg_azimuth", None)])
def test_unknown_effects_are_refused(kind, element, configs):
    model, capture = small_capture(InstrumentModel.load(configs / "instruments/rgb950.yaml").at(662))
    with pytest.raises(EffectError):
        apply_to(Changes(capture.conditions), model, AppliedEffect(kind=kind, element=element, parameters={}))
