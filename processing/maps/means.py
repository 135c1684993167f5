"""Means over a region, over repeats, over the captures of a night: M or S first, quantities of the mean after.

Maps of magnitudes are never negative, so their mean over pixels is too large; M is linear in the counts. Uncertainties
(GUM, JCGM 100): noise, with what neighbouring pixels share; scatter between captures (type A); and the instrument's,
which does not average. The interval uses the effective degrees of freedom (Welch and Satterthwaite).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from processing.arrays import Array
from processing.errors import ProcessError
from processing.instrument.uncertainty import align_inputs
from processing.maps.partial_quantities import determined_maps, partial_block
from processing.maps.quantities import quantities_block
from processing.maps.ranges import ANGLES, EITHER_AXIS
from processing.maps.stokes_vector import is_first_column, light_of, light_quantities, moves_of_light, rename_planes
from processing.polarization.magnitude import NORMAL_95
from processing.polarization.quantities import PAPER_PAIRS
from processing.reduction.stokes import linear_polarization, moved_polarization
from processing.reduction.systematic import Systematic
from processing.reflectance.shared_noise import shared_variance
from processing.storage.products.images import MuellerImage, StokesImage, neighbour_correlation
from processing.storage.products.pixel_mask import Mask
from processing.storage.products.product import Product

Region = tuple[slice, slice]
Inputs = tuple[tuple[str, float], ...]


@dataclass(frozen=True)
class Contribution:
    """One line of an uncertainty budget.

    Attributes
    ----------
    source : noise, scatter between captures, or an uncertain value of the instrument.
    u : standard uncertainty of the result by it.
    degrees_of_freedom : infinite where it is not estimated from few values.
    u_input : standard uncertainty of the input, in its unit; NaN where it is no single value.
    sensitivity : change of the result by one unit of the input; NaN likewise.
    """

    source: str
    u: float
    degrees_of_freedom: float = np.inf
    u_input: float = np.nan
    sensitivity: float = np.nan


#: Columns of `MeanValue.budget_lines`.
BUDGET_COLUMNS = ("input", "u(input)", "sensitivity", "contribution", "share", "dof")


@dataclass(frozen=True)
class MeanValue:
    """Mean of one quantity.

    Attributes
    ----------
    value : of the mean M or S.
    u_noise, u_systematic : standard uncertainties.
    scatter : standard deviation of the captures' own values; NaN for one capture.
    low, high : of the 95 % interval, all uncertainties included.
    budget : what the combined uncertainty is made of.
    """

    name: str
    unit: str
    value: float
    u_noise: float
    u_systematic: float
    scatter: float
    low: float
    high: float
    budget: tuple[Contribution, ...]

    @property
    def u(self) -> float:
        """Combined standard uncertainty."""
        return float(np.sqrt(sum(c.u**2 for c in self.budget)))

    @property
    def degrees_of_freedom(self) -> float:
        """Effective degrees of freedom."""
        shares = sum(c.u**4 / c.degrees_of_freedom for c in self.budget)
        return float(self.u**4 / shares) if shares > 0 else float("inf")

    @property
    def k(self) -> float:
        """Coverage factor for 95 %."""
        return coverage_factor(self.degrees_of_freedom)

    @property
    def interval_text(self) -> str:
        """Coverage factor, expanded uncertainty and interval."""
        ends = f"95 % interval {self.low:.6g} to {self.high:.6g} {self.unit}".strip()
        return f"k = {self.k:.2f}, U95 = {self.k * self.u:.3g}; {ends}"

    @property
    def budget_lines(self) -> list[tuple[str, ...]]:
        """A line of text for each input, the largest first, by `BUDGET_COLUMNS`; last the combined uncertainty."""
        total = Contribution("combined standard uncertainty", self.u, self.degrees_of_freedom)
        return [
            (
                part.source,
                "" if np.isnan(part.u_input) else f"{part.u_input:.3g}",
                "" if np.isnan(part.sensitivity) else f"{part.sensitivity:.3g}",
                f"{part.u:.3g}",
                f"{100 * part.u**2 / self.u**2 if self.u else 0.0:.1f} %",
                f"{part.degrees_of_freedom:.3g}",
            )
            for part in [*sorted(self.budget, key=lambda part: -part.u), total]
        ]


def coverage_factor(degrees_of_freedom: float) -> float:
    """Half the 95 % interval of Student's distribution, in standard uncertainties."""
    return NORMAL_95 if np.isinf(degrees_of_freedom) else float(stdtrit(max(degrees_of_freedom, 1.0), 0.975))


