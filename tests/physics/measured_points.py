"""Measured or simulated points of a surface against the triply degenerate model with first-surface reflection.

Each point has its own throughput and depolarization: intensities = W [m0 mID] alpha with two free coefficients, which
are projected out; what is left depends on the dominant process m0 alone. The search is that of instruments.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.space import Space, Sums
from processing.geometry.frames import ScatteringGeometry
from processing.polarization import mueller
from processing.reflectance.changes import ReflectanceChanges
from processing.reflectance.effects.base import ReflectanceEffect, reflectance_effects

STEP = 1e-4
#: Parts of the points that are held out in turn.
FOLDS = 5


class ReflectanceProblem:
    """Points of one material at one wavelength.

    Parameters
    ----------
    geometry : of N points.
    intensities : (N, L), L intensities of each point; Mueller elements are intensities with W = 1.
    w : (L, 16).
    index : complex refractive index of the first surface.
    sigma : (N, L) or a number, standard deviation of the intensities; None if not known.
    folds : (N,) part of each point; default: drawn at random.
    """

    holds_out_states = False
    far_from_linear = False
    spread = 1.0
    folds = FOLDS

    def __init__(
        self,
        geometry: ScatteringGeometry,
        intensities: Array,
        w: Array,
        index: complex,
        sigma: Array | float | None = None,
        folds: NDArray[np.int64] | None = None,
    ) -> None:
        self.geometry, self.index, self.w = geometry, index, w
        self.noise_known = sigma is not None
        self.sigma = np.broadcast_to(np.asarray(1.0 if sigma is None else sigma, dtype=float), intensities.shape)
        self.y = intensities / self.sigma
        n = len(intensities)
        self.fold = np.random.default_rng(0).permutation(n) % FOLDS if folds is None else folds
        self._mean = float(np.mean(np.abs(intensities[:, 0])))

    def pool(self) -> tuple[Candidate, ...]:
        """All effects of the reflectance."""
        found = []
        for effect in reflectance_effects().values():
            parameters = effect.parameters("")
            # A diffuse weight of either sign is a separate valley.
            starts = tuple(
                s * np.array([p.typical if k == 0 else 0.0 for k, p in enumerate(parameters)]) for s in (1, -1)
            )
            found.append(Candidate(effect, "", parameters, None, starts))
        return tuple(found)

    def powers(self) -> list[tuple[int, Array]]:
        """Structure can differ from point to point; a twentieth of the points are taken as independent."""
        return [((len(self.w) - 2) * max(len(self.y) // 20, 1), np.ones(1))]

    def dominant(self, space: Space, values: Array) -> Array:
        """Dominant process (N, 4, 4) of the model with the effects."""
        changes = ReflectanceChanges()
        for candidate, part in space.pairs:
            if isinstance(candidate.effect, ReflectanceEffect):
                candidate.effect.bend(changes, "", values[part])
        return changes.dominant(self.geometry, self.index)

    def _columns(self, space: Space, values: Array) -> Array:
        m = self.dominant(space, values).reshape(-1, 16)
        a = np.stack(
            [
                m @ self.w.T,
                np.broadcast_to(self.w @ mueller.IDEAL_DEPOLARIZER.reshape(16), (*m.shape[:1], len(self.w))),
            ],
            axis=-1,
        )
        return np.asarray(np.nan_to_num(a) / self.sigma[..., None])

    def relinearize(self, space: Space, values: Array) -> bool:
        """Nothing is expanded here."""
        return False

    def noise_information(self, space: Space, values: Array) -> Array:
        """Nothing is known from the slopes of noise here."""
        return np.zeros((space.size, space.size))

    def time_noise(self, space: Space, values: Array) -> Array:
        """These points have no times."""
        return np.zeros(space.size)

    def residual_squares(self, space: Space, values: Array) -> Array:
        """Sum of squares (N,) that each point leaves over, in the units of the intensities."""
        q, size, _ = np.linalg.svd(self._columns(space, values), full_matrices=False)
        q = q * (size > 1e-6 * size[:, :1])[:, None, :]
        r = self.y - np.einsum("nlr,nr->nl", q, np.einsum("nlr,nl->nr", q, self.y))
        return np.asarray(np.sum((r * self.sigma) ** 2, axis=1))

    def sums(self, space: Space, values: Array, *, derivatives: bool = True) -> Sums:
        """Excess, and with `derivatives` its half gradient and curvature, of every fold."""
        k = space.size if derivatives else 0
        out = Sums.empty(self.folds, k)
        a = self._columns(space, values)
        q, size, vt = np.linalg.svd(a, full_matrices=False)
        keep = size > 1e-6 * size[:, :1]
        q = q * keep[:, None, :]
        inside = np.einsum("nlr,nl->nr", q, self.y)
        r = self.y - np.einsum("nlr,nr->nl", q, inside)
        alpha = np.einsum("nri,nr->ni", vt, np.where(keep, inside / np.maximum(size, 1e-300), 0.0))
        free = len(self.w) - keep.sum(axis=1)
        square = np.sum(r**2, axis=1)
        np.add.at(out.excess, self.fold, square - (free if self.noise_known else 0))
        np.add.at(out.freedom, self.fold, free.astype(float))
        np.add.at(out.square, self.fold, np.sum((r * self.sigma) ** 2, axis=1) / self._mean**2)
        np.add.at(out.count, self.fold, free.astype(float))
        if not k:
            return out
        typical = space.joined("typical")
        d = np.empty((k, *self.y.shape))
        for j in range(k):
            moved = values.copy()
            moved[j] += STEP * typical[j]
            da = (self._columns(space, moved) - a) / (STEP * typical[j])
            change = -np.einsum("nli,ni->nl", da, alpha)
            d[j] = change - np.einsum("nlr,nr->nl", q, np.einsum("nlr,nl->nr", q, change))
        for fold in range(self.folds):
            mine = d[:, self.fold == fold].reshape(k, -1)
            out.gradient[fold] = mine @ r[self.fold == fold].reshape(-1)
            out.curvature[fold] = mine @ mine.T
        return out
