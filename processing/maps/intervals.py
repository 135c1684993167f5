"""Intervals of derived maps where value +- error is not enough: every pixel has one, whatever it shows.

First order holds for what is smooth over the errors. Magnitudes, angles of short vectors, retardance near 180 degrees
and what divides by a weak factor are not; docs/quantities.md, "Standard errors", says what is done for each.
`<name>_errors` is half the 68 % interval by noise, `<name>_systematic` the standard uncertainty by the instrument's,
`<name>_95` the lower and upper bound of the 95 % interval by both.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from processing.arrays import Array, RealArray
from processing.polarization.eigenvalue_noise import CorrectedXi0, EigenvalueNoise
from processing.polarization.magnitude import NORMAL_95, directions, interval, positive, sum_of_singular_values
from processing.polarization.propagation import Derived
from processing.polarization.quantities import entropy
from processing.polarization.sorted_eigenvalues import of_gaps
from processing.polarization.vector_noise import VectorNoise, of_elements, of_slopes
from processing.reduction.systematic import Systematic
from processing.storage.products.images import MuellerImage

Planes = dict[str, NDArray[Any]]

#: Probabilities that fast and slow axis have changed places from which on the 68 and 95 % interval holds both.
FLIPPED = (0.2, 0.02)
#: Equal eigenvalues are seen apart by the noise between them times the root of this, on average.
_REPELLED = 4.0
#: Parts of the light not in the dominant process between which entropy passes from that of a nearly pure sample to that
#: of a depolarizer, and errors of the depolarization index from which on its own bend is seen.
PURE, FLAT = (0.15, 0.45), 5.0
#: Largest singular value of 3 x 3 noise of variance 1: 68 % of them are smaller.
OF_NOISE = 2.8
#: A rotation is determined where the weakest factor that it is divided by is this many times its noise.
SEEN = 3.0
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
SIGNED = ("retardance_circular_deg", "retardance_vector_deg")
#: What a quantity can be, by the end of its name; of angles see `set_ratios`.
RANGES: tuple[tuple[str, tuple[float, float] | tuple[tuple[float, ...], tuple[float, ...]]], ...] = (
    *((f"differential_{short}", bounds) for short, bounds in DIFFERENTIAL.items()),
    *((f"retardance_{part}deg", (0.0, 180.0)) for part in ("", "linear_")),
    *((name, (-180.0, 180.0)) for name in SIGNED),
    ("ellipticity_deg", (-45.0, 45.0)),
    ("coherency_eigenvalues", ((0.25, 0.0, 0.0, 0.0), (1.0, 1 / 2, 1 / 3, 1 / 4))),
    ("eigenvalue_deviation", (-1 / 3, 1 / 3)),
    ("_circular", (-1.0, 1.0)),
    *((f"symmetric_d{k}", (-1.0, 1.0)) for k in (1, 2, 3)),
    ("dominant_mueller_jones", (-1.0, 1.0)),
    *((name, (0.0, 1.0)) for name in ("entropy", "td_missed", "diattenuation", "polarizance", "_linear")),
    *((f"depolarization_{part}", (0.0, 1.0)) for part in ("index", "power")),
)
#: Relative error of m00 from which on the ratio to it has an interval of its own: below, that would change the longest
#: one by a hundredth.
UNEVEN = 0.03


def has_own_95(name: str) -> bool:
    """Whether a map has a plane `<name>_95`: 32 more numbers a pixel would be of little use."""
    return name != "dominant_mueller_jones"


class ElementNoise(Protocol):
    """What an image knows of the errors of its elements."""

    def covariance(self) -> NDArray[np.floating]: ...


def set_magnitudes(
    planes: Planes,
    derived: Mapping[str, Derived],
    m: Array,
    image: ElementNoise,
    *,
    widened: Array | float = 1.0,
    known: Mapping[str, VectorNoise] | None = None,
) -> None:
    """Replace value and error of every length of a vector and of every angle, and add their 95 % intervals.

    Parameters
    ----------
    m : (..., 4, 4), the matrices of which `derived` is.
    widened : (...), factor by which the errors of the dominant process are larger than to first order.
    known : noise of vectors that is known already, by the name of their length.
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
            noise = (known or {}).get(name) or of_slopes(covariance, vector, quantity.parts.gradient)
        if name.startswith("dominant_"):
            scale = scale * np.square(widened)
        length = np.asarray(quantity.value, dtype=float)
        moments = (scale * noise.along, scale * noise.total, scale**2 * noise.square)
        _put(planes, name, *interval(length, *moments, below=scale * noise.below, above=scale * noise.above))
        for angle in ANGLES_OF.get(name, ()):
            if angle in planes:
                _set_angle(planes, angle, length * vector / np.hypot(*vector), scale * noise.packed[[0, 1, 3]])


