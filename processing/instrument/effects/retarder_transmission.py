"""A retarder's transmission changes as it turns, once and twice per turn.

Cause: once: dirt, a wedge or an edge that clips the beam, off the axis of rotation. Twice: tilt together with
polarized light on the plate, or a polarization-dependent reflection.
Mend: clean and centre the plate, open the stop, set it normal to the axis; then divide by a turn without polarizers.
"""

from processing.instrument.effects._transmission import Transmission
from processing.instrument.model import Retarder


class RetarderTransmission(Transmission):
    """Transmission of a turning retarder."""

    element = Retarder
