"""Values of the train that an instrument file calls nominal (`calibrate`): which exist, and a shift of one of them."""

import numpy as np

from processing.instrument.changes import Changes
from processing.instrument.elements import number
from processing.instrument.model import InstrumentModel

#: Kind of such a shift among the effects of an instrument file; its element is "element.field" or "channel.gain".
KIND = "calibrate"
#: Fields that can be shifted: those of elements, and the gain of a channel.
FIELDS = ("azimuth_deg", "retardance_deg", "extinction", "diattenuation", "depolarization", "gain")


def shift_nominal(changes: Changes, model: InstrumentModel, name: str, value: float) -> None:
    """Add `value`, in the unit of the field, to the nominal value "element.field" or "channel.gain"."""
    place, _, field = name.rpartition(".")
    if field == "gain":
        channel = next(k for k, c in enumerate(model.channels) if c.name == place)
        changes.gain = changes.gain.copy()
        changes.gain[:, channel] *= 1 + value / number(model.channels[channel].gain)
        return
    shifted = getattr(changes, field.replace("_deg", "_rad"))
    shifted[place] = shifted[place] + (np.deg2rad(value) if field.endswith("_deg") else value)