def _set_angle(planes: Planes, name: str, vector: Array, covariance: Array) -> None:
    """Fieller's interval for the direction of vectors (2, ...): all directions where they may be zero."""
    found = directions(vector, covariance, both_ends=name == EITHER_AXIS)
    half, low, high = (np.rad2deg(part) / 2 for part in found)
    value = planes[name]
    _put(planes, name, value, half, value + low, value + high)


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
    found = directions(np.stack([zero + 1, zero]), np.stack([square, square, zero]))
    half_68, half_95 = (np.rad2deg(half) / 2 for half in (found.half, found.high))
    may_be_circular = planes["polarizance_linear_95"][0] == 0
    low = np.where(may_be_circular & (circular < 0), -45.0, np.maximum(value - half_95, -45.0))
    high = np.where(may_be_circular & (circular > 0), 45.0, np.minimum(value + half_95, 45.0))
    _put(planes, name, value, np.minimum(half_68, 45.0), low, high)


def set_ratios(planes: Planes, derived: Mapping[str, Derived], image: ElementNoise, m00: Array) -> None:
    """What the noise of m00 does to ratios beyond first order, after Fieller. All others are done.

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
            low, high = _range(name, value)
            np.copyto(error, high - low, where=lost)
            if has_own_95(name):
                np.copyto(planes[f"{name}_95"], np.stack([low, high]), where=lost)
        if not some.any():
            continue
        own = value[..., some].astype(float)
        bent, shared = u, np.nan_to_num(np.einsum("...pk,pk->...p", quantity.gradient[..., some, :], of_m00))
        if name.endswith("_deg"):
            # No ratio to m00.
            bent, shared = np.zeros_like(u), np.zeros_like(shared)
        low, high = _range(name, own)
        half = np.max(np.abs(over_m00(np.stack([-error[..., some], error[..., some]]), bent, shared, 1.0)), axis=0)
        everything = np.where(np.isfinite(own), np.maximum(own - low, high - own), high - low)
        error[..., some] = np.where(u < 1 / SEEN, half, everything)
        if has_own_95(name):
            bounds = planes[f"{name}_95"]
            ends = bounds[..., some]
            wide = own + over_m00(ends - own, bent, shared, NORMAL_95)
            # The end of a range stays.
            kept = (ends == 0) | (ends == low) | (ends == high) | ~np.isfinite(ends) | ~np.isfinite(own)
            bounds[..., some] = np.where(u < 1 / SEEN, np.where(kept, ends, wide), np.stack([low, high]))


def over_m00(sides: Array, u: Array, shared: Array, deviate: float) -> Array:
    """Ends (2, ...) of an interval from its middle, of a ratio to m00 with the relative error u; see `set_ratios`.

    `shared` is the covariance of the two.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        known = 1 - np.square(deviate * u)
        # Beyond where first order holds the gradient may be anything, but no covariance is larger than both errors.
        most = deviate * u * np.abs(sides)
        turn = np.clip(deviate**2 * shared, -most, most)
        return np.asarray((np.sign(sides) * np.sqrt(turn**2 + sides**2 * known) - turn) / known)


def _range(name: str, value: Array) -> tuple[Array, Array]:
    """What a quantity can be, (...) each; of an angle all of its period about the value."""
    if name in ANGLES:
        half = 45.0 if name == EITHER_AXIS else 90.0
        middle = np.where(np.isfinite(value), value, half)
        return middle - half, middle + half
    low, high = next((np.array(ends) for end, ends in RANGES if name.endswith(end)), np.array([-np.inf, np.inf]))
    grow = (slice(None),) * np.ndim(low) + (None,) * (value.ndim - np.ndim(low))
    return np.broadcast_to(low[grow], value.shape), np.broadcast_to(high[grow], value.shape)


