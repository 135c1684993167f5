"""Requirements of every effect: no change at zero, sensible bounds and units, a right derivative, a cause."""

import sys
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from processing.diagnosis.captures.capture_data import CaptureData
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.space import Space
from processing.effect import Effect, Parameter
from processing.instrument.applied_effects import instrument_effects
from processing.instrument.changes import Changes, Conditions
from processing.instrument.model import InstrumentModel
from processing.reflectance.changes import ReflectanceChanges
from processing.reflectance.effects.base import ReflectanceEffect, reflectance_effects
from simulators.conformance.reflectance import random_geometry

UNITS = ("1", "degree", "pixel", "count")


class EffectConformance:
    """Tests of an effect of the instrument.

    Attributes
    ----------
    effect : its kind.
    instrument : instrument file in which it has a place.
    wavelength_nm : one at which that instrument is given.
    """

    effect: ClassVar[str] = ""
    instrument: ClassVar[Path]
    wavelength_nm: ClassVar[float] = 662.0

    @pytest.fixture
    def kind(self) -> str:
        """The effect's kind; a class for several kinds overrides this by a fixture with parameters."""
        return self.effect

    @pytest.fixture
    def case(self, kind: str) -> tuple[InstrumentModel, CaptureData]:
        """An instrument with a place for the effect, and a small noisy capture of it."""
        return small_capture(InstrumentModel.load(self.instrument).at(self.wavelength_nm))

    def test_it_says_what_causes_and_what_mends_it(self, kind: str) -> None:
        require_cause(instrument_effects()[kind])

    def test_it_does_nothing_at_zero_and_has_bounds_around_it(
        self, kind: str, case: tuple[InstrumentModel, CaptureData]
    ) -> None:
        effect, (model, capture) = instrument_effects()[kind], case
        places = effect.places(model, capture.conditions)
        assert places, f"{kind} has no place in {model.name}"
        changes = Changes(capture.conditions)
        parameters = effect.parameters(model, capture.conditions, places[0])
        effect.apply(changes, model, places[0], np.zeros(len(parameters)))
        angles = capture.conditions.angles_deg
        assert model.rows(angles, changes) == pytest.approx(model.rows(angles), abs=1e-15)
        assert not any(np.any(v) for v in changes.response.values())
        assert not np.any(changes.shift_px)
        assert not changes.drop_clipped
        assert not any(np.any(v) for v in changes.field_retardance_rad.values())
        require_bounds(parameters)

    def test_its_derivative_is_the_slope_of_the_excess(
        self, kind: str, case: tuple[InstrumentModel, CaptureData]
    ) -> None:
        effect, (model, capture) = instrument_effects()[kind], case
        if effect.is_switch:
            # On or off: there is nothing to differentiate.
            return
        problem = InstrumentProblem(model, [capture])
        place = effect.places(model, capture.conditions)[-1]
        parameters = effect.parameters(model, capture.conditions, place)
        space = Space((Candidate(effect, place, parameters, 0 if effect.of_one_capture else None),))
        values = 0.3 * space.joined("typical") * np.random.default_rng(2).uniform(0.5, 1, space.size)
        gradient = 2 * problem.sums(space, values).gradient.sum(axis=0)
        for j in np.unique([0, space.size - 1]):
            step = np.zeros(space.size)
            step[j] = 1e-4 * space.joined("typical")[j]
            up, down = (problem.sums(space, values + s, derivatives=False).excess.sum() for s in (step, -step))
            slope = (up - down) / (2 * step[j])
            scale = abs(gradient).max() + 1.0 / space.joined("typical")[j]
            # The noise of second derivatives is left out of the slope of image shifts (a share of a percent).
            assert gradient[j] == pytest.approx(slope, abs=0.02 * scale)


class ReflectanceEffectConformance:
    """Tests of an effect of the reflectance; set `effect` to its kind."""

    effect: ClassVar[str] = ""

    @pytest.fixture
    def kind(self) -> str:
        """The effect's kind; a class for several kinds overrides this by a fixture with parameters."""
        return self.effect

    def test_it_says_what_causes_and_what_mends_it(self, kind: str) -> None:
        require_cause(reflectance_effects()[kind])

    def test_it_does_nothing_at_zero_and_something_elsewhere(self, kind: str) -> None:
        effect: ReflectanceEffect = reflectance_effects()[kind]
        geometry, index = random_geometry(300), 1.3 + 0.08j
        # With diffuse reflection, since registration acts through theta_h, which the first surface does not know.
        changes = ReflectanceChanges(diffuse_a=0.5)
        plain = changes.dominant(geometry, index)
        parameters = effect.parameters("")
        effect.bend(changes, "", np.zeros(len(parameters)))
        assert changes.dominant(geometry, index) == pytest.approx(plain, abs=1e-12)
        effect.bend(changes, "", np.array([p.typical for p in parameters]))
        assert np.abs(changes.dominant(geometry, index) - plain).max() > 1e-3
        require_bounds(parameters)


def require_cause(effect: Effect) -> None:
    """Assert that the docstring of the effect's file says what causes and what mends it."""
    text = sys.modules[type(effect).__module__].__doc__ or ""
    assert "Cause" in text
    assert "Mend" in text


def require_bounds(parameters: tuple[Parameter, ...]) -> None:
    """Assert that zero and the typical size lie inside the bounds, in a unit that reports know."""
    for p in parameters:
        assert p.lower <= 0 < p.upper
        assert 0 < p.typical <= p.upper
        assert p.unit in UNITS


def small_capture(model: InstrumentModel) -> tuple[InstrumentModel, CaptureData]:
    """24 states of two runs, 12 x 12 noisy pixels of a matrix near the identity; states come from both sides."""
    random = np.random.default_rng(1)
    n = 24
    angles = {axis: np.sort(random.uniform(0, 360, n))[np.arange(n) ^ 1] for axis in model.axes}
    names, when = tuple(c.name for c in model.channels), np.linspace(-0.5, 0.5, n)
    conditions = Conditions(angles, n, names, when, 4000.0, np.arange(n) // 12)
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
