"""Mueller and Stokes images read back from product files, with what error propagation needs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array, BoolArray
from processing.storage.captures.schema import CaptureHeader
from processing.storage.products.pixel_mask import Mask
from processing.storage.products.product import Plane, Product, ProductError, Step

#: Relative size below which a singular value of W is rounding.
SMALLEST = 1e-8
#: Planes of every Mueller product.
MUELLER_PLANES = {
    "mueller": Plane((4, 4), "count", "Mueller matrix, row-major, not normalized"),
    "mueller_errors": Plane((4, 4), "count", "standard errors of mueller"),
    "residual_rms": Plane((), "count", "root mean square over the states of intensity minus fit"),
    "pixel_flags": Plane((), "", f"0 = good; bits: {Mask.meaning()}", np.uint8),
}


def require_all_elements(product: Product) -> None:
    """Raise ProductError for the image of a partial polarimeter, which has no whole Mueller matrices."""
    product.require("mueller")
    if int(product.facts.get("rank", 16)) < 16:
        hint = (
            "With a model of the surface, `process xi0` and `process fit-material` take it."
            if "stokes" in product.names
            else "`process quantities` gives what follows from those that it has."
        )
        raise ProductError(
            f"{product.path} is of a partial polarimeter: it determines {product.facts.get('determined', 'less')}, and "
            f"this needs all 16 elements. {hint}"
        )


def seen_elements(facts: Mapping[str, Any]) -> BoolArray:
    """(16,) True for the elements that a Mueller product determines; all of them but for a partial polarimeter."""
    if int(facts.get("rank", 16)) == 16:
        return np.ones(16, dtype=bool)
    names = [f"m{k // 4}{k % 4}" for k in range(16)]
    return np.isin(names, str(facts["determined"]).split(", "))


@dataclass(frozen=True)
class MuellerImage:
    """A reduced Mueller image, or some rows of it.

    Attributes
    ----------
    values : (4, 4, rows, columns) float32, counts, not normalized; NaN where nothing was determined.
    errors
        Same shape, standard errors; NaN where they are not known.
    mask : (rows, columns) uint8, bits of `processing.storage.products.pixel_mask.Mask`.
    residual_rms : (rows, columns), counts.
    w : (N, 16), measurement matrix, rows scaled with the exposure.
    noise_slope, noise_floor : (N,), variance of intensity n = slope * signal + floor; NaN where noise is not known.
    header, steps, simulated, facts
        As in the product.
    sent : (4, rows, columns), Stokes vector that the sample sends back, where no element is determined alone.
    dark : (16, K), counts, errors of the elements that one standard error of each mean of dark frames makes.

    Examples
    --------
    >>> image = MuellerImage.load(Reduction("sphere.h5").make())
    >>> image.values.shape, image.errors.shape, image.w.shape
    ((4, 4, 24, 32), (4, 4, 24, 32), (40, 16))
    """

    values: NDArray[np.float32]
    errors: NDArray[np.float32]
    mask: NDArray[np.uint8]
    residual_rms: NDArray[np.float32]
    w: NDArray[np.float64]
    noise_slope: NDArray[np.float64]
    noise_floor: NDArray[np.float64]
    header: CaptureHeader
    steps: tuple[Step, ...]
    simulated: bool
    facts: dict[str, Any]
    sent: NDArray[np.float32] | None = None
    dark: NDArray[np.float64] = field(default_factory=lambda: np.zeros((16, 0)))

    @classmethod
    def load(cls, path: Path | str, rows: slice = slice(None)) -> Self:
        """Read a product of `process reduce`. Raises ProductError for another kind of file."""
        with Product(path) as product:
            product.require("mueller")
            return cls.of(product, rows)

    @classmethod
    def of(cls, product: Product, rows: slice = slice(None)) -> Self:
        """From an open product; block by block for large images."""
        return cls(
            values=product.get("mueller", rows),
            errors=product.get("mueller_errors", rows),
            mask=product.get("pixel_flags", rows),
            residual_rms=product.get("residual_rms", rows),
            w=product.array("measurement_matrix").reshape(-1, 16),
            noise_slope=product.array("noise_slope"),
            noise_floor=product.array("noise_floor"),
            header=product.header,
            steps=product.steps,
            simulated=product.simulated,
            facts=product.facts,
            sent=product.get("stokes", rows) if "stokes" in product.names else None,
            dark=product.array("dark_errors") if product.has_array("dark_errors") else np.zeros((16, 0)),
        )

    @property
    def matrices(self) -> NDArray[np.float32]:
        """View (rows, columns, 4, 4)."""
        return np.moveaxis(self.values, (0, 1), (-2, -1))

    @property
    def is_determined(self) -> BoolArray:
        """(16,) True for the elements that are determined."""
        return seen_elements(self.facts)

    def at(self, pixels: NDArray[np.int64]) -> Self:
        """The image of some pixels alone (n rows of one), given by their numbers in row-major order."""
        count = self.mask.size

        def pick(values: NDArray[Any]) -> NDArray[Any]:
            return values.reshape(*values.shape[:-2], count)[..., pixels, None]

        return replace(
            self,
            values=pick(self.values),
            errors=pick(self.errors),
            mask=pick(self.mask),
            residual_rms=pick(self.residual_rms),
            sent=None if self.sent is None else pick(self.sent),
        )

    def averaged(self, mean: Callable[[NDArray[np.floating]], Array]) -> Self:
        """The image of one mean pixel of each group (rows of one); its errors are those of a single pixel.

        Parameters
        ----------
        mean : over groups of pixels, from (..., pixels) to (..., groups).
        """

        def root(values: NDArray[np.floating], *leading: int) -> NDArray[np.float32]:
            rms = np.sqrt(mean(np.square(values.reshape(*leading, -1))))
            return rms.astype(np.float32)[..., None]

        values = mean(self.values.reshape(4, 4, -1)).astype(np.float32)[..., None]
        mask = np.zeros(values.shape[2:], np.uint8)
        return replace(
            self, values=values, errors=root(self.errors, 4, 4), mask=mask, residual_rms=root(self.residual_rms)
        )

    @property
    def fitted(self) -> NDArray[np.floating]:
        """Intensities (N, pixels) that the fit gives, counts."""
        if self.sent is not None:
            # Rows of W are kron(a, g): every fourth column is a, times the light's intensity.
            return np.asarray(self.w[:, ::4] @ np.nan_to_num(self.sent.reshape(4, -1)))
        return np.asarray(self.w.astype(np.float32) @ np.nan_to_num(self.values.reshape(16, -1)))

    @cached_property
    def intensity_variance(self) -> NDArray[np.float32]:
        """Variance (N, pixels) of every intensity, from the fitted intensities and the noise of the reduction."""
        rows, columns = self.mask.shape
        n = self.w.shape[0]
        if np.isnan(self.noise_slope).any():
            free = max(n - int(self.facts.get("rank", 16)), 0)
            with np.errstate(divide="ignore", invalid="ignore"):
                level = self.residual_rms.reshape(-1).astype(float) ** 2 * n / free if free else np.nan
            return np.asarray(np.broadcast_to(level, (n, rows * columns)), dtype=np.float32)
        variance = self.noise_slope[:, None].astype(np.float32) * self.fitted.astype(np.float32)
        floor = self.noise_floor[:, None].astype(np.float32)
        variance += floor
        return np.asarray(np.maximum(variance, 0.5 * floor, out=variance))

    def covariance(self) -> NDArray[np.floating]:
        """Covariance (rows, columns, 16, 16) of the elements, counts^2, row-major order m00, m01, ... m33.

        Rebuilt from W, the noise model and the fitted intensities, then scaled so that its diagonal is `errors`
        squared (which also holds what flats and left-out states add).
        """
        return self._covariance

    @cached_property
    def _covariance(self) -> NDArray[np.floating]:
        # Loops over pixels run along the memory.
        full: NDArray[np.floating]
        if self.facts["weighted"]:
            normal = np.einsum("np,ni,nj->pij", 1 / self.intensity_variance, self.w, self.w, optimize=True)
            is_complete = int(self.facts.get("rank", 16)) == 16
            each = np.linalg.inv(normal) if is_complete else np.linalg.pinv(normal, rcond=SMALLEST**2, hermitian=True)
            full = np.moveaxis(each + self.dark @ self.dark.T, 0, -1)
        else:
            drive, variance = self._sources
            full = ((drive[:, None] * drive).reshape(256, -1) @ variance).reshape(16, 16, -1)
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = self.errors.reshape(16, -1) / np.sqrt(np.einsum("iip->ip", full))
        scale[~self.is_determined] = 0.0
        full *= scale
        full *= scale[:, None]
        return np.moveaxis(full, -1, 0).reshape(*self.mask.shape, 16, 16)

    def covariance_of_depolarizer(self) -> NDArray[np.float64]:
        """Covariance (16, 16) of the elements of an ideal depolarizer, in any unit: the same for every pixel.

        Where it sends as much light as makes shot and read noise alike. That matters for states of unequal exposure
        only: an ideal depolarizer sends the same light in all others.
        """
        variance = np.zeros(len(self.w))
        if not np.isnan(self.noise_slope).any():
            for part in (self.noise_slope * self.w[:, 0], self.noise_floor):
                variance += part / part.mean() if part.any() else 0.0
        if not variance.all():
            variance = np.ones(len(self.w))
        if self.facts["weighted"]:
            return np.asarray(np.linalg.inv((self.w.T / variance) @ self.w))
        return np.asarray((self._inverse * variance) @ self._inverse.T)

    def variance_of(self, gradient: NDArray[np.floating]) -> NDArray[np.float64]:
        """First-order variance (rows, columns) of a quantity with gradient (rows, columns, 16) by the elements.

        The same as gradient . covariance . gradient, without forming the covariance.
        """
        g = np.asarray(gradient).reshape(-1, 16)
        if self.facts["weighted"]:
            full = self._covariance.reshape(-1, 16, 16)
            return np.asarray(np.einsum("pi,pi->p", (full @ g[:, :, None])[..., 0], g).reshape(self.mask.shape))
        drive, variance = self._sources
        response = drive.T @ g.T.astype(np.float32)
        total = np.einsum("np,np,np->p", response, response, variance)
        return np.asarray((total * self.error_ratio).reshape(self.mask.shape))

    def covariance_with(self, gradient: NDArray[np.floating]) -> NDArray[np.float64]:
        """Covariance (rows, columns, 16) of the elements with a quantity of gradient (rows, columns, 16)."""
        g = np.asarray(gradient).reshape(-1, 16)
        if self.facts["weighted"]:
            return np.asarray((self._covariance.reshape(-1, 16, 16) @ g[:, :, None]).reshape(gradient.shape))
        drive, variance = self._sources
        covariance = drive @ (variance * (drive.T @ g.T.astype(np.float32)))
        return np.asarray((covariance * self.error_ratio).T.reshape(gradient.shape), dtype=float)

    def covariances_between(self, pairs: Sequence[tuple[int, int]]) -> NDArray[np.float64]:
        """Covariances (pairs, pixels) of elements, given by their numbers in row-major order; counts^2."""
        first, second = np.array(pairs).T
        if self.facts["weighted"]:
            return np.asarray(self._covariance.reshape(-1, 16, 16)[:, first, second].T)
        drive, variance = self._sources
        return np.asarray((drive[first] * drive[second]) @ variance * self.error_ratio)

    def product_of(self, form: NDArray[np.float64], gradient: NDArray[np.floating]) -> NDArray[np.float64]:
        """Sum over elements a, b, k of covariance[a, b] form[a, b, k] gradient[k]: (rows, columns).

        Parameters
        ----------
        form : (16, 16, 16), symmetric in a and b.
        gradient : (rows, columns, 16).
        """
        g = np.asarray(gradient).reshape(-1, 16)
        if self.facts["weighted"]:
            full = self._covariance.reshape(-1, 256) @ form.reshape(256, 16)
            return np.asarray(np.einsum("pk,pk->p", full, g).reshape(self.mask.shape))
        drive, variance = self._sources
        each = np.multiply(drive[:, None], drive, dtype=float).reshape(256, -1).T @ form.reshape(256, 16)
        total = np.einsum("np,np->p", each.astype(np.float32) @ g.T.astype(np.float32), variance)
        return np.asarray((total * self.error_ratio).reshape(self.mask.shape))

    def drawn_noise(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """One draw (16, pixels) of the noise of the elements, counts, with their covariance."""
        if self.facts["weighted"]:
            factor = np.linalg.cholesky(np.nan_to_num(self._covariance.reshape(-1, 16, 16)) + 1e-12 * np.eye(16))
            return np.asarray(np.einsum("pij,jp->ip", factor, rng.normal(size=(16, len(factor)))))
        drive, variance = self._sources
        noise = drive @ (np.sqrt(variance) * rng.normal(size=variance.shape))
        return np.asarray(noise * np.sqrt(self.error_ratio))

    @cached_property
    def error_ratio(self) -> NDArray[np.float64]:
        """Variance of each pixel's elements (pixels,) over that of intensities and darks alone.

        Flats and left-out states change all errors of a pixel much alike.
        """
        valid = self.is_determined
        if not valid.any():
            return np.ones(self.mask.size)
        drive, variance = self._sources
        plain = np.square(drive[valid]).sum(axis=0) @ variance
        return np.asarray(np.square(self.errors.reshape(16, -1)[valid]).sum(axis=0) / plain)

    @cached_property
    def _sources(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """What independent errors do to the elements (16, N + K), and their variances (N + K, pixels).

        They are those of the intensities and of the means of dark frames.
        """
        drive = np.concatenate([self._inverse, self.dark], axis=1).astype(np.float32)
        ones = np.ones((self.dark.shape[1], self.mask.size), np.float32)
        variance = np.concatenate([self.intensity_variance, ones]) if len(ones) else self.intensity_variance
        return drive, variance

    @cached_property
    def _inverse(self) -> NDArray[np.float64]:
        return np.asarray(np.linalg.pinv(self.w, rcond=SMALLEST))


def difference_errors(images: Sequence[MuellerImage], gradients: Sequence[NDArray[np.floating]]) -> NDArray[np.float64]:
    """Standard errors (rows, columns) of the difference of a quantity of two products of one capture.

    Both come from the same intensities and darks, which they only weigh differently. NaN where that is not known:
    weighted products, or products of other states.

    Parameters
    ----------
    gradients : of the quantity by the elements of each image, (rows, columns, 16).
    """
    first, second = images
    if len(first.w) != len(second.w) or first.facts["weighted"] or second.facts["weighted"]:
        return np.full(first.mask.shape, np.nan)
    a, b = (image._inverse.T @ gradient.reshape(-1, 16).T for image, gradient in zip(images, gradients, strict=True))
    apart = np.einsum("np,np->p", np.square(a - b), first.intensity_variance)
    apart += np.square((first.w @ first.dark).T @ (a - b)).sum(axis=0)
    return np.asarray(np.sqrt(apart * first.error_ratio).reshape(first.mask.shape))


def element_gradient(image: MuellerImage, element: int) -> NDArray[np.float64]:
    """Gradient (rows, columns, 16) of an element over m00, or of m00."""
    m = image.values.reshape(16, *image.mask.shape).astype(float)
    gradient = np.zeros((*image.mask.shape, 16))
    gradient[..., element] = 1.0 if element == 0 else 1 / m[0]
    if element:
        gradient[..., 0] = -m[element] / m[0] ** 2
    return gradient


def neighbour_correlation(product: Product) -> NDArray[np.float64]:
    """Correlation (2 R + 1, 2 R + 1) of the noise of pixels by their distance; [[1]] where a product holds none."""
    if product.has_array("neighbour_correlation"):
        return product.array("neighbour_correlation")
    return np.ones((1, 1))


@dataclass(frozen=True)
class StokesImage:
    """A reduced linear Stokes image.

    Attributes
    ----------
    values : (3, rows, columns) float32, S0, S1, S2 in counts; NaN where masked.
    covariance : (rows, columns, 3, 3), counts^2.
    w, analyzers : (channels, 16) and (channels, 3), from the Mueller matrix and from S to intensities.
    mask : (rows, columns) uint8, bits of `processing.storage.products.pixel_mask.Mask`.
    neighbour_correlation : (2 R + 1, 2 R + 1), of the noise of S1 and S2 between pixels, by rows and columns.

    Examples
    --------
    >>> image = StokesImage.load(Reduction("mosaic.h5").make())
    >>> image.values.shape, image.covariance.shape
    ((3, 24, 32), (24, 32, 3, 3))
    """

    values: NDArray[np.float32]
    covariance: NDArray[np.float32]
    mask: NDArray[np.uint8]
    w: NDArray[np.float64]
    analyzers: NDArray[np.float64]
    neighbour_correlation: NDArray[np.float64]
    header: CaptureHeader
    steps: tuple[Step, ...]
    simulated: bool
    facts: dict[str, Any]

    @classmethod
    def load(cls, path: Path | str, rows: slice = slice(None)) -> Self:
        """Read a product of `process reduce` of a mosaic capture. Raises ProductError for another kind of file."""
        with Product(path) as product:
            product.require("stokes")
            packed = product.get("stokes_covariance", rows)
            return cls(
                values=np.stack([product.get(name, rows) for name in ("s0", "s1", "s2")]),
                covariance=np.moveaxis(packed[[0, 3, 4, 3, 1, 5, 4, 5, 2]], 0, -1).reshape(*packed.shape[1:], 3, 3),
                mask=product.get("pixel_flags", rows),
                w=product.array("measurement_matrix"),
                analyzers=product.array("analyzers"),
                neighbour_correlation=neighbour_correlation(product),
                header=product.header,
                steps=product.steps,
                simulated=product.simulated,
                facts=product.facts,
            )
