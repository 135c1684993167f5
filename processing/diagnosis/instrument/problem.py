"""Measured intensities against an instrument model: excess over the noise, its gradient and curvature.

For every capture the model gives a matrix A (L rows): W for an unknown sample, W vec(M) for a known one. What a pixel's
own unknowns (M, or the throughput) can take up is projected out: residual = P y with P = 1 - A A+. The excess is the
sum of squares of the residuals in units of the noise, minus what the noise is expected to give.
Derivative of the residual: -P dA A+ y (variable projection after Kaufman, BIT 15, 49, 1975) + P dc Z for corrections
of the counts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import partial

import numpy as np

from processing.arrays import Array
from processing.diagnosis.captures.capture_data import CaptureData
from processing.diagnosis.instrument.capture_changes import CaptureChanges
from processing.diagnosis.instrument.features import FEATURES
from processing.diagnosis.instrument.moments import Block, Moments, folds_of, moments_of
from processing.diagnosis.instrument.photon_noise import (
    about_mean,
    distance,
    exactly_undone,
    movable,
    undoing,
    with_noise_of_light,
)
from processing.diagnosis.instrument.projection import add_blocks, noise_information
from processing.diagnosis.instrument.slopes import Columns, slopes_of_counts, slopes_of_rows
from processing.diagnosis.instrument.tiles import add_tiles, slopes_of_tiles, tile_columns
from processing.diagnosis.search.candidate import Candidate, SourceLevel, nominal_values, pool
from processing.diagnosis.search.range_of import range_of
from processing.diagnosis.search.rules import EXACT
from processing.diagnosis.search.space import Space, Sums
from processing.instrument.applied_effects import changes_of
from processing.instrument.changes import Changes
from processing.instrument.model import InstrumentModel

#: [points] Of expansion that are kept besides the first: each has counts of its own.
MOST_POINTS = 3


class InstrumentProblem:
    """All captures against one instrument model, resolved at their wavelength.

    Corrections of the counts are expanded in features of the counts. Far from the point of expansion that is not exact,
    and what it leaves of a large effect hides a small one; so the counts are corrected exactly at other points too
    (`relinearize`), each a problem of its own, and the nearest one is asked (`near`).
    """

    def __init__(
        self,
        models: InstrumentModel | Sequence[InstrumentModel],
        captures: Sequence[CaptureData],
        undone: Mapping[Candidate, Array] | None = None,
        folds: int | None = None,
        *,
        moved_back: bool = False,
    ) -> None:
        self.undone = dict(undone or {})
        self.models = (models,) * len(captures) if isinstance(models, InstrumentModel) else tuple(models)
        self.model = self.models[0]
        self.wavelengths_nm = tuple(c.wavelength_nm for c in captures)
        # The captures as taken (corrected already if they were moved back), and how far the model says that they moved.
        self.still = tuple(captures)
        pairs = zip(self.models, captures, strict=True)
        shifts = (about_mean(changes_of(m, c.conditions, c.name).shift_px / c.pitch) for m, c in pairs)
        self.own_px = tuple(s if movable(s) else np.zeros_like(s) for s in shifts)
        self.captures = self.still if moved_back else _moved_back(self.still, self.own_px)
        self.folds = folds or folds_of(self.captures)
        self.moments: tuple[Moments, ...] = tuple(moments_of(c, self.folds) for c in self.captures)
        self.forget_linearizations()
        self.noise_known = all(c.noise_known for c in self.captures)
        self.holds_out_states = any(m.tiles is None for m in self.moments)
        self.spread = max(m.spread for m in self.moments)

    def nominal(self) -> tuple[Candidate, ...]:
        """Values that the instrument file calls nominal, if a known sample is there to fit them to."""
        if not self.has_known_sample:
            return ()
        return nominal_values(self.model, self.captures[0].conditions, self.wavelengths_nm)

    @property
    def has_known_sample(self) -> bool:
        """Whether the sample of a capture is known."""
        return any(c.sample is not None for c in self.captures)

    def levels(self) -> tuple[Candidate, ...]:
        """Levels of the sources that several channels see, where the sample is unknown; else they are projected out."""
        effect = SourceLevel()
        return tuple(
            Candidate(effect, "", effect.parameters(self.models[k], data.conditions, ""), k)
            for k, data in enumerate(self.captures)
            if self.has_free_level(k) and data.sample is None
        )

    def has_free_level(self, capture: int) -> bool:
        """Whether the source has a level of its own in each state of a capture, which its channels tell."""
        return self.models[capture].projects_source and self.captures[capture].conditions.states > 1

    def pool(self) -> tuple[Candidate, ...]:
        """Every effect at every place of the captures, without those that a free level of the source takes up."""
        candidates = pool(self.model, [c.conditions for c in self.captures], self.wavelengths_nm)

        def is_taken_up(level: Candidate) -> bool:
            return all(self.has_free_level(k) for k, nm in enumerate(self.wavelengths_nm) if level.acts(k, nm))

        return tuple(c for c in candidates if not (c.effect.is_level and is_taken_up(c)))

    def powers(self) -> list[tuple[int, Array]]:
        """Rows that the unknowns leave over, and the power of each component of the signal, for each capture."""
        powers, empty = [], Space(())
        for k, moments in enumerate(self.moments):
            use = moments.counts
            a = self.columns(k, self.changes(k, empty, np.zeros(0)))[use]
            q = range_of(a)
            z = np.concatenate(
                [b.counts for b in moments.blocks[:: self.folds if moments.tiles is None else 1]], axis=1
            )
            part = q.T @ (z[use] / moments.sigma[use, None])
            power = np.maximum(np.linalg.eigvalsh(part @ part.T), 0.0)
            # With a single state, structure can vary over the image only.
            patches = moments.tiles.x.size if moments.tiles and self.captures[k].conditions.states == 1 else 1
            powers.append(((a.shape[0] - q.shape[1]) * patches, power + 1e-300))
        return powers

    def near(self, space: Space, values: Array) -> tuple[InstrumentProblem, Array]:
        """The problem expanded nearest to these values, and what is left of the values there."""
        best, least = self, distance({}, space, values)
        for point in self._others:
            away = distance(point.undone, space, values)
            if set(point.undone) <= set(space.candidates) and away < least:
                best, least = point, away
        local = values.copy()
        for candidate, part in space.pairs:
            if candidate in best.undone:
                local[part] -= best.undone[candidate]
        return best, local

    def relinearize(self, space: Space, values: Array) -> bool:
        """Expand about these values from now on, unless a point as close is known."""
        nearest, _ = self.near(space, values)
        if distance(nearest.undone, space, values) < EXACT:
            return False
        undone = exactly_undone(space, values)
        bent = {c: v for c, v in undone.items() if c.is_pointwise}
        shifts = [shift + self._shift_px(k, undone) for k, shift in enumerate(self.own_px)]
        if not all(movable(s) for s in shifts):
            return False
        still = [c.undone(undoing(c, bent)) if bent else c for c in self.still]
        expansion = InstrumentProblem(self.models, _moved_back(still, shifts), undone, self.folds, moved_back=True)
        if not all(np.all(np.isfinite(m.sigma)) and np.all(m.sigma > 0) for m in expansion.moments):
            # So far away that there are no such counts.
            return False
        # What is kept of the tiles is large: that of one point at a time.
        for point in (self, *self._others):
            for moments in point.moments:
                moments.forget_features()
        self._others.append(expansion)
        del self._others[:-MOST_POINTS]
        return True

    def _shift_px(self, capture: int, undone: Mapping[Candidate, Array]) -> Array:
        changes = Changes(self.captures[capture].conditions)
        for candidate, values in undone.items():
            if candidate.moves_image and candidate.acts(capture, self.wavelengths_nm[capture]):
                candidate.apply(changes, self.models[capture], values)
        return about_mean(changes.shift_px / self.captures[capture].pitch)

    def forget_linearizations(self) -> None:
        """Drop what was built for another model or other states; the moments of the counts stay."""
        self._others: list[InstrumentProblem] = []
        parts = enumerate(zip(self.models, self.captures, self.own_px, strict=True))
        self._changes = [CaptureChanges(k, model, data, px * data.pitch) for k, (model, data, px) in parts]

    def with_models(self, models: Sequence[InstrumentModel]) -> InstrumentProblem:
        """The same captures against other models of the same instrument."""
        variant = copy(self)
        variant.models, variant.model = tuple(models), models[0]
        variant.forget_linearizations()
        return variant

    def undivided(self) -> InstrumentProblem:
        """The same with nothing held out: one set of unknowns for all states, not one for each part of them."""
        return InstrumentProblem(self.models, self.still, folds=1)

    def adopt_noise(self, space: Space, values: Array) -> bool:
        """Take the noise from the light that these values tell, for all that follows; False if that is as before.

        The evidence for an effect is always taken with one and the same noise; else a correction could gain by the
        noise that it pretends.
        """
        is_bent = distance({}, space, values, pointwise=True) >= EXACT
        of_light = any(c.slope.any() for c in self.captures) and not any(c.noise_estimated for c in self.captures)
        return is_bent and of_light and self.level_noise(space, values)

    def level_noise(self, space: Space, values: Array) -> bool:
        """Take the noise that light and differences of pixels tell beside these values, for all that follows.

        False, and all as before, if the counts of a capture do not scatter as its light would.
        """
        at, still = exactly_undone(space, values, pointwise=True), []
        for k, (data, nm) in enumerate(zip(self.still, self.wavelengths_nm, strict=True)):
            acting = space.acting(k, nm)
            rows = self.columns(k, self.changes(k, acting.space, acting.of(values))) * self.moments[k].sigma[:, None]
            leveled = with_noise_of_light(data, rows, {c: v for c, v in at.items() if c.acts(k, nm)})
            if leveled is None:
                return False
            still.append(leveled)
        self.still = tuple(still)
        self.captures = _moved_back(self.still, self.own_px)
        self.moments = tuple(moments_of(c, self.folds) for c in self.captures)
        self.spread = max(m.spread for m in self.moments)
        self._others.clear()
        return True

    def at(self, wavelength_nm: float) -> InstrumentProblem:
        """The captures at one wavelength alone, nothing held out."""
        indices = [k for k, w in enumerate(self.wavelengths_nm) if w == wavelength_nm]
        return InstrumentProblem([self.models[k] for k in indices], [self.still[k] for k in indices], folds=1)

    def changes(self, capture: int, space: Space, values: Array) -> Changes:
        """Changes of one capture with the instrument's own effects and the active candidates."""
        return self._changes[capture].of(space, values)

    @property
    def held_out(self) -> str:
        """Description of the held-out data."""
        if self.folds == 1:
            return "nothing: too few values; each fitted value takes a degree of freedom"
        return "; ".join(dict.fromkeys(m.held_out for m in self.moments))

    def noise_floor(self, space: Space, values: Array, k: int | None = None) -> float:
        """Rms noise over the mean signal, of one capture or of all, with the counts corrected by these values."""
        moments = self.near(space, values)[0].moments
        return float(np.sqrt(np.mean([m.noise_floor**2 for m in (moments if k is None else moments[k : k + 1])])))

    def columns(self, capture: int, changes: Changes) -> Array:
        """A (L, K), rows in units of their noise."""
        a = self._columns_of_one_source(capture, changes)
        if self._free_source(capture):
            # A throughput of its own for every state: its rows have a column of their own.
            conditions = self.captures[capture].conditions
            state = np.arange(len(a)) // len(conditions.channels)
            a = np.where(state[:, None] == np.arange(conditions.states), a, 0.0)
        return a

    def _columns_of_one_source(self, capture: int, changes: Changes) -> Array:
        """A (L, K) where the source has the same level in all states."""
        rows = self.captures[capture].rows_of(self.models[capture], changes)
        return np.asarray(rows / self.moments[capture].sigma[:, None])

    def channels(self, capture: int) -> int:
        """Channels of the detector."""
        return len(self.captures[capture].conditions.channels)

    def ratios(self, capture: int) -> int:
        """Ratios of channels that a state shows, where its level is projected out; 0 where it is not."""
        return self.channels(capture) - 1 if self._free_source(capture) else 0

    def predicted(self, capture: int, changes: Changes) -> Array:
        """Intensities (N, channels) of a capture of a known sample, for a throughput of one and a steady source."""
        rows = self._columns_of_one_source(capture, changes) * self.moments[capture].sigma[:, None]
        return rows.reshape(self.captures[capture].signal.shape[:2])

    def _free_source(self, capture: int) -> bool:
        return self.has_free_level(capture) and self.captures[capture].sample is not None

    def _rows_apart(self, capture: int) -> int | None:
        """How many rows a state has, where each has unknowns of its own."""
        return self.channels(capture) if self._free_source(capture) else None

    def coefficients(self, capture: int, changes: Changes) -> Array:
        """Coefficient of every feature (F, L) in the corrected counts."""
        rows = self.captures[capture].values_per_pixel
        channels = len(self.captures[capture].conditions.channels)
        c = np.zeros((len(FEATURES), rows))
        c[0] = 1.0
        if not changes.corrects_counts:
            return c
        for name, value in changes.response.items():
            c[FEATURES.index(name)] += np.ravel(value)
        # What shift and blur took away, to second order, from derivatives of the fitted image at the mean shift.
        pitch = self.captures[capture].pitch
        shift_px = np.repeat(changes.shift_px / pitch, channels, axis=0)
        (x, y), (u, v), (mean_x, mean_y) = shift_px.T, about_mean(shift_px).T, shift_px.mean(axis=0)
        b = np.repeat(changes.blur_px2 / pitch**2, channels)
        for name, value in (
            *(("dx", x), ("dy", y), ("dxy", mean_x * mean_y - u * v)),
            *(("dxx", (mean_x**2 - u * u - b) / 2), ("dyy", (mean_y**2 - v * v - b) / 2)),
        ):
            c[FEATURES.index(name)] = value
        return c

    def sums(self, space: Space, values: Array, *, derivatives: bool = True) -> Sums:
        """Excess, and with `derivatives` its half gradient and curvature, of every fold."""
        nearest, local = self.near(space, values)
        if nearest is not self:
            return nearest.sums(space, local, derivatives=derivatives)
        total = Sums.empty(self.folds, space.size if derivatives else 0, len(self.captures))
        for k, data in enumerate(self.captures):
            acting = space.acting(k, data.wavelength_nm)
            subspace, values_k = acting.space, acting.of(values)
            part = Sums.empty(self.folds, subspace.size if derivatives else 0)
            changes = self.changes(k, subspace, values_k)
            varies = derivatives and any(c.effect.varies_over_image for c in subspace.candidates)
            if changes.field_retardance_rad or varies:
                self._tile_sums(k, subspace, values_k, changes, out=part, derivatives=derivatives)
            else:
                self._block_sums(k, subspace, values_k, changes, out=part, derivatives=derivatives)
            total.add(k, part, acting)
        return total

    def noise_information(self, space: Space, values: Array) -> tuple[Array, Array]:
        """Parts (K, K) of the curvature that the noise of image derivatives makes, and that of the counts."""
        nearest, local = self.near(space, values)
        if nearest is not self:
            return nearest.noise_information(space, local)
        totals = np.zeros((2, space.size, space.size))
        for k, moments in enumerate(self.moments):
            acting = space.acting(k, self.wavelengths_nm[k])
            subspace, values_k = acting.space, acting.of(values)
            changes = self.changes(k, subspace, values_k)
            a = self.columns(k, changes)
            dc = self.slopes_of_counts(k, subspace, values_k, self.coefficients(k, changes))
            if np.any(dc):
                noise = np.sum([noise_information(block, a, dc, moments) for block in moments.blocks], axis=0)
                for total, part in zip(totals, noise, strict=True):
                    total[np.ix_(acting.index, acting.index)] += acting.spread_products(part)
        return totals[0], totals[1]

    def time_noise(self, space: Space, values: Array) -> Array:
        """Variance (K,) that errors of the frames' times make of a source's level in each state, where it drifts."""
        variance = np.zeros(space.size)
        parts = dict(space.pairs)
        for k, (data, nm) in enumerate(zip(self.captures, self.wavelengths_nm, strict=True)):
            conditions = data.conditions
            acting = [c for c in parts if c.effect.of_source and c.acts(k, nm)]
            levels = [c for c in acting if c.effect.per_state]
            if conditions.elapsed_error == 0 or not levels:
                continue
            gains = []
            for shift in (0.0, conditions.elapsed_error):
                changes = Changes(replace(conditions, elapsed=conditions.elapsed + shift))
                for c in acting:
                    if c not in levels:
                        c.apply(changes, self.models[k], values[parts[c]])
                gains.append(np.broadcast_to(changes.gain, (conditions.states, len(conditions.channels)))[:, 0])
            for c in levels:
                variance[parts[c]] = (gains[1] / gains[0] - 1) ** 2
        return variance

    def _block_sums(
        self, k: int, space: Space, values: Array, changes: Changes, *, out: Sums, derivatives: bool
    ) -> None:
        # With a level of the source in every state each state is projected by itself: one column serves all of them.
        a, c = self._columns_of_one_source(k, changes), self.coefficients(k, changes)
        da, dc = np.zeros((0, *a.shape)), None
        if derivatives:
            da, dc = self.slopes(k, space, values, a, c=c, columns=partial(self._columns_of_one_source, k))
        # Blocks of the same pixels have the same features.
        together: dict[int, list[Block]] = {}
        for block in self.moments[k].blocks:
            if block.clipped and changes.drop_clipped:
                # What is left of a clipped pixel is its states without any clipping, if they are enough.
                if block.sound.size <= a.shape[1]:
                    continue
                block = replace(block, rows=block.sound)
            if block.rows.size:
                together.setdefault(id(block.z), []).append(block)
        for blocks in together.values():
            add_blocks(blocks, a, c, da, dc=dc, moments=self.moments[k], out=out, apart=self._rows_apart(k))

    def slopes(
        self, k: int, space: Space, values: Array, a: Array, *, c: Array, columns: Columns
    ) -> tuple[Array, Array]:
        """Derivatives of the rows a (..., L, K) of a capture and of the coefficients c (F, L) of its counts.

        Each with one more axis in front, the values; `columns` makes the rows of changes.
        """
        conditions, changes = self.captures[k].conditions, self._changes[k].about(space, values)
        da = slopes_of_rows(changes, self.models[k], conditions, space, values=values, a=a, columns=columns)
        return da, slopes_of_counts(changes, partial(self.coefficients, k), space, values, c=c)

    def slopes_of_counts(self, k: int, space: Space, values: Array, c: Array) -> Array:
        """Derivatives (values, F, L) of the coefficients c (F, L) of the corrected counts of a capture."""
        if not any(candidate.acts_on_counts for candidate in space.candidates):
            return np.zeros((space.size, *c.shape))
        changes = self._changes[k].about(space, values)
        return slopes_of_counts(changes, partial(self.coefficients, k), space, values, c=c)

    def _tile_sums(
        self, k: int, space: Space, values: Array, changes: Changes, *, out: Sums, derivatives: bool
    ) -> None:
        """The same with another A in every tile of the image."""
        data, moments = self.captures[k], self.moments[k]
        if moments.tiles is None:
            return
        model, tiles = self.models[k], [moments.tiles]
        if moments.clipped is not None and not changes.drop_clipped:
            tiles.append(moments.clipped)
        a, c, slopes = tile_columns(model, data, moments, changes), self.coefficients(k, changes), None
        if derivatives and space.size:
            dc = self.slopes_of_counts(k, space, values, c)
            slopes = slopes_of_tiles(
                model, data, moments, partial(self.changes, k, space), space=space, values=values, a=a, dc=dc
            )
        for each in tiles:
            add_tiles(data, moments, each, a, c=c, slopes=slopes, out=out, apart=self._rows_apart(k))


def _moved_back(captures: Sequence[CaptureData], shifts_px: Sequence[Array]) -> tuple[CaptureData, ...]:
    """Every frame moved back by so many pixels (N, 2) of its capture, and channels that look at places apart to one."""
    return tuple(
        c.moved_back(s) if s.any() or c.place_px is not None else c for c, s in zip(captures, shifts_px, strict=True)
    )
