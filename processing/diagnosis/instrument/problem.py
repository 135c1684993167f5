"""Measured intensities against an instrument model: excess over the noise, its gradient and curvature.

For every capture the model gives a matrix A (L rows): W for an unknown sample, W vec(M) for a known one. What a pixel's
own unknowns (M, or the throughput) can take up is projected out: residual = P y with P = 1 - A A+. The excess is the
sum of squares of the residuals in units of the noise, minus what the noise is expected to give.
Derivative of the residual: -P dA A+ y (variable projection after Kaufman, BIT 15, 49, 1975) + P dc Z for corrections
of the counts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from processing.arrays import Array
from processing.diagnosis.captured.capture_data import CaptureData
from processing.diagnosis.instrument.moments import (
    DERIVATIVES,
    FEATURES,
    FOLDS_OF_STATES,
    FOLDS_OF_TILES,
    MARGIN,
    Moments,
    holds_out_states,
    moments_of,
)
from processing.diagnosis.instrument.projection import RANK, add_block, noise_information
from processing.diagnosis.instrument.tile_sums import add_tiles, tile_columns
from processing.diagnosis.search.candidate import Candidate, nominal_values, pool
from processing.diagnosis.search.space import Space, Sums
from processing.instrument.applied_effects import apply_to, changes_of
from processing.instrument.changes import Changes
from processing.instrument.effects.base import (
    CountsEffect,
    FieldEffect,
    FromAState,
    ImageShift,
    PointwiseEffect,
    Switch,
    ValuePerState,
    turned_by,
)
from processing.instrument.model import InstrumentModel

#: Makes A (..., L, K) of the changes of a capture.
Columns = Callable[[Changes], Array]
STEP = 1e-4
#: Distance, in typical sizes, from the point of expansion up to which a correction of counts is exact enough.
EXACT = 0.3
#: Element matrices that are kept for use in another evaluation.
MOST_BUILT = 64


class InstrumentProblem:
    """All captures against one instrument model, resolved at their wavelength.

    Corrections of the counts are expanded in features of the counts. Far from the point of expansion that is not exact,
    and what it leaves of a large effect hides a small one; so the counts are corrected exactly at other points too
    (`relinearize`), each a problem of its own, and the nearest one is asked (`near`).
    """

    far_from_linear = False

    def __init__(
        self,
        model: InstrumentModel,
        captures: Sequence[CaptureData],
        undone: Mapping[Candidate, Array] | None = None,
        folds: int | None = None,
        moved_px: Sequence[Array] | None = None,
    ) -> None:
        self.undone = dict(undone or {})
        self._others: list[InstrumentProblem] = []
        self._noise_at: dict[Candidate, Array] = {}
        self.model = model
        # The captures as taken, by how many of their pixels each frame is moved back, and what of that the model says.
        self.still = tuple(captures)
        own = (changes_of(model, c.conditions, c.name).shift_px / c.pitch for c in captures)
        self.own_px = tuple(s if _movable(s) else np.zeros_like(s) for s in own)
        self.shifts_px = tuple(self.own_px if moved_px is None else moved_px)
        self.captures = self._moved_back()
        self.folds = folds or (FOLDS_OF_STATES if any(holds_out_states(c) for c in self.captures) else FOLDS_OF_TILES)
        self.moments: tuple[Moments, ...] = tuple(moments_of(c, self.folds) for c in self.captures)
        self._built: list[dict[tuple[str, bytes], Array]] = [{} for _ in self.captures]
        self.noise_known = all(c.noise_known for c in self.captures)
        self.holds_out_states = any(m.tiles is None for m in self.moments)
        self.spread = max(m.spread for m in self.moments)

    def nominal(self) -> tuple[Candidate, ...]:
        """Values that the instrument file calls nominal, if a known sample is there to fit them to."""
        known = any(c.sample is not None for c in self.captures)
        return nominal_values(self.model, self.captures[0].conditions) if known else ()

    def pool(self) -> tuple[Candidate, ...]:
        """Every effect at every place of the captures."""
        return pool(self.model, [c.conditions for c in self.captures])

    def powers(self) -> list[tuple[int, Array]]:
        """Rows that the unknowns leave over, and the power of each component of the signal, for each capture."""
        out, empty = [], Space(())
        for k, moments in enumerate(self.moments):
            use = moments.counts
            a = self.columns(k, self.changes(k, empty, np.zeros(0)))[use]
            u, size, _ = np.linalg.svd(a, full_matrices=False)
            q = u[:, size > RANK * size[0]]
            z = np.concatenate(
                [b.counts for b in moments.blocks[:: self.folds if moments.tiles is None else 1]], axis=1
            )
            part = q.T @ (z[use] / moments.sigma[use, None])
            power = np.maximum(np.linalg.eigvalsh(part @ part.T), 0.0)
            # With a single state, structure can vary over the image only.
            patches = moments.tiles.x.size if moments.tiles and self.captures[k].conditions.states == 1 else 1
            out.append(((a.shape[0] - q.shape[1]) * patches, power + 1e-300))
        return out

    def near(self, space: Space, values: Array) -> tuple[InstrumentProblem, Array]:
        """The problem expanded nearest to these values, and what is left of the values there."""
        best, least = self, _distance({}, space, values)
        for other in self._others:
            distance = _distance(other.undone, space, values)
            if set(other.undone) <= set(space.candidates) and distance < least:
                best, least = other, distance
        local = values.copy()
        for candidate, part in zip(space.candidates, space.slices, strict=True):
            if candidate in best.undone:
                local[part] -= best.undone[candidate]
        return best, local

    def relinearize(self, space: Space, values: Array) -> bool:
        """Expand about these values from now on, unless a point as close is known."""
        known, _ = self.near(space, values)
        if _distance(known.undone, space, values) < EXACT:
            return False
        undone = _exact(space, values)
        bent = {c: v for c, v in undone.items() if isinstance(c.effect, PointwiseEffect)}
        shifts = [own + self._shift_px(k, undone) for k, own in enumerate(self.own_px)]
        if not all(_movable(s) for s in shifts):
            return False
        still = [c.undone(*_undone(c, bent)) if bent else c for c in self.still]
        self._others.append(InstrumentProblem(self.model, still, undone, self.folds, shifts))
        return True

    def _moved_back(self) -> tuple[CaptureData, ...]:
        pairs = zip(self.still, self.shifts_px, strict=True)
        return tuple(c.moved_back(s) if s.any() else c for c, s in pairs)

    def _shift_px(self, capture: int, undone: Mapping[Candidate, Array]) -> Array:
        changes = Changes(self.captures[capture].conditions)
        for candidate, values in undone.items():
            if isinstance(candidate.effect, ImageShift) and candidate.capture in (None, capture):
                candidate.apply(changes, self.model, values)
        return changes.shift_px / self.captures[capture].pitch

    def forget_linearizations(self) -> None:
        """Drop what was built for another model or other states; the moments of the counts stay."""
        self._others = []
        self._built = [{} for _ in self.captures]

    def undivided(self) -> InstrumentProblem:
        """The same with nothing held out: one set of unknowns for all states, not one for each part of them."""
        return InstrumentProblem(self.model, self.still, folds=1)

    def adopt_noise(self, space: Space, values: Array) -> bool:
        """Take the noise from the light that these values tell, for all that follows; False if that is as before.

        The evidence for an effect is always taken with one and the same noise; else a correction could gain by the
        noise that it pretends.
        """
        at = _exact(space, values, pointwise=True)
        gone = any(candidate not in at for candidate in self._noise_at)
        near = not gone and _distance(self._noise_at, space, values, pointwise=True) < EXACT
        if near or any(c.noise_estimated for c in self.captures):
            return False
        self._noise_at = at
        self.still = tuple(
            c.with_noise_of(*_undone(c, at)) if at else replace(c, true_variance=None) for c in self.still
        )
        self.captures = self._moved_back()
        self.moments = tuple(moments_of(c, self.folds) for c in self.captures)
        self.spread = max(m.spread for m in self.moments)
        self._others.clear()
        return True

    def changes(self, capture: int, space: Space, values: Array) -> Changes:
        """Changes of one capture with the instrument's own effects and the active candidates."""
        data = self.captures[capture]
        built = self._built[capture]
        if len(built) > MOST_BUILT:
            built.clear()
        changes = Changes(data.conditions, built=built)
        for applied in self.model.effects:
            if applied.scope == "instrument" or data.name in applied.captures:
                apply_to(changes, self.model, applied)
        changes.shift_px = changes.shift_px - self.own_px[capture] * data.pitch
        for candidate, part in zip(space.candidates, space.slices, strict=True):
            # At zero an effect does nothing: there is no need to ask it.
            if candidate.capture in (None, capture) and values[part].any():
                candidate.apply(changes, self.model, values[part])
        return changes

    def columns(self, capture: int, changes: Changes) -> Array:
        """A (L, K), rows in units of their noise."""
        data = self.captures[capture]
        w = self.model.rows(data.conditions.angles_deg, changes).reshape(-1, 16) * data.row_exposure[:, None]
        a = w if data.sample is None else (w @ data.sample)[:, None]
        return np.asarray(a / self.moments[capture].sigma[:, None])

    def coefficients(self, capture: int, changes: Changes) -> Array:
        """Coefficient of every feature (F, L) in the corrected counts."""
        rows = self.captures[capture].values_per_pixel
        channels = len(self.captures[capture].conditions.channels)
        c = np.zeros((len(FEATURES), rows))
        c[0] = 1.0
        for name, value in changes.response.items():
            c[FEATURES.index(name)] += value
        # What the shift took away, to second order, from derivatives of the fitted image (which has no shift).
        x, y = np.repeat(changes.shift_px / self.captures[capture].pitch, channels, axis=0).T
        for name, value in (("dx", x), ("dy", y), ("dxx", -x * x / 2), ("dxy", -x * y), ("dyy", -y * y / 2)):
            c[FEATURES.index(name)] = value
        return c

    def sums(self, space: Space, values: Array, *, derivatives: bool = True) -> Sums:
        """Excess, and with `derivatives` its half gradient and curvature, of every fold."""
        other, local = self.near(space, values)
        if other is not self:
            return other.sums(space, local, derivatives=derivatives)
        out = Sums.empty(self.folds, space.size if derivatives else 0)
        for k in range(len(self.captures)):
            changes = self.changes(k, space, values)
            if changes.field_retardance_rad or (derivatives and self._has_field(space)):
                self._tile_sums(k, space, values, changes, out, derivatives)
            else:
                self._block_sums(k, space, values, changes, out, derivatives)
        return out

    def noise_information(self, space: Space, values: Array) -> Array:
        """Part (K, K) of the curvature that is noise of image derivatives and tells nothing about the values."""
        other, local = self.near(space, values)
        if other is not self:
            return other.noise_information(space, local)
        out = np.zeros((space.size, space.size))
        for k, moments in enumerate(self.moments):
            changes = self.changes(k, space, values)
            a = self.columns(k, changes)
            dc = self._slopes_of_counts(k, space, values, self.coefficients(k, changes))
            if np.any(dc[:, -DERIVATIVES:]):
                out += sum(noise_information(block, a, dc, moments) for block in moments.blocks)
        return out

    def _has_field(self, space: Space) -> bool:
        return any(isinstance(c.effect, FieldEffect) for c in space.candidates)

    def _block_sums(self, k: int, space: Space, values: Array, changes: Changes, out: Sums, derivatives: bool) -> None:
        a, c = self.columns(k, changes), self.coefficients(k, changes)
        da, dc = np.zeros((0, *a.shape)), None
        if derivatives:
            da = self._slopes(k, space, values, a, partial(self.columns, k))
            dc = self._slopes_of_counts(k, space, values, c)
        for block in self.moments[k].blocks:
            if block.clipped and changes.drop_clipped:
                # What is left of a clipped pixel is its states without any clipping, if they are enough.
                if block.sound.size < 1.5 * a.shape[1]:
                    continue
                block = replace(block, rows=block.sound)
            if block.rows.size:
                add_block(block, a, c, da, dc, self.moments[k], out)

    def mueller_slopes(self, space: Space, values: Array) -> tuple[Array, float]:
        """How values move the Mueller matrices that the counts give: products (K, K), and the sum of m00 squared.

        The products are those of the derivatives of M, summed over elements and pixels, a common factor of M left out.
        """
        other, local = self.near(space, values)
        if other is not self:
            return other.mueller_slopes(space, local)
        products, light = np.zeros((space.size, space.size)), 0.0
        for k, moments in enumerate(self.moments):
            changes = self.changes(k, space, values)
            columns = partial(self._all_columns, k)
            w, c = columns(changes), self.coefficients(k, changes)
            back = np.linalg.pinv(w * moments.counts[:, None], rcond=RANK)
            dw, dc = self._slopes(k, space, values, w, columns), self._slopes_of_counts(k, space, values, c)
            scale = 1 / moments.sigma[:, None]
            for block in moments.blocks[:: self.folds if moments.tiles is None else 1]:
                m = back @ (np.einsum("fl,flr->lr", c, block.z) * scale)
                slopes = -np.einsum("el,klm,mr->ker", back, dw, m, optimize=True)
                for j in np.flatnonzero(np.any(dc, axis=(1, 2))):
                    slopes[j] += back @ (np.einsum("fl,flr->lr", dc[j], block.z) * scale)
                bright = float(m[0] @ m[0])
                slopes -= (slopes[:, 0] @ m[0] / max(bright, 1e-300))[:, None, None] * m
                flat = slopes.reshape(space.size, -1)
                products += flat @ flat.T
                light += bright
        return products, light

    def _all_columns(self, k: int, changes: Changes) -> Array:
        """Rows (L, 16) of the measurement matrix in units of their noise, whatever the sample."""
        data = self.captures[k]
        w = self.model.rows(data.conditions.angles_deg, changes).reshape(-1, 16) * data.row_exposure[:, None]
        return np.asarray(w / self.moments[k].sigma[:, None])

    def _slopes(self, k: int, space: Space, values: Array, a: Array, columns: Columns) -> Array:
        """Derivatives (values, ..., L, K) of a (..., L, K), which `columns` makes of the changes."""
        da = np.zeros((space.size, *a.shape))
        conditions = self.captures[k].conditions
        channels = len(conditions.channels)
        whole: dict[str, Array] = {}
        for candidate, part in self._active(k, space):
            if isinstance(candidate.effect, CountsEffect):
                continue
            if isinstance(candidate.effect, ValuePerState):
                # Parameter n acts on state n alone: one step of all of them together gives every derivative.
                moved = values.copy()
                step = STEP * candidate.typical
                moved[part] += step
                slope = (columns(self.changes(k, space, moved)) - a) / step.repeat(channels)[:, None]
                for n in range(candidate.size):
                    rows = slice(n * channels, (n + 1) * channels)
                    da[part.start + n, ..., rows, :] = slope[..., rows, :]
                continue
            if isinstance(candidate.effect, FromAState) and not values[part].any():
                # The same step of the same axis from another state on: one evaluation serves all of them.
                axis = candidate.effect.axis(candidate.place)
                first = candidate.effect.first_state(candidate.place)
                if axis not in whole:
                    turned = self.changes(k, space, values)
                    turned.turn_axis(axis, np.full(conditions.states, STEP), turned_by(self.model, axis))
                    whole[axis] = (columns(turned) - a) / STEP
                da[part.start, ..., first * channels :, :] = whole[axis][..., first * channels :, :]
                continue
            for j, (moved, step_j) in enumerate(self._stepped(candidate, part, values)):
                da[part.start + j] = (columns(self.changes(k, space, moved)) - a) / step_j
        return da

    def _slopes_of_counts(self, k: int, space: Space, values: Array, c: Array) -> Array:
        """Derivatives (values, F, L) of the coefficients c (F, L)."""
        dc = np.zeros((space.size, *c.shape))
        for candidate, part in self._active(k, space):
            if isinstance(candidate.effect, CountsEffect):
                for j, (moved, step) in enumerate(self._stepped(candidate, part, values)):
                    dc[part.start + j] = (self.coefficients(k, self.changes(k, space, moved)) - c) / step
        return dc

    def _active(self, k: int, space: Space) -> list[tuple[Candidate, slice]]:
        """Candidates that act on capture k and have values to fit."""
        pairs = zip(space.candidates, space.slices, strict=True)
        return [(c, part) for c, part in pairs if c.capture in (None, k) and not isinstance(c.effect, Switch)]

    @staticmethod
    def _stepped(candidate: Candidate, part: slice, values: Array) -> Iterator[tuple[Array, float]]:
        """All values with one of a candidate's after the other moved by a small step, and the step."""
        for j, step in enumerate(STEP * candidate.typical):
            moved = values.copy()
            moved[part.start + j] += step
            yield moved, step

    def _tile_sums(self, k: int, space: Space, values: Array, changes: Changes, out: Sums, derivatives: bool) -> None:
        """The same with another A in every tile of the image."""
        data, moments = self.captures[k], self.moments[k]
        if moments.tiles is None:
            return
        columns = partial(tile_columns, self.model, data, moments)
        a, c = columns(changes), self.coefficients(k, changes)
        da, dc = np.zeros((0, *a.shape)), np.zeros((0, *c.shape))
        if derivatives:
            da = self._slopes(k, space, values, a, columns)
            dc = self._slopes_of_counts(k, space, values, c)
        add_tiles(data, moments, moments.tiles, a, c, da, dc, out)
        if moments.clipped is not None and not changes.drop_clipped:
            add_tiles(data, moments, moments.clipped, a, c, da, dc, out)


