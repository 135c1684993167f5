"""Intervals of derived maps where value +- error is not enough: every pixel has one, whatever it shows.

First order holds for what is smooth over the errors. Magnitudes, angles of short vectors, retardance near 180 degrees
and what divides by a weak factor are not; docs/quantities.md, "Standard errors", says what is done for each.
`<name>_errors` is half the 68 % interval by noise, `<name>_systematic` the standard uncertainty by the instrument's,
`<name>_95` the lower and upper bound of the 95 % interval by both.
"""

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from processing.arrays import Array, RealArray
from processing.maps.ranges import ANGLES_OF, DIFFERENTIAL, EITHER_AXIS, SIGNED, whole_range
from processing.polarization.magnitude import NORMAL_95, directions, interval, sum_of_singular_values
from processing.polarization.propagation import Derived
from processing.polarization.vector_noise import VectorNoise, of_elements, of_slopes
from processing.reduction.systematic import Systematic
from processing.storage.products.images import MuellerImage

Planes = dict[str, NDArray[Any]]

#: Probabilities that fast and slow axis have changed places from which on the 68 and 95 % interval holds both.
FLIPPED = (0.2, 0.02)
#: Standard deviations that a normal number exceeds on one side in 5 %.
ONE_SIDE_95 = 1.644854
#: A ratio to m00 is determined where m00 is this many times its noise. With less the noise of other elements is as
#: large as M, so that no first order holds: with 3 the 95 % intervals of eigenvalues covered 86 % at condition 80.
LEAST_M00 = 5.0
#: A rotation is determined where the weakest factor that it is divided by is this many times its noise.
SEEN = 3.0
#: Relative error of m00 from which on the ratio to it has an interval of its own: below, that would change the longest
#: one by a hundredth.
UNEVEN = 0.03


def has_own_95(name: str) -> bool:
    """Whether a map has a plane `<name>_95`: 32 more numbers a pixel would be of little use."""
    return name != "dominant_mueller_jones"


class ElementNoise(Protocol):
    """Errors of the elements of an image."""

    def covariance(self) -> NDArray[np.floating]: ...


def set_magnitudes(
    planes: Planes,
    derived: Mapping[str, Derived],
    m: Array,
    image: ElementNoise,
    *,
    noises: Mapping[str, VectorNoise] | None = None,
) -> None:
    """Replace value and error of every length of a vector and of every angle, and add their 95 % intervals.

    Parameters
    ----------
    m : (..., 4, 4), the matrices of which `derived` is.
    noises : noise of vectors that is known already, by the name of their length.
    """
    covariance = image.covariance()
    for name, quantity in derived.items():
        if name not in planes or not (quantity.elements or quantity.parts is not None):
            continue
        if quantity.parts is None:
            noise = of_elements(covariance, m, quantity.elements)
            vector: RealArray = np.moveaxis(m.reshape(*m.shape[:-2], 16)[..., quantity.elements], -1, 0)
            # How the length is normalized.
            scale = np.square(quantity.value * m[..., 0, 0]) / np.square(vector).sum(axis=0)
        else:
            vector, scale = quantity.parts.value, np.ones(())
            noise = (noises or {}).get(name) or of_slopes(covariance, vector, quantity.parts.gradient)
        length = np.asarray(quantity.value, dtype=float)
        along, total, square = scale * noise.along, scale * noise.total, scale**2 * noise.square
        plane = (scale**2 * noise.mixed, scale * noise.across, scale**2 * noise.further)
        moments = (along, total, square)
        put(planes, name, *interval(length, *moments, plane=plane))
        for angle in ANGLES_OF.get(name, ()):
            if angle in planes:
                direction = length * vector / np.hypot(*vector)
                set_angle(planes, angle, direction, scale * noise.packed[[0, 1, 3]])


def set_angle(planes: Planes, name: str, vector: Array, covariance: Array, *, of_68: Array | float = 1.0) -> None:
    """Fieller's interval for the direction of vectors (2, ...): all directions where they may be zero.

    Parameters
    ----------
    of_68 : (...), errors for the 68 % interval over those for the 95 % interval, which `covariance` has.
    """
    direction = directions(vector, covariance, both_ends=name == EITHER_AXIS, of_68=of_68)
    half, low, high = (np.rad2deg(part) / 2 for part in direction)
    value = planes[name]
    put(planes, name, value, half, value + low, value + high)


