"""What each quantity can be: its range, and for an angle one period."""

import numpy as np

from processing.arrays import Array
from processing.polarization.quantities import PAPER_PAIRS

#: Of a retardance near 180 degrees fast and slow axis cannot be told apart.
EITHER_AXIS = "retardance_axis_or_90_deg"
#: Angles whose range is all directions, by the length of the vector that they are the angle of.
ANGLES_OF = {
    **{
        f"{name}_linear": (f"{name}_orientation_deg",)
        for name in ("diattenuation", "polarizance", "dominant_diattenuation", "dominant_polarizance")
    },
    "retardance_linear_deg": ("retardance_fast_axis_deg", EITHER_AXIS),
    "differential_retardance_linear_deg": ("differential_retardance_fast_axis_deg",),
}
ANGLES = tuple(angle for each in ANGLES_OF.values() for angle in each)
#: Ranges of what the differential decomposition gives; where it does not exist any of them may be.
DIFFERENTIAL = {
    "retardance_deg": (0.0, 180.0),
    "retardance_linear_deg": (0.0, 180.0),
    "retardance_fast_axis_deg": (0.0, 180.0),
    "retardance_circular_deg": (-180.0, 180.0),
    "diattenuation_linear": (0.0, np.inf),
    **{f"depolarization_{k}": (-np.inf, np.inf) for k in (1, 2, 3)},
}
#: Retardances whose sign is that of the rotation.
SIGNED = ("retardance_circular_deg", "retardance_vector_deg")
#: What a quantity can be, by the end of its name; of angles see `whole_range`.
RANGES: tuple[tuple[str, tuple[float, float] | tuple[tuple[float, ...], tuple[float, ...]]], ...] = (
    *((f"differential_{short}", bounds) for short, bounds in DIFFERENTIAL.items()),
    *((f"retardance_{part}deg", (0.0, 180.0)) for part in ("", "linear_")),
    *((name, (-180.0, 180.0)) for name in SIGNED),
    ("ellipticity_deg", (-45.0, 45.0)),
    ("xi0", (0.25, 1.0)),
    ("coherency_eigenvalues", ((0.25, 0.0, 0.0, 0.0), (1.0, 1 / 2, 1 / 3, 1 / 4))),
    ("eigenvalue_deviation", (-1 / 3, 1 / 3)),
    *((name, (0.0, 2.0)) for name in PAPER_PAIRS),
    ("_circular", (-1.0, 1.0)),
    *((f"symmetric_d{k}", (-1.0, 1.0)) for k in (1, 2, 3)),
    ("dominant_mueller_jones", (-1.0, 1.0)),
    *((name, (0.0, 1.0)) for name in ("entropy", "td_missed", "diattenuation", "polarizance", "_linear", "_purity")),
    *((f"depolarization_{part}", (0.0, 1.0)) for part in ("index", "power")),
)


def whole_range(name: str, value: Array) -> tuple[Array, Array]:
    """Range of a quantity, (...) each; for an angle one period about the value."""
    if name in ANGLES:
        half = 45.0 if name == EITHER_AXIS else 90.0
        middle = np.where(np.isfinite(value), value, half)
        return middle - half, middle + half
    low, high = next((np.array(ends) for end, ends in RANGES if name.endswith(end)), np.array([-np.inf, np.inf]))
    grow = (slice(None),) * np.ndim(low) + (None,) * (value.ndim - np.ndim(low))
    return np.broadcast_to(low[grow], value.shape), np.broadcast_to(high[grow], value.shape)