def mean_of(sources: Sequence[Path], region: Region, *, elements_only: bool = False) -> list[MeanValue]:
    """Mean M or S over a region of products of one kind, and every quantity of it.

    Parameters
    ----------
    region : rows and columns, inside each frame.
    elements_only : of M without its quantities, which take most of the time.

    Raises
    ------
    ProcessError : no pixel of the region can be used, or the products differ in kind or wavelength.
    """
    means = [_Mean.of(source, region) for source in sources]
    first = means[0]
    for source, mean in zip(sources, means, strict=True):
        if mean.alike != first.alike:
            raise ProcessError(
                f"{source} and {sources[0]} are not of one kind and wavelength, or one of them is simulated, or states "
                "no uncertainty of its instrument. Give those that belong together."
            )
    together = _combine(means)
    each = [mean.numbers(elements_only) for mean in means] if len(means) > 1 else []
    return [
        _value(name, number, [e[name].value for e in each], together.inputs)
        for name, number in together.numbers(elements_only).items()
    ]


class _Number(NamedTuple):
    """A number of a mean: noise alone in `error` and `ends` (2,) of its 95 % interval; `moved` (D,) by each input."""

    value: float
    error: float
    moved: Array
    unit: str = ""
    ends: NDArray[np.floating] | None = None


@dataclass(frozen=True)
class _Mean:
    """Mean of a region of one capture, as an image of one pixel.

    Attributes
    ----------
    image : with the noise of the mean.
    moves : (D, K, 1, 1), what each uncertain input of the instrument does to the K unknowns; D = 0 without any.
    inputs : of the instrument that are uncertain, with their u, D of them.
    """

    image: MuellerImage | StokesImage
    moves: Array
    inputs: Inputs

    @property
    def alike(self) -> tuple[object, ...]:
        """Properties that captures of one mean share."""
        i = self.image
        rank = tuple(i.is_determined) if isinstance(i, MuellerImage) else ()
        return type(i), rank, round(i.header.wavelength_nm), i.simulated, bool(self.inputs)

    @classmethod
    def of(cls, source: Path, region: Region) -> _Mean:
        with Product(source) as product:
            product.require("mueller", "stokes")
            rows, columns = region
            systematic = Systematic.of_product(product)
            inputs = () if systematic is None else tuple((d.label, d.u) for d in systematic.directions)
            if product.kind == "stokes":
                s0 = "neighbour_correlation_s0"
                shared = product.array(s0) if product.has_array(s0) else neighbour_correlation(product)
                stokes = _stokes_mean(StokesImage.load(source, rows), columns, shared, source)
                values = stokes.values.reshape(3, 1)
                moved = () if systematic is None else list(systematic.moves(values, is_held=False))
                return cls(stokes, np.reshape(moved, (len(inputs), 3, 1, 1)), inputs)
            full = MuellerImage.of(product, rows)
            errors = product.get("stokes_errors", rows) if full.sent is not None else None
        image = _mueller_mean(light_of(full, errors), columns, source)
        if systematic is None:
            return cls(image, np.zeros((0, 16, 1, 1)), inputs)
        # What was fitted is the light where no element is determined alone.
        fitted = image if full.sent is None else replace(full, sent=image.values[:, 0], mask=image.mask)
        return cls(image, moves_of_light(systematic, fitted, is_held=False), inputs)

    def numbers(self, elements_only: bool) -> dict[str, _Number]:
        # Without light a ratio is NaN.
        with np.errstate(divide="ignore", invalid="ignore"):
            if isinstance(self.image, StokesImage):
                return _stokes_numbers(self.image, self.moves[..., 0, 0])
            elements = _element_numbers(self.image, self.moves)
            return elements if elements_only else elements | _quantity_numbers(self.image, self.moves)


def _good(mask: NDArray[np.uint8], values: NDArray[np.floating], source: Path) -> NDArray[np.bool_]:
    good = ((mask & ~np.uint8(Mask.STRUCK)) == 0) & np.isfinite(values).all(axis=0)
    if not good.any():
        raise ProcessError(f"{source}: no pixel of the region can be used. Choose another --region.")
    return np.asarray(good)


def _variance_of_sum(sigma: NDArray[np.floating], good: NDArray[np.bool_], correlation: Array) -> float:
    return float(shared_variance(np.where(good, 0, -1), sigma.astype(float), correlation)[good].sum())


