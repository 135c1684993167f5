"""Every effect of the folder: nothing at zero, units and bounds that make sense, a derivative that is one, a cause."""

import sys
from pathlib import Path

import numpy as np
import pytest

from processing.diagnosis.captured.capture_data import CaptureData
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.space import Space
from processing.effect import EffectError
from processing.instrument.applied_effects import apply_to, changes_at, changes_of, instrument_effects
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import OfOneCapture, Switch
from processing.instrument.model import AppliedEffect, EffectParameter, InstrumentModel
from processing.reflectance.changes import ReflectanceChanges
from processing.reflectance.effects.base import reflectance_effects

INSTRUMENT_KINDS = list(instrument_effects())
REFLECTANCE_KINDS = list(reflectance_effects())


@pytest.mark.parametrize(
    "effect", [*instrument_effects().values(), *reflectance_effects().values()], ids=lambda e: e.kind
)
def test_says_what_causes_and_what_mends_it(effect):
    text = sys.modules[type(effect).__module__].__doc__ or ""
    assert "Cause" in text
    assert "Mend" in text


#: Instruments that have a place for every effect between them; the first that has one is taken.
INSTRUMENTS = (("rgb950", 662), ("mosaic_polarimeter", 662), ("drr_imaging_630nm", 630))


def data(configs: Path, kind: str) -> tuple[InstrumentModel, CaptureData]:
    """A small noisy capture of an instrument in which the effect has a place; states come from both sides."""
    effect = instrument_effects()[kind]
    for file, wavelength_nm in INSTRUMENTS:
        model, capture = noisy(InstrumentModel.load(configs / f"instruments/{file}.yaml").at(wavelength_nm))
        if effect.places(model, capture.conditions):
            break
    return model, capture


def noisy(model: InstrumentModel) -> tuple[InstrumentModel, CaptureData]:
    random = np.random.default_rng(1)
    n = 24
    angles = {axis: np.sort(random.uniform(0, 360, n))[np.arange(n) ^ 1] for axis in model.axes}
    conditions = Conditions(angles, n, tuple(c.name for c in model.channels), np.linspace(-0.5, 0.5, n), 4000.0)
    m = np.eye(4).reshape(16) + 0.1 * random.normal(size=(144, 16))
    signal = np.einsum("ncj,pj->ncp", model.rows(angles), m).reshape(n, -1, 12, 12) + 0.2
    signal += 0.003 * random.normal(size=signal.shape)
    clipped = np.zeros((12, 12), dtype=bool)
    clipped[4, 4] = True
    capture = CaptureData(
        name="test",
        signal=signal.astype(np.float32),
        conditions=conditions,
        exposure=np.ones(n),
        sample=np.eye(4).reshape(16),
        slope=np.full(n, 1e-5),
        floor=np.full(n, 1e-6),
        noise_known=True,
        noise_source="",
        clipped=clipped,
        clipped_states=np.arange(n) == 3,
        usable=np.ones((12, 12), dtype=bool),
        simulated=True,
        wavelength_nm=662.0,
    )
    return model, capture


@pytest.mark.parametrize("kind", INSTRUMENT_KINDS)
def test_identity_at_zero_and_bounds(kind, configs):
    effect = instrument_effects()[kind]
    model, capture = data(configs, kind)
    places = effect.places(model, capture.conditions)
    assert places
    changes = Changes(capture.conditions)
    parameters = effect.parameters(model, capture.conditions, places[0])
    effect.apply(changes, model, places[0], np.zeros(len(parameters)))
    assert model.rows(capture.conditions.angles_deg, changes) == pytest.approx(
        model.rows(capture.conditions.angles_deg), abs=1e-15
    )
    assert not any(np.any(v) for v in changes.response.values())
    assert not np.any(changes.shift_px)
    assert not changes.drop_clipped
    assert not any(np.any(v) for v in changes.field_retardance_rad.values())
    for p in parameters:
        assert p.lower <= 0 < p.upper
        assert 0 < p.typical <= p.upper
        assert p.unit in ("1", "degree", "pixel", "count")


@pytest.mark.parametrize("kind", [k for k in INSTRUMENT_KINDS if not isinstance(instrument_effects()[k], Switch)])
def test_derivative_is_the_slope_of_the_excess(kind, configs):
    model, capture = data(configs, kind)
    problem = InstrumentProblem(model, [capture])
    effect = instrument_effects()[kind]
    place = effect.places(model, capture.conditions)[-1]
    parameters = effect.parameters(model, capture.conditions, place)
    space = Space((Candidate(effect, place, parameters, 0 if isinstance(effect, OfOneCapture) else None),))
    at = 0.3 * space.joined("typical") * np.random.default_rng(2).uniform(0.5, 1, space.size)
    gradient = 2 * problem.sums(space, at).gradient.sum(axis=0)
    for j in np.unique([0, space.size - 1]):
        step = np.zeros(space.size)
        step[j] = 1e-4 * space.joined("typical")[j]
        up, down = (problem.sums(space, at + s, derivatives=False).excess.sum() for s in (step, -step))
        slope = (up - down) / (2 * step[j])
        scale = abs(gradient).max() + 1.0 / space.joined("typical")[j]
        # The noise of second derivatives is left out of the slope of image shifts (a share of a percent).
        assert gradient[j] == pytest.approx(slope, abs=0.02 * scale)


@pytest.mark.parametrize("kind", REFLECTANCE_KINDS)
def test_reflectance_effects_do_nothing_at_zero_and_something_elsewhere(kind, configs):
    from simulators.bench.scene import Scene

    scene = Scene.load(configs / "scenes/red_sphere.yaml")
    geometry = scene.truth(35, 662, 24, 24).geometry.points
    effect = reflectance_effects()[kind]
    # With diffuse reflection, since registration acts through theta_h, which the first surface does not know.
    changes = ReflectanceChanges(diffuse_a=0.5)
    plain = changes.dominant(geometry, 1.3 + 0.08j)
    parameters = effect.parameters("")
    effect.bend(changes, "", np.zeros(len(parameters)))
    assert changes.dominant(geometry, 1.3 + 0.08j) == pytest.approx(plain, abs=1e-12)
    effect.bend(changes, "", np.array([p.typical for p in parameters]))
    assert np.abs(changes.dominant(geometry, 1.3 + 0.08j) - plain).max() > 1e-3


def test_an_effect_of_one_capture_holds_for_that_capture_only(configs):
    model, capture = noisy(InstrumentModel.load(configs / "instruments/rgb950.yaml").at(662))
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
    model, capture = noisy(InstrumentModel.load(configs / "instruments/rgb950.yaml").at(662))
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
    model, capture = noisy(InstrumentModel.load(configs / "instruments/rgb950.yaml").at(662))
    with pytest.raises(EffectError):
        apply_to(Changes(capture.conditions), model, AppliedEffect(kind=kind, element=element, parameters={}))
