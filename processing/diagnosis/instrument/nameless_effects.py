"""What no effect of the list is and may look like one: waves of a turning plate, a sample that turns, a lag, a jump.

A plate that is tilted in its mount has a retardance that changes twice a turn; bearings and windings make three or four
periods of it. With an unknown sample such a wave may look like something else (a transmission twice a turn, in the
light of a depolarizing sphere), and to the noise: then nothing in the data tells which of the two it is. A sample whose
stage drifts about the line of sight has an azimuth that drifts with it, which angles of single states can describe; so
can they a detector that reads a part of each frame with the next one, to first order an error of all angles.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from processing.arrays import Array
from processing.diagnosis.search.rules import LEAST_TURN_DEG
from processing.effect import Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import LevelEffect, OfOneCapture, OpticsEffect, moving_axes
from processing.instrument.model import InstrumentModel, Retarder

#: [periods a turn, fixed] That no effect of the list has, of what a turning plate does.
PERIODS = {"retardance": (2, 3, 4), "azimuth": (3, 4), "transmission": (3, 4)}
#: [degree] Size of such a wave of a retardance or an azimuth; what it explains does not depend on this.
WAVE_DEG = 0.5
#: [1] Size of such a wave of a transmission; what it explains does not depend on this.
WAVE_SHARE = 0.01
#: [degree] Size of the turn of a sample; what it explains does not depend on this.
TURN_DEG = 0.5
#: [1] Size of a lag; what it explains does not depend on this.
LAG_SHARE = 0.005
#: [1] Size of a jump; what it explains does not depend on this.
JUMP_SHARE = 0.01
#: [sizes] To either side that all of them may have; nothing is fitted that far.
REACH = 20.0


def _about_zero(name: str, unit: str, size: float) -> Parameter:
    return Parameter(name, unit, -REACH * size, REACH * size, size)


class WaveOfAPlate(OpticsEffect):
    """A wave of so many periods a turn of a retarder: in degrees, or relative transmission."""

    def __init__(self, what: str, periods: int) -> None:
        self.what, self.periods = what, periods
        self.kind = f"{what}_{periods}_a_turn"

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        """Retarders that turn by more than half a turn: over less a wave is hardly anything but a slope."""
        axes = moving_axes(model, conditions)
        plates = (e for e in model.elements() if isinstance(e, Retarder) and e.axis in axes)
        return tuple(e.name for e in plates if np.ptp(e.ratio * conditions.angles_deg[e.axis or ""]) > LEAST_TURN_DEG)

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        """Cosine and sine."""
        unit, size = ("1", WAVE_SHARE) if self.what == "transmission" else ("degree", WAVE_DEG)
        return tuple(_about_zero(n, unit, size) for n in ("cos", "sin"))

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        """Add the wave to what the plate does."""
        plate = next(e for e in model.elements() if e.name == place)
        t = self.periods * np.deg2rad(plate.ratio * changes.conditions.angles_deg[plate.axis or ""])
        wave = values[0] * np.cos(t) + values[1] * np.sin(t)
        if self.what == "transmission":
            changes.gain = changes.gain * (1 + wave)[:, None]
        else:
            target = changes.retardance_rad if self.what == "retardance" else changes.azimuth_rad
            target[place] = target[place] + np.deg2rad(wave)


class TurningSample(OpticsEffect, OfOneCapture):
    """The sample turns evenly about the line of sight; seen from it, everything else turns: degrees in all."""

    kind = "turning_sample"

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        """The one sample."""
        return ("",)

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        """From the first state to the last."""
        return (_about_zero("turn", "degree", TURN_DEG),)

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        """Turn every element."""
        for element in model.elements():
            turned = np.deg2rad(values[0]) * changes.conditions.elapsed
            changes.azimuth_rad[element.name] = changes.azimuth_rad[element.name] + turned


class ImageLag(OpticsEffect):
    """A share of the charge of a state is read with the next one."""

    kind = "image_lag"

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        """The one detector."""
        return ("",)

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        """The share."""
        return (_about_zero("share", "1", LAG_SHARE),)

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        """Read it with the next one."""
        changes.lag += float(values[0])


class JumpOfTheSource(LevelEffect, OfOneCapture):
    """A lamp whose arc jumps before one of the states, which is the place, and stays there: a share of its light."""

    kind = "jump"

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        """All states but the first ones of runs: between these the list has a jump."""
        return tuple(str(k) for k in np.flatnonzero(np.diff(conditions.run) == 0) + 1)

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        """The share."""
        return (_about_zero("share", "1", JUMP_SHARE),)

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        """Another level from that state on."""
        later = np.arange(changes.conditions.states) >= int(place)
        changes.gain = changes.gain * (1 + values[0] * later)[:, None]