def moves_of(systematic: Systematic, image: MuellerImage) -> Array:
    """What one standard uncertainty of each uncertain input of the instrument does to M: (D, 16, rows, columns)."""
    # What a partial polarimeter does not determine is zero in the solution of least norm.
    values = np.where(image.seen[:, None], image.values.reshape(16, -1), 0)
    return np.stack(list(systematic.moves(values))).reshape(-1, 16, *image.mask.shape)


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
    whole = np.asarray(derived["retardance_deg"].value, dtype=float)
    gap = 180 - whole
    planes["retardance_axis_flip"] = ndtr(-gap / error).astype(np.float32)
    flips = [planes["retardance_axis_flip"] > limit for limit in FLIPPED]
    upper = whole > 90
    for name, raw in (("retardance_deg", error), ("retardance_linear_deg", linear_error)):
        value = np.asarray(derived[name].value, dtype=float)
        share = value / whole
        one = np.square(share * error)
        found = interval(share * gap, one, one, one**2)
        # The part of the linear retardance: its first and, about all of it, its second order.
        parted = np.sqrt(np.maximum(np.square(raw) - one, 0))
        bent = np.square(NORMAL_95 * planes["retardance_circular_deg_errors"].astype(float)) / 360 * (raw is not error)
        low, high = (np.hypot(b - found.value, NORMAL_95 * parted) for b in (found.low, found.high))
        top = 180 * share
        folded = (
            top - found.value,
            np.hypot(found.error, parted),
            top - found.value - high,
            np.minimum(top - found.value + low + bent, 180.0),
        )
        plain = (planes[name], planes[f"{name}_errors"], *planes[f"{name}_95"])
        everything = (plain[0], np.maximum(value, 180 - value), 0.0, 180.0)
        chosen = [np.where(upper, a, b) for a, b in zip(folded, plain, strict=True)]
        _put(planes, name, *(np.where(is_determined, a, b) for a, b in zip(chosen, everything, strict=True)))
    for name in SIGNED:
        value, spread = planes[name].astype(float), planes[f"{name}_errors"].astype(float)
        # The same retarder, turned the other way round.
        other = value * (1 - 360 / whole)
        half = np.where(flips[0], spread + np.abs(other - value), spread)
        far = [np.where(flips[1], pick(value, other), value) for pick in (np.minimum, np.maximum)]
        low, high = far[0] - NORMAL_95 * spread, far[1] + NORMAL_95 * spread
        half, low, high = (
            np.where(is_determined, a, b) for a, b in ((half, 180 + np.abs(value)), (low, -180.0), (high, 180.0))
        )
        _put(planes, name, value, half, low, high)
    value = planes["retardance_fast_axis_deg"].astype(float)
    error_68, bounds = planes["retardance_fast_axis_deg_errors"], planes["retardance_fast_axis_deg_95"]
    half = np.where(flips[0] | ~is_determined, 90.0, error_68)
    wide = flips[1] | ~is_determined
    _put(
        planes,
        "retardance_fast_axis_deg",
        value,
        half,
        *(np.where(wide, value + s, b) for s, b in zip((-90, 90), bounds, strict=True)),
    )
    name = EITHER_AXIS
    value, bounds = planes[name].astype(float), planes[f"{name}_95"]
    half = np.where(is_determined, planes[f"{name}_errors"], 45.0)
    _put(
        planes,
        name,
        value,
        half,
        *(np.where(is_determined, b, value + s) for s, b in zip((-45, 45), bounds, strict=True)),
    )


def set_depolarization_power(planes: Planes, is_determined: NDArray[np.bool_]) -> None:
    """Noise makes three singular values of nothing, and their sum is what the power is short of 1."""
    name = "depolarization_power"
    value = planes[name].astype(float)
    unit = np.sqrt(3) * planes[f"{name}_errors"].astype(float)
    found = sum_of_singular_values(3 * (1 - value), unit)
    chosen = (
        (1 - found.value / 3, value),
        (found.error / 3, np.maximum(value, 1 - value)),
        (1 - found.high / 3, 0.0),
        (1 - found.low / 3, 1.0),
    )
    _put(planes, name, *(np.where(is_determined, a, b) for a, b in chosen))


def set_differential(planes: Planes, is_determined: NDArray[np.bool_]) -> None:
    """Whole ranges where the logarithm does not exist or is next to where it does not."""
    for short, bounds in DIFFERENTIAL.items():
        name = f"differential_{short}"
        value, error = planes[name].astype(float), planes[f"{name}_errors"].astype(float)
        known = planes.get(f"{name}_95", np.stack([value - NORMAL_95 * error, value + NORMAL_95 * error]))
        half = np.where(is_determined, error, np.maximum(value - bounds[0], bounds[1] - value))
        ends = [np.where(is_determined, own, end) for own, end in zip(known, bounds, strict=True)]
        _put(planes, name, value, half, *ends)