def set_ellipticity(planes: Planes) -> None:
    """Interval of the ellipticity, -45 to 45 degrees; circular light where its linear part may be zero.

    `set_magnitudes` is done.
    """
    name = "polarizance_ellipticity_deg"
    if name not in planes:
        return
    linear, circular = planes["polarizance_linear"].astype(float), planes["polarizance_circular"].astype(float)
    # ElementNoise is taken off the linear part: else circular light has less ellipticity than 45 degrees.
    value = np.rad2deg(0.5 * np.arctan2(circular, linear))
    square, zero = np.square(np.deg2rad(2 * planes[f"{name}_errors"].astype(float))), np.zeros(value.shape)
    direction = directions(np.stack([zero + 1, zero]), np.stack([square, square, zero]))
    half_68, half_95 = (np.rad2deg(half) / 2 for half in (direction.half, direction.high))
    may_be_circular = planes["polarizance_linear_95"][0] == 0
    low = np.where(may_be_circular & (circular < 0), -45.0, np.maximum(value - half_95, -45.0))
    high = np.where(may_be_circular & (circular > 0), 45.0, np.minimum(value + half_95, 45.0))
    put(planes, name, value, np.minimum(half_68, 45.0), low, high)


def set_ratios(planes: Planes, derived: Mapping[str, Derived], image: ElementNoise, m00: Array) -> None:
    """Effect of the noise of m00 on ratios beyond first order, after Fieller. Call it after all other functions.

    With q = a/b to first order in all elements but b = m00, a - q0 b is normal for every q0, and its variance is that
    of q, less twice the covariance of q and b times what q0 is off, plus the variance of b times that squared, over
    b^2. Where m00 may be zero nothing is known, and where a quantity does not exist it may be anything.

    Parameters
    ----------
    m00 : (rows, columns), counts.
    """
    of_m00 = image.covariance()[..., 0].astype(float)
    relative = np.where(m00 > 0, np.sqrt(of_m00[..., 0]) / m00, np.inf)
    measured = np.isfinite(of_m00[..., 0])
    some = measured & (relative > UNEVEN)
    u, of_m00 = relative[some], of_m00[some] / m00[some][:, None]
    for name, quantity in derived.items():
        if name not in planes:
            continue
        value, error = planes[name], planes[f"{name}_errors"]
        if f"{name}_95" not in planes and has_own_95(name):
            planes[f"{name}_95"] = np.stack([value - NORMAL_95 * error, value + NORMAL_95 * error])
        lost = measured & ~np.isfinite(value)
        if lost.any():
            low, high = whole_range(name, value)
            np.copyto(error, high - low, where=lost)
            if has_own_95(name):
                np.copyto(planes[f"{name}_95"], np.stack([low, high]), where=lost)
        if not some.any():
            continue
        middle = value[..., some].astype(float)
        bent, shared = u, np.nan_to_num(np.einsum("...pk,pk->...p", quantity.gradient[..., some, :], of_m00))
        if name.endswith("_deg") or not np.nan_to_num(quantity.gradient[..., 0]).any():
            # No ratio to m00.
            bent, shared = np.zeros_like(u), np.zeros_like(shared)
        low, high = whole_range(name, middle)
        # Uneven by Fieller: with its larger side 68 % intervals covered up to 85 %.
        ends = over_m00(np.stack([-error[..., some], error[..., some]]), bent, shared, 1.0)
        half = np.where(np.isfinite(middle), (ends[1] - ends[0]) / 2, error[..., some])
        everything = np.where(np.isfinite(middle), np.maximum(middle - low, high - middle), high - low)
        error[..., some] = np.where(u < 1 / LEAST_M00, half, everything)
        if has_own_95(name):
            bounds = planes[f"{name}_95"]
            ends = bounds[..., some]
            wide = middle + over_m00(ends - middle, bent, shared, NORMAL_95)
            # The end of a range stays.
            is_fixed = (ends == 0) | (ends == low) | (ends == high) | ~np.isfinite(ends) | ~np.isfinite(middle)
            bounds[..., some] = np.where(u < 1 / LEAST_M00, np.where(is_fixed, ends, wide), np.stack([low, high]))


