"""The retardance of the generator's retarder differs from the model.

Cause: temperature (about 0.1 degree a kelvin for thick quartz), a wavelength that is not the nominal one, tilt, a
catalogue value instead of a calibrated one. An unknown sample hides it.
Mend: calibrate on air (`process calibrate`) at the temperature of the measurement; check the source's wavelength.
"""

from processing.instrument.effects._retarder import Retardance


class PsgRetardance(Retardance):
    """Retardance error in degrees."""

    train = "generator"
