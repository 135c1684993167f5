"""Refuse numbers of another lab that are probably in another unit: no later step would notice."""

import re
from collections.abc import Mapping

import numpy as np

from processing.storage.formats.foreign_arrays import ImportFailed, stated_unit
from processing.storage.formats.state_csv import StatesFile

#: An axis whose angles are in steps below this, in degrees, over no more than 5 turns in radians is hardly in degrees.
STEP_DEG = 1.0
MOST_RAD = 10 * np.pi
#: No polarimeter of plates and polarizers works outside these wavelengths, far ultraviolet to terahertz.
WAVELENGTHS_NM = (100.0, 3e6)
#: No scan takes so many turns.
MOST_TURNS = 100
_STEPS = re.compile(r"(?<![a-z])(steps?|counts?|ticks|pulses|m(illi)?deg(rees?)?)(?![a-z])", re.IGNORECASE)
_RADIANS = re.compile(r"(?<![a-z])rad(ians?)?(?![a-z])", re.IGNORECASE)
_MILLISECONDS = re.compile(r"(?<![a-z])(ms|msec|milliseconds?)(?![a-z])", re.IGNORECASE)
#: Nanometres in other units of length.
_UNITS = {"micrometres": 1e3, "metres": 1e9, "angstrom": 0.1}


def require_unit(states: StatesFile, columns: Mapping[str, str], angles: str | None) -> None:
    """Raise ImportFailed where the angles of an axis, or times, are probably in another unit than assumed."""
    for name, degrees in states.angles_deg.items():
        finite = np.unique(degrees[np.isfinite(degrees)])
        turn = float(np.ptp(finite)) if finite.size else 0.0
        unit = _unit_of(states, columns.get(name, columns.get(f"{name}_deg", name)))
        if angles == "radians" and np.deg2rad(turn) > 2 * MOST_RAD:
            raise ImportFailed(
                f"{states.path}: axis {name} turns by {np.deg2rad(turn):.3g} radians, which is {turn / 360:.3g} turns. "
                "These angles are probably in degrees. Add --angles degrees"
            )
        if angles is not None:
            continue
        if turn > MOST_TURNS * 360 or _STEPS.search(unit):
            raise ImportFailed(
                f"{states.path}: axis {name} turns by {turn:.6g} degrees, which is {turn / 360:.3g} turns. These "
                "numbers are probably steps of a motor. Convert them to degrees, or add --angles degrees"
            )
        small = finite.size > 2 and turn <= MOST_RAD and np.diff(finite).max() < STEP_DEG
        if small or _RADIANS.search(unit):
            why = f"{unit.strip()!r} says so" if _RADIANS.search(unit) else f"in steps below {STEP_DEG:g}"
            raise ImportFailed(
                f"{states.path}: axis {name} turns by {turn:.3g} degrees in all, {why}. "
                "These angles are probably in radians. Add --angles radians, or --angles degrees"
            )
    for name in ("exposure_s", "time_s"):
        if name in columns and _MILLISECONDS.search(_unit_of(states, columns[name])):
            raise ImportFailed(
                f"{states.path}: {name} is in seconds, and the column is {columns[name]!r}. "
                f"Add --columns '{name.removesuffix('s')}ms={columns[name]}'"
            )


def _unit_of(states: StatesFile, column: str) -> str:
    return f"{stated_unit(column)} {states.units.get(column, '')}"


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