def set_eigenvalues(planes: Planes, noise: EigenvalueNoise, found: CorrectedXi0, components: float) -> Array:
    """Noise taken off eigenvalues, which it pushes apart, and off what follows from them.

    xi0 is that of `process xi0`. The others keep their mean; their gaps say how far noise has pushed them. Returns the
    eigenvalues (4, ...) whose deviations from that mean have lost what noise adds to their sum of squares.

    Parameters
    ----------
    components : directions that their noise has, see `sorted_eigenvalues.block_components`.
    """
    xi = planes["coherency_eigenvalues"].astype(float)
    deviation = planes["eigenvalue_deviation"].astype(float)
    observed = np.sum(deviation**2, axis=0)
    real = np.sqrt(np.maximum(1 - noise.others / observed, 0))
    unit = np.sqrt(noise.others / 8)
    own = planes["eigenvalue_deviation_errors"] / (np.sqrt(2 / 3) * unit)
    first, second = -np.diff(xi[1:], axis=0) / unit
    three = of_gaps(first, second, own, components)
    mean = (1 - found.xi0) / 3
    shrunk = np.stack([found.xi0, *(mean + real * deviation)])
    with_mean, without_mean = three.with_mean(found.stderr / (3 * unit)), three.with_mean(np.zeros_like(unit))
    deviation = deviation + unit * three.middle
    xi = mean + deviation
    low, high = xi - unit * with_mean.below, xi + unit * with_mean.above
    _put(
        planes,
        "coherency_eigenvalues",
        np.stack([found.xi0, *xi]),
        np.stack([found.stderr, *(unit * with_mean.half)]),
        np.stack([found.interval_95[0], *low]),
        np.stack([found.interval_95[1], *high]),
    )
    _put(
        planes,
        "eigenvalue_deviation",
        deviation,
        unit * without_mean.half,
        deviation - unit * without_mean.below,
        deviation + unit * without_mean.above,
    )
    missed = planes["td_missed"].astype(float)
    planes["td_missed_noise"] = (missed * np.sqrt(noise.others / observed)).astype(np.float32)
    # Nearly in proportion to the root of their sum of squares, the length of a vector.
    total = np.square(missed) / observed * noise.others
    along = np.square(planes["td_missed_errors"].astype(float))
    _put(planes, "td_missed", *interval(missed, along, total, total**2 / components))
    return shrunk


def set_entropy(planes: Planes, xi: Array, found: CorrectedXi0) -> None:
    """Entropy of eigenvalues (4, ...) whose deviations have lost what noise adds. `set_magnitudes` is done.

    It is bent where an eigenvalue may be zero, and where all may be equal. There it follows what is known: of a nearly
    pure sample xi0, the others in proportion; of a depolarizer the depolarization index, all eigenvalues in proportion.
    """
    own = entropy_of(xi)
    spread = planes["entropy_errors"].astype(float)
    errors = np.concatenate([found.stderr[None], planes["coherency_eigenvalues_errors"][1:]])
    index, u = planes["depolarization_index"].astype(float), planes["depolarization_index_errors"].astype(float)
    bent = (xi < SEEN * errors).any(axis=0) | (index < FLAT * u) | ~np.isfinite(spread)
    rest, off = np.clip(xi[1:], 0, None), xi - 0.25
    sums = rest.sum(axis=0)
    rest = np.where(sums > 0, rest / np.where(sums > 0, sums, 1), 1 / 3)
    scale = np.sqrt(4 / 3 * np.square(off).sum(axis=0))
    share = np.clip((1 - found.xi0 - PURE[0]) / (PURE[1] - PURE[0]), 0, 1)
    both = (found.interval_68, np.stack([index - u, index + u])), (found.interval_95, planes["depolarization_index_95"])
    middle, half = planes["td_missed"].astype(float), planes["td_missed_errors"].astype(float)
    missed = np.stack([np.maximum(middle - half, 0), middle + half]), planes["td_missed_95"]
    ends = []
    for (of_xi0, of_index), deviate, level in zip(both, (1.0, NORMAL_95), (0, 1), strict=True):
        unit = (of_xi0[1] - of_xi0[0]) / (2 * deviate)
        observed = (1 - found.xi0) / unit
        lost = np.where(observed < 4, positive(observed)[level] * unit, 1 - of_xi0[::-1])
        pure = _of_pure(lost, 1 - found.xi0, rest, missed[level] / np.where(middle > 0, middle, 1))
        even = [entropy_of(0.25 + off * (np.maximum(x, 0) / scale)) for x in of_index[::-1]]
        far = [(1 - share) * p + share * e for p, e in zip(pure, even, strict=True)]
        near = [own - deviate * spread, own + deviate * spread]
        if level:
            # Beyond first order entropy depends on both.
            near = [np.fmin(near[0], far[0]), np.fmax(near[1], far[1])]
        ends += [np.where(bent, f, n) for f, n in zip(far, near, strict=True)]
    low, high, low_95, high_95 = ends
    _put(planes, "entropy", (low + high) / 2, (high - low) / 2, np.maximum(low_95, 0), np.minimum(high_95, 1))


