"""Intensities of an object against the triply degenerate model: excess over the noise, its gradient and curvature.

At every pixel I = alpha_0 W m0 + alpha_ID W mID (paper Sec. IV) with m0 from the reflectance model. xi0 and M00, that
is both coefficients, are free at every pixel and projected out, exactly as a free Mueller matrix is in
`InstrumentProblem`: what is left tests the dominant process alone. Derivatives as there (Kaufman).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.decision import in_deviations
from processing.diagnosis.search.range_of import NEARLY_ZERO, range_of, rank_of
from processing.diagnosis.search.rules import FEWEST_OF_MANY, FOLDS_OF_TILES, STEP
from processing.diagnosis.search.space import Space, Sums
from processing.diagnosis.surface.data import SurfaceData
from processing.effect import Parameter
from processing.errors import ProcessError
from processing.instrument.applied_effects import changes_of, instrument_effects
from processing.instrument.changes import Changes
from processing.instrument.model import InstrumentModel
from processing.reflectance.changes import ReflectanceChanges
from processing.reflectance.effects.base import ReflectanceEffect, reflectance_effects

#: Tests of the residual: what some Mueller matrix could cause, and what none could.
SMOOTH, OF_INSTRUMENT = "smooth over the object", "smooth over the object, of the instrument"


@dataclass(frozen=True)
class SurfacePixels:
    """One capture at one set of values, all in units of the noise.

    Attributes
    ----------
    e, f : (P, L) unit vectors that the two coefficients span; f is zero where the model modulates nothing.
    hold : (P,) 0 to 1, how little the second coefficient is free: see `SurfaceProblem.pixels`.
    residual, free : (P, L), and the part of each row's noise that is left in it.
    alpha_0, alpha_id : (P,); strength : (P,) length of the second column.
    most : (P,) the alpha_0 of a pixel whose light is m0's alone.
    """

    e: Array
    f: Array
    hold: Array
    residual: Array
    free: Array
    alpha_0: Array
    alpha_id: Array
    strength: Array
    most: Array
    columns: Array
    flat: Array
    extra: Array

    def outside(self, v: Array) -> Array:
        """Projection of v (P, L) outside the two coefficients."""
        projected = v - self.e * np.sum(self.e * v, axis=1, keepdims=True)
        along = np.sum(self.f * projected, axis=1) * (1 - np.sqrt(self.hold))
        return np.asarray(projected - self.f * along[:, None])


class SurfaceProblem:
    """Captures of one object with one instrument against instrument and reflectance model."""

    holds_out_states = False
    noise_known = True
    spread = 1.0
    folds = FOLDS_OF_TILES
    held_out = "every tile of the object is predicted by a fit to the other tiles (2 parts, like a chessboard)"

    def __init__(self, model: InstrumentModel, captures: Sequence[SurfaceData]) -> None:
        self.model, self.captures = model, tuple(captures)
        self.shape = captures[0].view.view.shape.kind
        self.captures = self._polarized()
        captures = self.captures
        self.sigma: list[Array] = [np.sqrt(c.variance) for c in captures]
        # Weights from the fitted signals: from the noisy ones they would go with the noise.
        empty, none = Space(()), np.zeros(0)
        first = [self.pixels(k, empty, none) for k in range(len(captures))]
        fitted = [c.y - p.residual * s for c, p, s in zip(captures, first, self.sigma, strict=True)]
        for c, p in zip(captures, first, strict=True):
            c.view.learn_polarized(p.alpha_0, p.strength**2)
        self.sigma = [np.sqrt(c.slope * np.maximum(u, 0) + c.floor) for c, u in zip(self.captures, fitted, strict=True)]
        self.noise = [c.variance / s**2 for c, s in zip(self.captures, self.sigma, strict=True)]

    def _polarized(self) -> tuple[SurfaceData, ...]:
        """The captures with the pixels that can speak; those without enough of them are left out."""
        subsets = []
        for k, data in enumerate(self.captures):
            w = self.rows(k, Space(()), np.zeros(0))
            subset = data.select(data.polarized(w[:, 0]))
            if len(subset.y) >= FEWEST_OF_MANY:
                subsets.append(subset)
        if not subsets:
            raise ProcessError(
                "no polarization stands out of the noise of these captures, so they say nothing about the dominant "
                "process. Take them with more light, more frames, or another polarization of the source."
            )
        return tuple(subsets)

    def pool(self) -> tuple[Candidate, ...]:
        """The effects of the reflectance, and those of the optics: with m0 known, an unknown xi0 hides few of them."""
        conditions = self.captures[0].conditions
        candidates = []
        for effect in reflectance_effects().values():
            candidates += [Candidate(effect, p, self._physical(effect, p)) for p in effect.places_on(self.shape)]
        for optics in instrument_effects().values():
            if optics.of_optics:
                # Sentences without a name imitate smooth patterns over an object.
                every = optics.places(self.model, conditions)
                places = [p for p in every if not optics.log_price(self.model, conditions, p)]
                candidates += [Candidate(optics, p, optics.parameters(self.model, conditions, p)) for p in places]
        return tuple(sorted(candidates, key=lambda candidate: candidate.kind))

    def _physical(self, effect: ReflectanceEffect, place: str) -> tuple[Parameter, ...]:
        """The parameters, with bounds that keep k and a of the material from becoming negative."""
        view = self.captures[0].view
        return effect.physical(effect.parameters(place), view.index, view.a)

    def powers(self) -> list[tuple[int, Array]]:
        """Rows that the unknowns leave over, and equal power of the smooth patterns that a misfit can have."""
        powers = []
        for k in range(len(self.captures)):
            w = self.rows(k, Space(()), np.zeros(0))
            # Up to second order in the position.
            powers.append((max(rank_of(w) - 2, 1), np.ones(6)))
        return powers

    def changes(self, capture: int, space: Space, values: Array) -> tuple[Changes, ReflectanceChanges]:
        """Changes of the instrument, with its own effects, and of the reflectance."""
        data = self.captures[capture]
        optics, surface = changes_of(self.model, data.conditions, data.name), ReflectanceChanges()
        for candidate, part in space.pairs:
            effect = candidate.effect
            if isinstance(effect, ReflectanceEffect):
                effect.bend(surface, candidate.place, values[part])
            else:
                candidate.apply(optics, self.model, values[part])
        return optics, surface

    def noise_floor(self, space: Space, values: Array, k: int | None = None) -> float:
        """Rms noise over the mean signal, of one capture or of all; no effect changes it."""
        captures = self.captures if k is None else self.captures[k : k + 1]
        return float(np.sqrt(np.mean([np.mean(c.variance) / np.mean(c.y) ** 2 for c in captures])))

    def rows(self, k: int, space: Space, values: Array) -> Array:
        """Measurement matrix W (L, 16) of a capture."""
        return self.rows_of(k, self.changes(k, space, values)[0])

    def rows_of(self, capture: int, changes: Changes) -> Array:
        """The same of the changes of a capture."""
        data = self.captures[capture]
        return self.model.rows(data.conditions.angles_deg, changes).reshape(-1, 16) * data.exposure[:, None]

    def _columns(self, k: int, space: Space, values: Array) -> tuple[Array, Array, Array]:
        """Both columns and the light from elsewhere, each (P, L), in units of the noise."""
        optics, surface = self.changes(k, space, values)
        w, data = self.rows_of(k, optics), self.captures[k]
        columns = data.view.dominant(surface).reshape(-1, 16) @ w.T / self.sigma[k]
        extra = data.view.extra(surface)
        light = np.zeros_like(columns) if extra is None else extra.reshape(-1, 16) @ w.T / self.sigma[k]
        return columns, w[:, 0] / self.sigma[k], light

    def pixels(self, k: int, space: Space, values: Array) -> SurfacePixels:
        """Projection and residual of one capture.

        Where the modelled light is hardly polarized, or p-polarized near the Brewster angle, noise
        would be met by any amount of alpha_0. So alpha_0 is q M with M the pixel's light, and q is within 1 of its mean
        over the tile, as xi0 from 0 to 1 allows. Elsewhere, where the light is seen at all, this holds nothing.
        """
        columns, flat, light = self._columns(k, space, values)
        data = self.captures[k]
        y = data.y / self.sigma[k] - light
        length = np.sqrt(np.sum(flat**2, axis=1))
        e = flat / length[:, None]
        f = columns - e * np.sum(e * columns, axis=1, keepdims=True)
        strength = np.sqrt(np.sum(f**2, axis=1))
        modulates = strength > NEARLY_ZERO * np.sqrt(np.sum(columns**2, axis=1))
        f = np.where(modulates[:, None], f / np.maximum(strength, 1e-300)[:, None], 0.0)
        level, modulation = np.sum(e * y, axis=1), np.sum(f * y, axis=1)
        # Mean of q over each tile, from the same weighted squares.
        most = np.maximum(level, 0.0) / length
        full = np.where(modulates, strength * most, 0.0)
        hold, weight = _held(full, data.tile)
        q = np.bincount(data.tile, hold * full * modulation)[data.tile] / weight
        alpha_0 = hold * most * (full * modulation + q)
        alpha_id = (level - alpha_0 * np.sum(e * columns, axis=1)) / length
        along = modulation - np.sqrt(hold) * (modulation - full * q)
        return SurfacePixels(
            e=e,
            f=f,
            hold=hold,
            residual=y - e * level[:, None] - f * along[:, None],
            free=1 - e**2 - f**2 * (1 - _noise_left(full, data.tile))[:, None],
            alpha_0=alpha_0,
            alpha_id=alpha_id,
            strength=strength,
            most=most,
            columns=columns,
            flat=flat,
            extra=light,
        )

    def relinearize(self, space: Space, values: Array) -> bool:
        """Nothing is expanded here."""
        return False

    def sums(self, space: Space, values: Array, *, derivatives: bool = True) -> Sums:
        """Excess, and with `derivatives` its half gradient and curvature, of every fold."""
        size = space.size if derivatives else 0
        sums = Sums.empty(self.folds, size, len(self.captures))
        for k, data in enumerate(self.captures):
            part, px = Sums.empty(self.folds, size), self.pixels(k, space, values)
            expected = np.sum(px.free * self.noise[k], axis=1)
            square = np.sum((px.residual * self.sigma[k]) ** 2, axis=1) / float(np.mean(data.y)) ** 2
            for total, each in (
                (part.excess, np.sum(px.residual**2, axis=1) - expected),
                (part.freedom, expected),
                (part.square, square),
                (part.count, px.free.sum(axis=1)),
            ):
                np.add.at(total, data.fold, each)
            d, less = self.derivatives(k, space, values, px) if size else (np.zeros((0, *px.residual.shape)),) * 2
            for fold in range(self.folds if size else 0):
                slopes = d[:, data.fold == fold].reshape(size, -1)
                part.gradient[fold] = slopes @ px.residual[data.fold == fold].reshape(-1)
                part.gradient[fold] -= less[:, data.fold == fold].sum(axis=1) / 2
                part.curvature[fold] = slopes @ slopes.T
            sums.add(k, part, space.acting(k, data.wavelength_nm))
        return sums

    def derivatives(self, k: int, space: Space, values: Array, px: SurfacePixels) -> tuple[Array, Array]:
        """Derivatives (K, P, L) of the residual by every value, and (K, P) of the noise that is expected in it."""
        d, less = np.empty((space.size, *px.residual.shape)), np.empty((space.size, len(px.most)))
        tile = self.captures[k].tile
        before, noise = _noise_left(px.strength * px.most, tile), self.noise[k].mean(axis=1)
        for j, (step, columns, flat, light) in enumerate(self._moved(k, space, values)):
            change = (columns - px.columns) * px.alpha_0[:, None] + (flat - px.flat) * px.alpha_id[:, None]
            d[j] = -px.outside(change + light - px.extra) / step
            strength = np.sqrt(np.sum((columns - px.e * np.sum(px.e * columns, axis=1, keepdims=True)) ** 2, axis=1))
            less[j] = noise * (_noise_left(strength * px.most, tile) - before) / step
        return d, less

    def _moved(self, k: int, space: Space, values: Array) -> Iterator[tuple[float, Array, Array, Array]]:
        """A small step of each value in turn, and the columns and the light of a capture after it."""
        for j, step in enumerate(STEP * space.joined("typical")):
            moved = values.copy()
            moved[j] += step
            yield step, *self._columns(k, space, moved)

    def time_noise(self, space: Space, values: Array) -> Array:
        """None of these effects has a value for each state."""
        return np.zeros(space.size)

    def noise_information(self, space: Space, values: Array) -> tuple[Array, Array]:
        """Part (K, K) of the curvature that noise of alpha_0 makes, which no value stretches as a response does."""
        information = np.zeros((space.size, space.size))
        for k in range(len(self.captures)):
            pixels = self.pixels(k, space, values)
            free = (1 - pixels.hold) / np.where(pixels.strength > 0, pixels.strength, np.inf)
            moved = self._moved(k, space, values)
            d = [pixels.outside(columns - pixels.columns) * free[:, None] / step for step, columns, _, _ in moved]
            flat = np.reshape(d, (space.size, pixels.residual.size))
            information += flat @ flat.T
        return information, np.zeros_like(information)


def _held(full: Array, tile: NDArray[np.int64]) -> tuple[Array, Array]:
    """How little q is free at pixels (P,), and the weight behind its mean over the tile (P,)."""
    hold = 1 / (1 + full**2)
    return hold, np.asarray(np.bincount(tile, hold * full**2)[tile] + 1e-300)


def _noise_left(full: Array, tile: NDArray[np.int64]) -> Array:
    """Part (P,) of the noise along the second column that is left over once q and its mean are fitted."""
    hold, weight = _held(full, tile)
    return np.asarray(hold * (1 - hold * full**2 / weight))


def structure(problem: SurfaceProblem, k: int, space: Space, values: Array) -> tuple[dict[str, float], float]:
    """Tests of a capture's residual: name to standard deviations from what noise gives; and the chi-square left.

    Sums over tiles of the object, split into what some Mueller matrix could cause and what none could, which speaks
    against the instrument's model and not against the reflectance.
    """
    pixels, data = problem.pixels(k, space, values), problem.captures[k]
    r, noise = pixels.residual, problem.noise[k] * pixels.free
    of_noise = float(noise.sum())
    tests = {"sum of squares": (float(np.sum(r**2) - of_noise), float(np.sqrt(2 * of_noise)), of_noise)}
    basis = range_of(problem.rows(k, space, values) / np.mean(problem.sigma[k], axis=0)[:, None])
    rows, rank = basis.shape
    tiles = np.unique(data.tile)
    totals = np.stack([r[data.tile == t].sum(axis=0) for t in tiles])
    level = np.array([noise[data.tile == t].sum() for t in tiles]) / (rows - 2)
    inside = np.sum((totals @ basis) ** 2)
    for name, square, directions in (
        (SMOOTH, inside, rank - 2),
        (OF_INSTRUMENT, np.sum(totals**2) - inside, rows - rank),
    ):
        if directions > 0:
            # Sums over as many pixels as a tile has count as one.
            size, of_noise = len(r) / tiles.size, float(directions * level.sum())
            deviation = float(np.sqrt(2 * directions * np.sum(level**2)))
            tests[name] = float(square - of_noise) / size, deviation / size, of_noise / size
    return in_deviations(tests)
