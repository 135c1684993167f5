"""The fast axis of the generator's retarder differs from the model.

Cause: the mount's zero moved (homed anew, belt or set screw slipped between sessions), the element was taken out.
Mend: home the axis, then calibrate its zero on air; mark the element's orientation in its cell.
"""

from processing.instrument.effects._retarder import Azimuth


class PsgAzimuth(Azimuth):
    """Azimuth error in degrees."""

    train = "generator"