def over_m00(sides: Array, u: Array, shared: Array, deviate: float) -> Array:
    """Ends (2, ...) of an interval from its middle, of a ratio to m00 with the relative error u; see `set_ratios`.

    `shared` is the covariance of the two.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        denominator = 1 - np.square(deviate * u)
        # Beyond where first order holds the gradient may be anything, but no covariance is larger than both errors.
        most = deviate * u * np.abs(sides)
        turn = np.clip(deviate**2 * shared, -most, most)
        return np.asarray((np.sign(sides) * np.sqrt(turn**2 + sides**2 * denominator) - turn) / denominator)


def moves_of(systematic: Systematic, image: MuellerImage, *, is_held: bool = True) -> Array:
    """Change of M by one standard uncertainty of each uncertain input of the instrument: (D, 16, rows, columns).

    `is_held` as in `Systematic.moves`.
    """
    # What a partial polarimeter does not determine is zero in the solution of least norm.
    values = np.where(image.is_determined[:, None], image.values.reshape(16, -1), 0)
    return np.stack(list(systematic.moves(values, is_held=is_held))).reshape(-1, 16, *image.mask.shape)


def set_systematic(planes: Planes, derived: Mapping[str, Derived], moves: Array) -> Planes:
    """Add `<name>_systematic` to each map, and widen its 95 % interval by it. All others are done.

    Parameters
    ----------
    moves : (D, 16, pixels...), see `moves_of`.

    Returns
    -------
    Of each map (n, pixels, D), what each direction does to its n numbers, to first order.
    """
    names = [name for name in derived if name in planes]
    pixels, inputs = int(np.prod(moves.shape[2:])), len(moves)
    gradients = [derived[name].gradient.reshape(-1, pixels, 16) for name in names]
    each = np.empty((pixels, sum(map(len, gradients)), 16), np.float32)
    parts, start = {}, 0
    for name, gradient in zip(names, gradients, strict=True):
        parts[name] = slice(start, start + len(gradient))
        each[:, parts[name]] = gradient.swapaxes(0, 1)
        start += len(gradient)
    by = np.ascontiguousarray(moves.reshape(inputs, 16, pixels).transpose(2, 1, 0), dtype=np.float32)
    with np.errstate(invalid="ignore", over="ignore"):
        moved = each @ by
        total = np.sqrt(np.einsum("pqd,pqd->qp", moved, moved))
    for name, part in parts.items():
        systematic = total[part].reshape(np.shape(derived[name].value))
        planes[f"{name}_systematic"] = systematic
        if f"{name}_95" in planes:
            planes[f"{name}_95"] = widened(planes[name], planes[f"{name}_95"], systematic)
    return {name: moved[:, part].swapaxes(0, 1) for name, part in parts.items()}


def widened(value: Array, bounds: Array, systematic: Array) -> NDArray[np.float32]:
    """95 % interval (2, ...) by noise, widened by a systematic standard uncertainty; the end of a range stays."""
    off = bounds - value
    wide = value + np.sign(off) * np.hypot(off, NORMAL_95 * np.nan_to_num(systematic))
    return np.where((bounds == 0) | ~np.isfinite(bounds), bounds, wide).astype(np.float32)


def set_retardance(
    planes: Planes,
    derived: Mapping[str, Derived],
    error: Array,
    linear_error: Array,
    *,
    is_determined: NDArray[np.bool_],
) -> None:
    """Retardance also folds at 180 degrees, where fast and slow axis, right and left, are one.

    Where the rotation is not determined, the intervals hold every retarder. `set_magnitudes` is done.

    Parameters
    ----------
    error, linear_error : (...), of the retardance and of its linear part, to first order.
    """
    error, linear_error = error.astype(float), linear_error.astype(float)
    total = np.asarray(derived["retardance_deg"].value, dtype=float)
    gap = 180 - total
    planes["retardance_axis_flip"] = ndtr(-gap / error).astype(np.float32)
    flips = [planes["retardance_axis_flip"] > limit for limit in FLIPPED]
    upper = total > 90
    for name, raw in (("retardance_deg", error), ("retardance_linear_deg", linear_error)):
        value = np.asarray(derived[name].value, dtype=float)
        share = value / total
        variance = np.square(share * error)
        of_gap = interval(share * gap, variance, variance, variance**2)
        # The part of the linear retardance: its first and, about all of it, its second order.
        parted = np.sqrt(np.maximum(np.square(raw) - variance, 0))
        bent = np.square(NORMAL_95 * planes["retardance_circular_deg_errors"].astype(float)) / 360 * (raw is not error)
        low, high = (np.hypot(b - of_gap.value, NORMAL_95 * parted) for b in (of_gap.low, of_gap.high))
        top = 180 * share
        folded = (
            top - of_gap.value,
            np.hypot(of_gap.error, parted),
            top - of_gap.value - high,
            np.minimum(top - of_gap.value + low + bent, 180.0),
        )
        plain = (planes[name], planes[f"{name}_errors"], *planes[f"{name}_95"])
        everything = (plain[0], np.maximum(value, 180 - value), 0.0, 180.0)
        chosen = [np.where(upper, a, b) for a, b in zip(folded, plain, strict=True)]
        put(planes, name, *(np.where(is_determined, a, b) for a, b in zip(chosen, everything, strict=True)))
    for name in SIGNED:
        value, spread = planes[name].astype(float), planes[f"{name}_errors"].astype(float)
        # The same retarder, turned the other way round.
        mirrored = value * (1 - 360 / total)
        half = np.where(flips[0], spread + np.abs(mirrored - value), spread)
        far = [np.where(flips[1], pick(value, mirrored), value) for pick in (np.minimum, np.maximum)]
        # Between the two nothing is left out, so that noise acts on one side of each.
        deviate = np.where(flips[1], ONE_SIDE_95, NORMAL_95)
        low, high = far[0] - deviate * spread, far[1] + deviate * spread
        half, low, high = (
            np.where(is_determined, a, b) for a, b in ((half, 180 + np.abs(value)), (low, -180.0), (high, 180.0))
        )
        put(planes, name, value, half, low, high)
    value = planes["retardance_fast_axis_deg"].astype(float)
    error_68, bounds = planes["retardance_fast_axis_deg_errors"], planes["retardance_fast_axis_deg_95"]
    half = np.where(flips[0] | ~is_determined, 90.0, error_68)
    wide = flips[1] | ~is_determined
    put(
        planes,
        "retardance_fast_axis_deg",
        value,
        half,
        *(np.where(wide, value + s, b) for s, b in zip((-90, 90), bounds, strict=True)),
    )
    name = EITHER_AXIS
    value, bounds = planes[name].astype(float), planes[f"{name}_95"]
    half = np.where(is_determined, planes[f"{name}_errors"], 45.0)
    put(
        planes,
        name,
        value,
        half,
        *(np.where(is_determined, b, value + s) for s, b in zip((-45, 45), bounds, strict=True)),
    )


def set_depolarization_power(planes: Planes, unit: Array, components: float, is_determined: NDArray[np.bool_]) -> None:
    """Noise makes three singular values of nothing, and their sum is what the power is short of 1.

    Parameters
    ----------
    unit : (...), root mean square error of the elements of the depolarizer.
    components : directions that their noise has, see `sorted_eigenvalues.block_components`.
    """
    name = "depolarization_power"
    value, own = planes[name].astype(float), 3 * planes[f"{name}_errors"].astype(float)
    total = sum_of_singular_values(3 * (1 - value), unit, own, components)
    chosen = (
        (1 - total.value / 3, value),
        (total.error / 3, np.maximum(value, 1 - value)),
        (1 - total.high / 3, 0.0),
        (1 - total.low / 3, 1.0),
    )
    put(planes, name, *(np.where(is_determined, a, b) for a, b in chosen))


def set_differential(planes: Planes, is_determined: NDArray[np.bool_]) -> None:
    """Whole ranges where the logarithm does not exist or is next to where it does not."""
    for short in DIFFERENTIAL:
        name = f"differential_{short}"
        value, error = planes[name].astype(float), planes[f"{name}_errors"].astype(float)
        bounds = planes.get(f"{name}_95", np.stack([value - NORMAL_95 * error, value + NORMAL_95 * error]))
        low, high = whole_range(name, value)
        half = np.where(is_determined, error, np.maximum(value - low, high - value))
        put(planes, name, value, half, *np.where(is_determined, bounds, np.stack([low, high])))


def put(planes: Planes, name: str, value: Array, error: Array, *ends: Array) -> None:
    planes[name] = np.asarray(value, dtype=np.float32)
    planes[f"{name}_errors"] = np.asarray(error, dtype=np.float32)
    planes[f"{name}_95"] = both = np.empty((2, *np.shape(value)), np.float32)
    both[0], both[1] = ends
