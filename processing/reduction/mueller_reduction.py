"""A capture to Mueller matrices: prepared once, applied to row blocks, a region or one pixel."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.errors import ProcessError
from processing.instrument.determined_basis import determined_basis, determined_elements
from processing.instrument.model import InstrumentModel
from processing.polarization.physical import nearest
from processing.reduction.counts_to_signal import BlockReader, CountCorrection
from processing.reduction.cut_off import without_cut_off
from processing.reduction.effects_of_capture import CountsCorrection, capture_changes, counts_correction
from processing.reduction.exclusions import Exclusions
from processing.reduction.facts import determined_words
from processing.reduction.measurement_matrix import field_of, measurement_matrix
from processing.reduction.noise import NoiseModel, noise_of
from processing.reduction.residual_noise import noise_of_residual
from processing.reduction.sample_states import sample_states
from processing.reduction.sent_light import PLANES as SENT_PLANES
from processing.reduction.sent_light import SentLight
from processing.reduction.solvers.base import Solver
from processing.reduction.solvers.field import Field, FieldSolver
from processing.reduction.solvers.inversion import ELEMENTS, Inversion
from processing.reduction.solvers.plain import MuellerSolver
from processing.reduction.source_level import LeveledSource, SourceLevels
from processing.reduction.systematic import Systematic
from processing.storage.captures.capture import Capture
from processing.storage.products.images import MUELLER_PLANES, MuellerImage
from processing.storage.products.pixel_mask import Mask
from processing.storage.products.product import Plane

CHI_SQUARE = Plane((), "", "squared residual over what the noise model expects; 1 if the model is complete")
_SYSTEMATIC = "what is uncertain in the instrument; it does not average"
SYSTEMATIC = {
    "mueller_systematic": Plane(
        (4, 4), "count", f"systematic standard errors of mueller (of M/m00, times m00): {_SYSTEMATIC}"
    )
}
SENT_SYSTEMATIC = {
    "stokes_systematic": Plane(
        (4,), "count", f"systematic standard errors of stokes (of S/S0, times S0): {_SYSTEMATIC}"
    )
}
COVARIANCE = Plane(
    (ELEMENTS * (ELEMENTS + 1) // 2,),
    "count2",
    "covariance of mueller, lower triangle row by row: 00, 10, 11, 20, 21, 22, ...",
)
PHYSICAL = {
    "nearest": Plane((4, 4), "count", "physical Mueller matrix nearest to mueller (Frobenius norm)"),
    "likelihood": Plane((4, 4), "count", "physical Mueller matrix of highest likelihood"),
}
#: A pixel with one of these has no value.
LOST = np.uint8(Mask.NOT_FINITE | Mask.BAD | Mask.NOT_DETERMINED)


@dataclass(frozen=True)
class Choice:
    """How to reduce.

    Attributes
    ----------
    weighted : weigh each intensity by its noise, pixel by pixel; else equal weights.
    covariance : store the full 16 x 16 covariance of each pixel (needs `weighted`).
    physical : "nearest", "likelihood" (needs `weighted`) or None: a physical estimate in addition to the plain one.
    noise : of the camera, where it is known better than by the capture's header.
    """

    weighted: bool = False
    covariance: bool = False
    physical: str | None = None
    noise: NoiseModel | None = None

    def __post_init__(self) -> None:
        if self.physical not in (None, *PHYSICAL):
            raise ProcessError(f"physical estimate {self.physical!r} is none of {', '.join(PHYSICAL)}")
        if not self.weighted and (self.covariance or self.physical == "likelihood"):
            raise ProcessError("a stored covariance and the most likely physical matrix need the weighted estimate")

    def solver(self, plain: MuellerSolver, field: Field | None = None) -> Solver:
        """The solver that the choice asks for; `field` where W varies over the image."""
        first = plain if field is None else FieldSolver(plain, field)
        if not self.weighted:
            return first
        # Imported here: its compiled loops make every start half a second longer.
        from processing.reduction.solvers.weighted import WeightedSolver

        return WeightedSolver(first, self.covariance, self.physical == "likelihood")

    def planes(self, known_noise: bool) -> dict[str, Plane]:
        """Datasets of the product."""
        planes = dict(MUELLER_PLANES)
        if known_noise:
            planes["reduced_chi_square"] = CHI_SQUARE
        if self.covariance:
            planes["mueller_covariance"] = COVARIANCE
        if self.physical:
            planes["mueller_physical"] = PHYSICAL[self.physical]
        return planes


@dataclass(frozen=True)
class MuellerReduction:
    """All that the reduction of one capture needs; it holds no open file.

    Attributes
    ----------
    model : at the capture's wavelength.
    states : (N,) of the sample, that are reduced.
    warnings : which states are not, and why.
    w : (N, channels, 16), rows scaled with exposure and level of the source.
    levels : of the source; None where they are not determined.
    field : W where it varies over the image; None where it is the same everywhere.
    sent, systematic : see there; None where they do not apply.
    """

    model: InstrumentModel
    states: NDArray[np.int64]
    warnings: tuple[str, ...]
    correction: CountCorrection
    counts: CountsCorrection | None
    struck: NDArray[np.int64]
    w: Array
    inversion: Inversion
    levels: SourceLevels | None
    field: Field | None
    noise: NoiseModel | None
    choice: Choice
    sent: SentLight | None
    systematic: Systematic | None

    @classmethod
    def of(
        cls,
        capture: Capture,
        model: InstrumentModel,
        correction: CountCorrection | None = None,
        choice: Choice | None = None,
        *,
        left_out: Exclusions | None = None,
    ) -> "MuellerReduction":
        """Prepare the reduction of a capture; see `reduce_mueller` for parameters and errors."""
        left_out, choice = left_out or Exclusions(), choice or Choice()
        every = sample_states(capture)
        states, cut_off = without_cut_off(capture, left_out.rest_of(every, capture.path))
        warnings = (*left_out.warnings, *cut_off)
        changes = capture_changes(capture, model, states)
        correction = correction or CountCorrection.of(capture)
        counts, struck = counts_correction(changes, model), _renumber_hits(left_out.hits, every, states)
        basis = determined_basis(model)
        varies = changes is not None and bool(changes.field_retardance_rad)
        reader = BlockReader(capture, states, correction, counts, struck=struck)
        source = LeveledSource.of(reader, model, basis, varies)
        w, levels = source.leveled(measurement_matrix(capture, model, states, changes))
        source_text = "".join(f"{text}: " for text in (capture.path, *warnings))
        inversion = Inversion.of(w.reshape(-1, ELEMENTS), source_text, basis, levels.spent if levels else 0.0)
        if inversion.rank < ELEMENTS and (choice.physical or varies):
            raise ProcessError(
                f"{capture.path}: instrument {model.name!r} determines {inversion.rank} of 16 numbers; --physical and "
                "field_retardance need all of them. Leave them away."
            )
        field = field_of(capture, model, states, changes, level=levels.relative if levels else None)
        noise = choice.noise or noise_of(capture, states)
        if noise is None:
            plain = MuellerSolver(inversion, reader, None)
            noise = noise_of_residual(plain, choice.solver(plain, field))

        def matrix(trial: InstrumentModel) -> tuple[Array, Array]:
            w = source.leveled(measurement_matrix(capture, trial, states, capture_changes(capture, trial, states)))[0]
            return w, w

        def counts_of(trial: InstrumentModel) -> CountsCorrection | None:
            return counts_correction(capture_changes(capture, trial, states), trial)

        return cls(
            model=model,
            states=states,
            warnings=warnings,
            correction=correction,
            counts=counts,
            struck=struck,
            w=w,
            inversion=inversion,
            levels=levels,
            field=field,
            noise=noise,
            choice=choice,
            sent=SentLight.of(inversion),
            systematic=Systematic.of(model, matrix, counts_of, inversion.basis),
        )

    @property
    def planes(self) -> dict[str, Plane]:
        """Datasets of the image."""
        planes = self.choice.planes(known_noise=self.noise is not None and self.noise.residual_share is None)
        planes |= SENT_PLANES if self.sent is not None else {}
        if self.systematic is not None:
            planes |= SYSTEMATIC if self.sent is None else SENT_SYSTEMATIC
        return planes

    def solver(self, capture: Capture) -> Solver:
        """The solver of row blocks of the capture, which is open."""
        reader = BlockReader(capture, self.states, self.correction, self.counts, struck=self.struck)
        return self.choice.solver(MuellerSolver(self.inversion, reader, self.noise), self.field)

    def block(self, solver: Solver, rows: slice) -> dict[str, NDArray[Any]]:
        """The planes of some rows, each (..., rows, columns)."""
        planes_found = self._solve(solver, solver.reader.read(rows))
        planes = self.planes
        shape = (rows.stop - rows.start, solver.reader.capture.frame_shape[1])
        if "mueller_physical" in planes and "mueller_physical" not in planes_found:
            planes_found["mueller_physical"] = nearest(planes_found["mueller"])
        return {name: planes_found[name].reshape(*plane.leading, *shape) for name, plane in planes.items()}

    def _solve(self, solver: Solver, frames: NDArray[Any]) -> dict[str, NDArray[Any]]:
        planes = self._estimate(solver, frames)
        lost = (planes["pixel_flags"] & LOST) != 0
        if self.sent is not None:
            planes |= self.sent.planes(planes["mueller"], self._variance_ratio(planes), solver)
            if self.systematic is not None:
                planes["stokes_systematic"] = self.systematic.errors(planes["mueller"], self.sent.rows)
                planes["stokes_systematic"][~self.sent.is_determined] = np.nan
        elif self.systematic is not None:
            planes["mueller_systematic"] = self.systematic.errors(planes["mueller"])
        _blank(planes, lost, ~determined_elements(self.inversion.basis))
        return planes

    def _estimate(self, solver: Solver, frames: NDArray[Any]) -> dict[str, NDArray[Any]]:
        planes = solver.solve(frames)
        if self.noise is not None and self.noise.residual_share:
            # The error of the darks is common to all states and not in the residual.
            dark = np.square(solver.dark_errors).sum(axis=1, keepdims=True)
            own = (np.square(planes["mueller_errors"]) - dark) * self._variance_ratio(planes)
            planes["mueller_errors"] = np.sqrt(own + dark)
        if self.levels is not None:
            self.levels.add_errors(planes, self.inversion)
        return planes

    def _variance_ratio(self, planes: dict[str, NDArray[Any]]) -> Array | float:
        """Variance of the noise of each pixel (pixels,) over what the noise model gives: its own residual's share."""
        share = None if self.noise is None else self.noise.residual_share
        return 1 + share * (planes["reduced_chi_square"] - 1) if share else 1.0

    def region(self, capture: Capture, rows: slice, columns: slice) -> tuple[MuellerImage, Array]:
        """A region as an image of one pixel, the mean of those that can be used, and its intensities (N channels,).

        Intensities are signals in counts above black. Where W varies over the image, that of the middle is taken.
        Raises ProcessError: no pixel of the region can be used.
        """
        solver = self.solver(capture)
        frames = solver.reader.read(rows)
        planes = self._estimate(solver, frames)
        signal = np.empty(frames.shape, np.float32)
        solver.reader.signal(frames, slice(None), signal)
        shape = (rows.stop - rows.start, capture.frame_shape[1])

        def part(values: NDArray[Any]) -> NDArray[Any]:
            return values.reshape(*values.shape[:-1], *shape)[..., columns]

        flags = part(planes["pixel_flags"])
        good = flags & LOST == 0
        count = int(good.sum())
        if not count:
            raise ProcessError(f"no pixel can be used ({Mask.words(int(flags.max()))})")
        mueller, errors = part(planes["mueller"])[..., good], part(planes["mueller_errors"])[..., good]
        w = self._matrix_at(rows, columns, capture.frame_shape)
        intensities = part(signal.reshape(len(w), -1))[:, good].mean(axis=1, dtype=float)
        m = mueller.reshape(ELEMENTS, -1).mean(axis=1, dtype=float)
        nothing = np.full(len(w), np.nan)
        total = np.sqrt(np.square(errors.astype(float)).sum(axis=-1)) / count
        image = MuellerImage(
            values=m.reshape(4, 4, 1, 1).astype(np.float32),
            errors=total.reshape(4, 4, 1, 1).astype(np.float32),
            mask=np.zeros((1, 1), np.uint8),
            residual_rms=np.array([[np.sqrt(np.mean((intensities - w @ m) ** 2))]], np.float32),
            w=w,
            noise_slope=nothing if self.noise is None else self.noise.slope / solver.repeats / count,
            noise_floor=nothing if self.noise is None else solver.intensity_floor / count,
            header=capture.header,
            steps=(),
            simulated=capture.simulated,
            facts={
                "weighted": self.choice.weighted,
                "rank": self.inversion.rank,
                "determined": determined_words(self.inversion),
                "pixels": count,
            },
            dark=solver.dark_errors / np.sqrt(count),
        )
        return image, intensities

    def _matrix_at(self, rows: slice, columns: slice, shape: tuple[int, int]) -> Array:
        """W (N channels, 16) in the middle of a region of an image of this shape."""
        if self.field is None:
            return self.inversion.w
        middle = [(part.start + part.stop - 1) / 2 for part in (columns, rows)]
        x, y = (np.array([2 * at / max(size - 1, 1) - 1]) for at, size in zip(middle, shape[::-1], strict=True))
        return self.field.matrix(self.field.extra(x, y)[:, 0])


def _blank(planes: Mapping[str, NDArray[Any]], lost: NDArray[np.bool_], unseen: NDArray[np.bool_]) -> None:
    """Replace by NaN the elements that the instrument cannot see, and every value of lost pixels."""
    if unseen.any():
        for name in {"mueller", "mueller_errors", "mueller_systematic"} & set(planes):
            planes[name][unseen] = np.nan
        if "mueller_covariance" in planes:
            planes["mueller_covariance"][(unseen[:, None] | unseen)[np.tril_indices(ELEMENTS)]] = np.nan
    for name, values in planes.items():
        if lost.any() and name != "pixel_flags":
            values[..., lost] = np.nan


def _renumber_hits(hits: NDArray[np.int64], every: NDArray[np.int64], states: NDArray[np.int64]) -> NDArray[np.int64]:
    """Hits (H, 4) in `states`, their state counted among `states` and no longer among `every`."""
    renumbered = hits[np.isin(every[hits[:, 0]], states)]
    renumbered[:, 0] = np.searchsorted(states, every[renumbered[:, 0]])
    return renumbered