def _movable(shift_px: Array) -> bool:
    """Whether frames can be moved back by (N, 2) pixels and no used pixel needs what lies beyond the edge."""
    return bool(np.abs(shift_px).max() <= MARGIN)


def _distance(undone: Mapping[Candidate, Array], space: Space, values: Array, *, pointwise: bool = False) -> float:
    """Largest distance of a correction from where it was undone, in typical sizes; of the `pointwise` ones alone."""
    away = [0.0]
    for candidate, part in zip(space.candidates, space.slices, strict=True):
        if _exactly_undone(candidate, pointwise):
            away.append(float(np.max(np.abs(values[part] - undone.get(candidate, 0.0)) / candidate.typical)))
    return max(away)


def _exactly_undone(candidate: Candidate, pointwise: bool) -> bool:
    """Whether a correction can be undone exactly; with `pointwise`, in each pixel by itself."""
    return isinstance(candidate.effect, PointwiseEffect if pointwise else PointwiseEffect | ImageShift)


def _exact(space: Space, values: Array, *, pointwise: bool = False) -> dict[Candidate, Array]:
    """Values of what can be undone exactly; of the `pointwise` corrections alone."""
    active = zip(space.candidates, space.slices, strict=True)
    return {c: values[p] for c, p in active if _exactly_undone(c, pointwise) and values[p].any()}


def _undone(data: CaptureData, undone: Mapping[Candidate, Array]) -> tuple[Array, Array]:
    """Signal with the effects undone exactly, and its slope over the old one."""
    signal, slope = data.signal.astype(float), np.ones(())
    for candidate, values in undone.items():
        if isinstance(candidate.effect, PointwiseEffect):
            signal, step = candidate.effect.undo(signal, data.conditions, values)
            slope = slope * step
    return signal, slope