def _mueller_mean(image: MuellerImage, columns: slice, source: Path) -> MuellerImage:
    values = image.values[..., columns].reshape(16, image.mask.shape[0], -1).astype(float)
    errors = image.errors[..., columns].reshape(values.shape).astype(float)
    good = _good(image.mask[:, columns], values[image.is_determined], source)
    count = int(good.sum())
    # Pixels of a Mueller image share no noise.
    total = np.square(errors[:, good]).sum(axis=1)
    return replace(
        image,
        values=values[:, good].mean(axis=1).reshape(4, 4, 1, 1).astype(np.float32),
        errors=(np.sqrt(total) / count).reshape(4, 4, 1, 1).astype(np.float32),
        mask=np.zeros((1, 1), np.uint8),
        residual_rms=np.sqrt(np.mean(np.square(image.residual_rms[:, columns][good])) / count).reshape(1, 1),
        noise_slope=image.noise_slope / count,
        noise_floor=image.noise_floor / count,
        dark=image.dark / np.sqrt(count),
    )


def _stokes_mean(image: StokesImage, columns: slice, correlation_s0: Array, source: Path) -> StokesImage:
    values, covariance = image.values[..., columns].astype(float), image.covariance[:, columns].astype(float)
    good = _good(image.mask[:, columns], values, source)
    count = int(good.sum())
    kernels = (correlation_s0, image.neighbour_correlation, image.neighbour_correlation)
    var = np.array([_variance_of_sum(np.sqrt(covariance[..., k, k]), good, kernel) for k, kernel in enumerate(kernels)])
    plain = covariance[good].sum(axis=0)
    wider = np.sqrt(var / np.diag(plain))
    return replace(
        image,
        values=values[:, good].mean(axis=1).reshape(3, 1, 1),
        covariance=(plain * np.outer(wider, wider) / count**2)[None, None],
        mask=np.zeros((1, 1), np.uint8),
    )


def _combine(means: Sequence[_Mean]) -> _Mean:
    """The mean of several captures; what one instrument does to all of its own does not average.

    Each counts alike, whatever its light: they are scaled to one m00 or S0.
    """
    first, count = means[0], len(means)
    if count == 1:
        return first
    level = np.array([float(mean.image.values.reshape(-1)[0]) for mean in means])
    scale = level.mean() / level
    values = np.mean([c * mean.image.values for c, mean in zip(scale, means, strict=True)], axis=0)
    u_of = {name: u for mean in means for name, u in mean.inputs}
    names, moved = align_inputs([tuple(name for name, _ in mean.inputs) for mean in means], [m.moves for m in means])
    moves = np.mean([c * move for c, move in zip(scale, moved, strict=True)], axis=0)
    first, image = replace(first, inputs=tuple((name, u_of[name]) for name in names)), first.image
    if isinstance(image, StokesImage):
        pairs = [(c, m.image) for c, m in zip(scale, means, strict=True) if isinstance(m.image, StokesImage)]
        covariances = [c**2 * part.covariance for c, part in pairs]
        covariance = np.sum(covariances, axis=0) / count**2
        return replace(first, image=replace(image, values=values, covariance=covariance), moves=moves)
    same = [(c, m.image) for c, m in zip(scale, means, strict=True) if isinstance(m.image, MuellerImage)]
    variance = np.sum([np.square(c * part.errors) for c, part in same], axis=0)
    image = replace(
        image,
        values=values.astype(np.float32),
        errors=(np.sqrt(variance) / count).astype(np.float32),
        residual_rms=image.residual_rms / np.float32(np.sqrt(count)),
        noise_slope=image.noise_slope / count,
        noise_floor=image.noise_floor / count,
        dark=image.dark / np.sqrt(count),
    )
    return replace(first, image=image, moves=moves)


def _stokes_numbers(image: StokesImage, moves: Array) -> dict[str, _Number]:
    s, c = image.values.reshape(3).astype(float), image.covariance.reshape(3, 3)
    numbers = {"s0": _Number(s[0], float(np.sqrt(c[0, 0])), moves[:, 0], "count")}
    moves = moves - moves[:, :1] * s / s[0]
    for k in (1, 2):
        ratio = s[k] / s[0]
        error = np.sqrt(c[k, k] - 2 * ratio * c[0, k] + ratio**2 * c[0, 0]) / s[0]
        numbers[f"s{k}_over_s0"] = _Number(ratio, float(error), moves[:, k] / s[0])
    packed = np.array([c[0, 0], c[1, 1], c[2, 2], c[0, 1], c[0, 2], c[1, 2]])
    light = linear_polarization(s[:1], s[1:2], s[2:], packed[:, None])
    for name, moved in zip(("dolp", "aolp_deg"), moved_polarization(s, moves), strict=True):
        value, error, ends = (light[f"{name}{part}"].reshape(-1) for part in ("", "_errors", "_95"))
        unit = "degree" if name == "aolp_deg" else ""
        numbers[name] = _Number(float(value[0]), float(error[0]), moved, unit, ends)
    return numbers


