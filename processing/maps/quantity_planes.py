"""Planes of a product of quantities: names, units, and what each is."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from processing.maps.intervals import has_own_95
from processing.maps.partial_quantities import Pairs
from processing.maps.xi0 import VALID
from processing.polarization.scalar_files import scalar_quantities
from processing.storage.products.product import LIT_ERRORS, Plane

_AXES = "degrees from horizontal, 0 to 180"
_MAPS: dict[str, Plane] = {
    "coherency_eigenvalues": Plane(
        (4,), "", "coherency eigenvalues over their sum, descending; negative ones are noise"
    ),
    "eigenvalue_deviation": Plane((3,), "", "xi1, xi2, xi3 minus their mean: 0 where the TD model holds"),
    "td_missed": Plane((), "", "fraction of the light in the wrong process of the TD model: sum of |deviation| / 2"),
    "entropy": Plane((), "", "entropy of the eigenvalues, base 4; NaN where one is negative"),
    "depolarization_index": Plane((), "", "depolarization index: 1 pure, 0 ideal depolarizer"),
    "diattenuation": Plane((), "", "magnitude of the diattenuation of M"),
    "diattenuation_linear": Plane((), "", "linear diattenuation of M"),
    "diattenuation_circular": Plane((), "", "circular diattenuation m03 / m00"),
    "diattenuation_orientation_deg": Plane((), "degree", f"azimuth of the diattenuation of M, {_AXES}"),
    "polarizance": Plane((), "", "magnitude of the polarizance of M: degree of polarization under unpolarized light"),
    "polarizance_linear": Plane((), "", "linear polarizance of M: DoLP under unpolarized light"),
    "polarizance_circular": Plane((), "", "circular polarizance m30 / m00"),
    "polarizance_orientation_deg": Plane((), "degree", f"azimuth of the polarizance of M, AoLP, {_AXES}"),
    "dominant_mueller_jones": Plane((4, 4), "", "Mueller-Jones matrix m0 of the largest eigenvalue, m00 = 1"),
    "dominant_diattenuation_linear": Plane((), "", "linear diattenuation |D| of the dominant process"),
    "dominant_diattenuation_circular": Plane((), "", "circular diattenuation of the dominant process"),
    "dominant_diattenuation_orientation_deg": Plane((), "degree", f"azimuth psi of the dominant process, {_AXES}"),
    "dominant_polarizance_linear": Plane((), "", "linear polarizance of the dominant process"),
    "dominant_polarizance_circular": Plane((), "", "circular polarizance of the dominant process"),
    "dominant_polarizance_orientation_deg": Plane((), "degree", f"azimuth of its polarizance, {_AXES}"),
    "retardance_deg": Plane((), "degree", "Lu-Chipman retardance, 0 to 180 degrees"),
    "retardance_linear_deg": Plane((), "degree", "linear part of the Lu-Chipman retardance vector"),
    "retardance_fast_axis_deg": Plane((), "degree", f"fast axis of the linear part, {_AXES}"),
    "retardance_axis_or_90_deg": Plane((), "degree", "fast or slow axis, 0 to 90: known at 180 degrees too"),
    "retardance_vector_deg": Plane(
        (3,), "degree", "retardance along horizontal, 45 degrees, right circular; v and v - 360 v/|v| are one retarder"
    ),
    "retardance_circular_deg": Plane((), "degree", "circular part; positive: right circular is fast"),
    "depolarization_power": Plane((), "", "Lu-Chipman depolarization power"),
}
_SYMMETRIC = {
    f"symmetric_d{k}": Plane((), "", f"element {k} of the symmetric decomposition's depolarizer over element 0")
    for k in (1, 2, 3)
}
_DIFFERENTIAL = {
    "differential_retardance_deg": Plane((), "degree", "retardance of the differential decomposition"),
    "differential_retardance_linear_deg": Plane((), "degree", "its linear part"),
    "differential_retardance_fast_axis_deg": Plane((), "degree", f"fast axis of the linear part, {_AXES}"),
    "differential_retardance_circular_deg": Plane((), "degree", "its circular part; positive: right circular is fast"),
    "differential_diattenuation_linear": Plane((), "", "linear diattenuation exponent, ln(T_max / T_min) / 2"),
} | {f"differential_depolarization_{k}": Plane((), "", f"depolarization exponent of S{k}") for k in (1, 2, 3)}

#: Without error bars of their own.
NOISE = {
    "td_missed_noise": Plane((), "", "td_missed of a triply degenerate matrix, by noise alone; taken off"),
    "retardance_axis_flip": Plane((), "", "probability that the fast axis told is the slow one"),
    "retardance_vector_covariance": Plane(
        (6,), "degree2", "covariance of retardance_vector_deg: 00, 11, 22, 01, 02, 12"
    ),
}


def planes_of(extra: Sequence[str], pairs: Pairs) -> dict[str, Plane]:
    """Planes of the maps of whole matrices, without those of their errors."""
    maps = dict(_MAPS)
    for scalar in scalar_quantities().values():
        maps[scalar.name] = Plane((), scalar.units, scalar.title)
    for name, (generator, analyzer) in pairs.items():
        maps[name] = Plane((), "", f"light from a {generator} generator through a {analyzer} analyzer, over m00")
    defined = ["lu_chipman", *extra]
    if "symmetric" in extra:
        maps |= _SYMMETRIC
    if "differential" in extra:
        maps |= _DIFFERENTIAL
    for name in defined:
        maps[f"{name}_defined"] = Plane((), "", f"1 = the {name.replace('_', '-')} decomposition exists", np.uint8)
    maps["valid"] = VALID
    maps["lit"] = Plane((), "", f"1 = m00 is above {LIT_ERRORS:g} of its standard errors", np.uint8)
    maps["negative_determinant"] = Plane((), "", "1 = det M < 0: Lu-Chipman's depolarizer is negative there", np.uint8)
    return maps


def with_errors(
    maps: Mapping[str, Plane], own_95: Callable[[str], bool] = has_own_95, *, systematic: bool = False
) -> dict[str, Plane]:
    """The planes of maps, of their standard errors and, where +- 1.96 errors is not it, of their 95 % intervals.

    `systematic` : with what the instrument's uncertainty does to each.
    """
    planes = dict(maps)
    for name, plane in maps.items():
        if plane.dtype is np.float32:
            planes[f"{name}_errors"] = Plane(plane.leading, plane.units, f"half the 68 % interval of {name}, by noise")
            if own_95(name):
                title = f"lower and upper bound of the 95 % interval of {name}"
                planes[f"{name}_95"] = Plane((2, *plane.leading), plane.units, title)
            if systematic:
                title = f"standard uncertainty of {name} by the instrument's; it does not average"
                planes[f"{name}_systematic"] = Plane(plane.leading, plane.units, title)
    return planes
