"""Numbers of another lab that are probably not in the units that are asked for: nothing later would notice."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from processing.storage.state_csv import StatesFile

#: An axis whose angles lie in a range of 2 pi or less, in steps of less than this, was hardly meant in degrees.
STEP_DEG = 1.0
#: No polarimeter of plates and polarizers works outside these wavelengths, far ultraviolet to terahertz.
WAVELENGTHS_NM = (100.0, 3e6)


def doubtful_units(states: StatesFile, wavelength_nm: float) -> Iterator[str]:
    """Say which axes look as if they were in radians, and whether the wavelength is hardly in nm."""
    for name, angles in states.angles_deg.items():
        known = np.unique(angles[np.isfinite(angles)])
        if known.size > 2 and known[-1] - known[0] <= 2 * np.pi and np.diff(known).max() < STEP_DEG:
            yield (
                f"axis {name} turns by {known[-1] - known[0]:.3g} degrees in all. Are its angles in radians? "
                f"{states.path.name} gives degrees"
            )
    low, high = WAVELENGTHS_NM
    if not low <= wavelength_nm <= high:
        yield f"a wavelength of {wavelength_nm:g} nm. Is it in another unit?"
