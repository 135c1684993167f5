"""The generator's polarizer leaks: its extinction (T_min over T_max) is larger than the model's.

Cause: a film polarizer outside its band, an uncoated or dirty prism, a beam wider than the acceptance angle.
An unknown sample hides it.
Mend: measure the polarizer between crossed partners at this wavelength; use a crystal polarizer.
"""

from processing.instrument.effects._extinction import Extinction


class PsgExtinction(Extinction):
    """Extinction error, a ratio of intensities."""

    train = "generator"