def _element_numbers(image: MuellerImage, moves: Array) -> dict[str, _Number]:
    numbers, m = {}, image.values.reshape(16).astype(float)
    light = is_first_column(image.is_determined)
    for k in np.flatnonzero(image.is_determined).tolist():
        gradient = np.zeros(16)
        value = m[0] if k == 0 else m[k] / m[0]
        gradient[0] = 1.0 if k == 0 else -value / m[0]
        if k:
            gradient[k] = 1 / m[0]
        error = float(np.sqrt(image.variance_of(gradient.reshape(1, 1, 16)).item()))
        moved = np.asarray(moves[..., 0, 0] @ gradient)
        if light:
            name, unit = ("s0", "count") if k == 0 else (f"s{k // 4}_over_s0", "")
        else:
            name, unit = ("m00", "count") if k == 0 else (f"m{k // 4}{k % 4}_over_m00", "")
        numbers[name] = _Number(float(value), error, moved, unit)
    return numbers


def _quantity_numbers(image: MuellerImage, moves: Array) -> dict[str, _Number]:
    numbers: dict[str, _Number] = {}
    light = is_first_column(image.is_determined)
    by_input: dict[str, NDArray[Any]] = {}
    if image.is_determined.all():
        planes = quantities_block(image, (), PAPER_PAIRS, moves, by_input=by_input)
    else:
        names = light_quantities(image.is_determined) if light else determined_maps(image.is_determined, PAPER_PAIRS)
        planes = partial_block(image, names, PAPER_PAIRS, moves, by_input=by_input)
    if light:
        planes, by_input = rename_planes(planes), rename_planes(by_input)
    for name in by_input:
        # 16 elements of the dominant process would make a table that nobody reads.
        if planes[name].size == 16:
            continue
        values, errors = planes[name].reshape(-1).tolist(), planes[f"{name}_errors"].reshape(-1).tolist()
        ends = planes[f"{name}_95"].reshape(2, -1) if f"{name}_95" in planes else None
        unit = "degree" if name.endswith("_deg") else ""
        for j, (value, error) in enumerate(zip(values, errors, strict=True)):
            label = name if len(values) == 1 else f"{name}_{j}"
            end = None if ends is None else ends[:, j]
            numbers[label] = _Number(value, error, by_input[name].reshape(len(values), -1)[j].astype(float), unit, end)
    return numbers


def _value(name: str, number: _Number, raw: Sequence[float], inputs: Inputs) -> MeanValue:
    """Put together the budget of one number; `raw` are the values of the single captures."""
    random, scatter = Contribution("noise of light and camera", number.error), float("nan")
    if raw:
        off = np.array(raw) - number.value
        if name in ANGLES or name == "aolp_deg":
            period = 90 if name == EITHER_AXIS else 180
            off -= period * np.round(off / period)
        scatter = float(np.std(off, ddof=1))
        between = Contribution(f"noise and scatter of {len(raw)} captures", scatter / np.sqrt(len(raw)), len(raw) - 1.0)
        # Few captures say little of their scatter: whichever makes the wider interval.
        if coverage_factor(between.degrees_of_freedom) * between.u > NORMAL_95 * number.error:
            random = between
    budget = [random]
    for (label, u), moved in zip(inputs, number.moved.tolist(), strict=True):
        budget.append(Contribution(label, abs(moved), np.inf, u, moved / u))
    systematic = float(np.sqrt(np.sum(np.square(number.moved))))
    mean = MeanValue(name, number.unit, number.value, number.error, systematic, scatter, np.nan, np.nan, tuple(budget))
    half = mean.k * mean.u
    low, high = number.value - half, number.value + half
    if number.ends is not None:
        more = max(half**2 - (NORMAL_95 * number.error) ** 2, 0.0)
        low = number.value - float(np.sqrt((number.value - number.ends[0]) ** 2 + more))
        high = number.value + float(np.sqrt((number.ends[1] - number.value) ** 2 + more))
        low = max(low, 0.0) if number.ends[0] == 0 else low
        if not np.isfinite(number.value):
            low, high = number.ends.tolist()
    return replace(mean, low=low, high=high)
