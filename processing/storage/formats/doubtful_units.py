"""Refuse numbers of another lab that are probably in another unit: no later step would notice."""

from __future__ import annotations

import numpy as np

from processing.storage.formats.foreign_arrays import ImportFailed
from processing.storage.formats.state_csv import StatesFile

#: An axis whose angles lie in a range of 2 pi or less, in steps below this, is hardly in degrees.
STEP_DEG = 1.0
#: No polarimeter of plates and polarizers works outside these wavelengths, far ultraviolet to terahertz.
WAVELENGTHS_NM = (100.0, 3e6)
#: Nanometres in other units of length.
_UNITS = {"micrometres": 1e3, "metres": 1e9, "angstrom": 0.1}


def require_degrees(states: StatesFile) -> None:
    """Raise ImportFailed where the angles of an axis are probably in radians."""
    for name, angles in states.angles_deg.items():
        known = np.unique(angles[np.isfinite(angles)])
        if known.size > 2 and known[-1] - known[0] <= 2 * np.pi and np.diff(known).max() < STEP_DEG:
            raise ImportFailed(
                f"{states.path}: axis {name} turns by {known[-1] - known[0]:.3g} degrees in all, in steps below "
                f"{STEP_DEG:g}. These angles are probably in radians. Add --angles radians, or --angles degrees"
            )


def require_nm(wavelength_nm: float) -> None:
    """Raise ImportFailed where a wavelength is probably in another unit than nanometres."""
    low, high = WAVELENGTHS_NM
    if low <= wavelength_nm <= high:
        return
    readings = [
        f"in {unit} it is --wavelength-nm {wavelength_nm * nm:g}"
        for unit, nm in _UNITS.items()
        if low <= wavelength_nm * nm <= high
    ]
    hint = "; ".join(readings) or "give nanometres"
    raise ImportFailed(f"--wavelength-nm {wavelength_nm:g}: outside {low:g} to {high:g} nm; {hint}")