def _of_pure(lost: Array, middle: Array, rest: Array, apart: Array) -> list[Array]:
    """Ends of the entropy by those (2, ...) of what xi0 leaves, and of how far the others `rest` (3, ...) are apart."""

    def at(p: Array, spread: Array | float) -> Array:
        light = np.clip(p, 0, 0.75)
        shares = np.clip(1 / 3 + spread * (rest - 1 / 3), 0, None)
        return entropy_of(np.concatenate([1 - light[None], light * shares / shares.sum(axis=0)]))

    own = at(middle, 1.0)
    return [
        own + side * np.hypot(at(p, 1.0) - own, at(middle, spread) - own)
        for p, spread, side in zip(lost, apart[::-1], (-1, 1), strict=True)
    ]


def entropy_of(xi: Array) -> Array:
    """Entropy (...) of eigenvalues (4, ...), without negative ones."""
    physical = np.clip(xi, 0, None)
    return np.asarray(entropy(np.moveaxis(physical / physical.sum(axis=0), 0, -1)))


def set_symmetric(planes: Planes, relative: Array) -> None:
    """Elements of the symmetric decomposition are sorted: near ones mix, and noise alone makes some.

    Parameters
    ----------
    relative : (...), root mean square error of an element other than m00, over m00.
    """
    names = [f"symmetric_d{k}" for k in (1, 2, 3)]
    value = np.stack([np.ones_like(planes[names[0]]), *(planes[n] for n in names)]).astype(float)
    error = np.stack([np.zeros_like(value[0]), *(planes[f"{n}_errors"] for n in names)]).astype(float)
    near = ~(np.abs(np.diff(value, axis=0)) > SEEN * np.hypot(error[:-1], error[1:]))
    for k, name in enumerate(names):
        mixed = near[k] | near[min(k + 1, 2)] | (np.abs(value[k + 1]) < SEEN * relative)
        spread = np.hypot(error[k + 1], np.where(mixed, (OF_NOISE if k == 0 else 2) * relative, 0))
        known = np.isfinite(spread)
        bounds = value[k + 1] - NORMAL_95 * spread, value[k + 1] + NORMAL_95 * spread
        low, high = (np.where(known, b, end) for b, end in zip(bounds, (-1.0, 1.0), strict=True))
        _put(planes, name, value[k + 1], spread, low, high)


def widen_dominant(planes: Planes, noise: EigenvalueNoise, uneven: float) -> Array:
    """Errors of the dominant process for the gap without noise, which pushes eigenvalues apart.

    `set_eigenvalues` is done. Returns the factor (...), NaN where the process is not determined.

    Parameters
    ----------
    uneven : noise of the noisiest directions over that of all.
    """
    xi = planes["coherency_eigenvalues"].astype(float)
    gap, coupling = xi[0] - xi[1], uneven * noise.coupling
    # Two processes whose eigenvalues were equal would be seen this far apart.
    seen = (gap + np.sqrt(gap**2 + 4 * _REPELLED * coupling**2)) / 2
    factor = np.where(gap > SEEN * coupling, seen / gap, np.nan)
    for name in [n for n in planes if n.startswith("dominant_") and not n.endswith("_errors")]:
        planes[f"{name}_errors"] = planes[f"{name}_errors"] * factor.astype(np.float32)
    return factor


def set_any_dominant(planes: Planes, derived: Mapping[str, Derived], is_determined: NDArray[np.bool_]) -> None:
    """Every process is in the intervals where the dominant one is not determined. The others are done."""
    for name in [n for n in derived if n.startswith("dominant_")]:
        value = np.where(is_determined, planes[name], derived[name].value)
        error = planes[f"{name}_errors"]
        low, high = (value - 90, value + 90) if name.endswith("_deg") else (0.0 if "_linear" in name else -1.0, 1.0)
        bounds = planes.get(f"{name}_95", (value - NORMAL_95 * error, value + NORMAL_95 * error))
        half = np.where(is_determined, error, np.maximum(value - low, high - value))
        if name == "dominant_mueller_jones":
            planes[f"{name}_errors"] = np.asarray(half, dtype=np.float32)
        else:
            ends = [np.where(is_determined, b, end) for b, end in zip(bounds, (low, high), strict=True)]
            _put(planes, name, value, half, *ends)


def _put(planes: Planes, name: str, value: Array, error: Array, *ends: Array) -> None:
    planes[name] = np.asarray(value, dtype=np.float32)
    planes[f"{name}_errors"] = np.asarray(error, dtype=np.float32)
    planes[f"{name}_95"] = np.stack(ends).astype(np.float32)
