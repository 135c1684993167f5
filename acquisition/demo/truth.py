"""Truth of the simulated rig: drawn faults, and the Mueller image and xi0 that a product is compared with."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from processing.storage.products.images import MuellerImage
from processing.storage.products.product import Product
from processing.yaml_file import ConfigError
from simulators.bench.effects.base import BenchEffect
from simulators.bench.scene import Scene
from simulators.bench.typical_faults import FAULTS

#: Errors are those of means over squares of this side, in pixels: the photon noise of one pixel hides most faults.
BLOCK = 8
#: A detector has one response curve.
EXCLUSIVE = frozenset({"detector_nonlinearity", "tone_curve"})


@dataclass(frozen=True)
class DrawnFault:
    """A fault of the rig, by the kind of the effect of `diagnose` that describes it, with its size in words."""

    kind: str
    effect: BenchEffect
    size: str


def drawable() -> list[str]:
    """Kinds of fault that a Mueller capture of the default plan can show."""
    return [kind for kind, fault in FAULTS.items() if fault.mode == "drr" and not fault.hidden]


def draw_faults(seed: int, count: int, only: Sequence[str], states: int) -> tuple[DrawnFault, ...]:
    """Draw `count` faults of different kinds; same seed, same faults.

    Parameters
    ----------
    only : kinds to draw from; empty for all of `drawable` that are not slow.
    states : number of exposures of a capture.

    Raises
    ------
    ConfigError
        A kind is unknown or cannot be seen, or there are fewer kinds than faults.
    """
    kinds = drawable()
    for kind in only:
        if kind in FAULTS and kind not in kinds:
            raise ConfigError(f"--only {kind}: {FAULTS[kind].hidden or 'it needs a polarization camera'}.")
        if kind not in kinds:
            raise ConfigError(f"--only {kind}: there is no such fault, only {', '.join(kinds)}.")
    random = np.random.default_rng(seed)
    drawn: list[str] = []
    while len(drawn) < count:
        excluded = set(drawn) | (EXCLUSIVE if EXCLUSIVE & set(drawn) else set())
        candidates = [k for k in kinds if k not in excluded and (k in only if only else not FAULTS[k].slow)]
        if not candidates:
            raise ConfigError(f"--faults {count}: only {len(drawn)} different faults can act together.")
        drawn.append(str(random.choice(candidates)))
    return tuple(DrawnFault(kind, *FAULTS[kind].draw(random, states)) for kind in drawn)


@dataclass(frozen=True)
class TrueError:
    """Errors of one product against the truth, in means over `BLOCK` x `BLOCK` pixels within the object.

    Attributes
    ----------
    mueller : (4, 4, rows, columns) error of M / m00 of each block; NaN outside the object.
    xi0 : (rows, columns) error of xi0.
    mueller_noise, xi0_noise : rms standard error that photon noise alone gives these.
    """

    mueller: NDArray[np.float64]
    xi0: NDArray[np.float64]
    mueller_noise: float
    xi0_noise: float

    @property
    def mueller_rms(self) -> float:
        """Root mean square error of the 15 elements of M / m00."""
        return _rms(self.mueller.reshape(16, -1)[1:])

    @property
    def xi0_rms(self) -> float:
        """Root mean square error of xi0."""
        return _rms(self.xi0)


def true_error(mueller: Path, xi0: Path, scene: Scene) -> TrueError:
    """Compare the products of `process reduce` and `process xi0` of one capture with the scene."""
    image = MuellerImage.load(mueller)
    with Product(xi0) as product:
        header = product.header
        estimate, sigma = product.get("xi0"), product.get("xi0_errors")
    rows, columns = image.mask.shape
    place = (float(header.omega_deg or 0), header.wavelength_nm, rows, columns)
    truth = scene.truth(*place)
    true_m = np.moveaxis(scene.mueller_image(*place), (2, 3), (0, 1)).astype(float)
    inside = _blocks(truth.mask & (image.mask == 0)).all(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        m, t = (_blocks(x).mean(axis=-1) for x in (image.values.astype(float), true_m))
        error = m / m[0, 0] - t / t[0, 0]
        noise = np.sqrt((_blocks(image.errors.astype(float)) ** 2).mean(axis=-1)) / BLOCK / m[0, 0]
    deviation = _blocks(estimate - truth.xi0)
    return TrueError(
        np.where(inside, error, np.nan),
        np.where(inside, deviation.mean(axis=-1), np.nan),
        _rms(np.where(inside, noise, np.nan).reshape(16, -1)[1:]),
        _rms(np.where(inside, np.sqrt((_blocks(sigma) ** 2).mean(axis=-1)) / BLOCK, np.nan)),
    )


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def _blocks(values: NDArray[np.generic]) -> NDArray[np.generic]:
    """(..., block rows, block columns, BLOCK^2) of an image (..., rows, columns)."""
    lead, (rows, columns) = values.shape[:-2], (n // BLOCK for n in values.shape[-2:])
    cut = values[..., : rows * BLOCK, : columns * BLOCK].reshape(*lead, rows, BLOCK, columns, BLOCK)
    return np.moveaxis(cut, -3, -2).reshape(*lead, rows, columns, BLOCK**2)
