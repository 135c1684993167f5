"""What is uncertain in an instrument, as directions in which all pixels of a Mueller or Stokes image are wrong at once.

Unlike noise it does not average over pixels or captures. One direction is one standard deviation of something
independent: a value of the train whose standard uncertainty the instrument file states, or what its diagnosis left.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.instrument.model import InstrumentModel
from processing.instrument.uncertainty import value_directions
from processing.reduction.effects_of_capture import FEATURES, CountsCorrection
from processing.storage.products.images import SMALLEST
from processing.storage.products.product import Product
from processing.storage.products.product_writer import ProductWriter

#: Fact of a product: what its directions are.
INPUTS = "uncertain_in_the_instrument"


@dataclass(frozen=True)
class Direction:
    """One independent direction of one standard deviation.

    Attributes
    ----------
    label : what is uncertain, with the identity of the instrument.
    u : standard uncertainty of that value, in its unit; NaN where it is no single value of the train.
    turn : (K, K); the unknowns of a pixel move by `turn` times themselves.
    rows : (L, 16), the measurement matrix with this error.
    counts : a correction of the counts that moves the unknowns further; None without.
    """

    label: str
    u: float
    turn: Array
    rows: Array
    counts: CountsCorrection | None


@dataclass(frozen=True)
class Systematic:
    """All directions of one capture, for K unknowns of a pixel: 16 of a Mueller matrix, 3 of a linear Stokes vector.

    Attributes
    ----------
    w, inverse : (L, K) measurement matrix and (K, L) its inverse in what the instrument determines.
    channels : rows of `w` for each state.
    """

    directions: tuple[Direction, ...]
    w: Array
    inverse: Array
    channels: int

    @classmethod
    def of(
        cls,
        model: InstrumentModel,
        matrix: Callable[[InstrumentModel], tuple[Array, Array]],
        counts: Callable[[InstrumentModel], CountsCorrection | None],
        basis: Array,
    ) -> "Systematic | None":
        """Directions of a model; None where it has none.

        Parameters
        ----------
        matrix : makes of a model and its effects the measurement matrix of the capture, (states, channels, 16), and the
            same by the unknowns of a pixel, (states, channels, K).
        counts : makes of them what is corrected in the counts.
        basis : (K, R) what the instrument determines of the unknowns; they move inside of that alone.
        """
        moved: list[tuple[str, float, InstrumentModel, CountsCorrection | None]] = [
            (*value, None) for value in value_directions(model)
        ]
        for error in model.systematic:
            for effects in error.directions:
                label = ", ".join(dict.fromkeys(" ".join(filter(None, (e.kind, e.element))) for e in effects))
                bent = counts(model.model_copy(update={"effects": effects}))
                variant = model.model_copy(update={"effects": (*model.effects, *effects)})
                moved.append((label, np.nan, variant, bent if bent is not None and bent.response else None))
        if not moved:
            return None

        def inverse(w: Array) -> Array:
            return np.asarray(basis @ np.linalg.pinv(w.reshape(-1, len(basis)) @ basis))

        w = matrix(model)[1]
        flat, directions, count = w.reshape(-1, len(basis)), [], Counter[str]()
        for name, u, variant, bent in moved:
            rows, analyzers = matrix(variant)
            turn = inverse(analyzers) @ flat - basis @ basis.T
            count[name] += 1
            label = f"{name}{f' {count[name]}' if count[name] > 1 else ''} ({model.identity})"
            directions.append(Direction(label, u, turn, rows.reshape(-1, 16), bent))
        return cls(tuple(directions), flat, inverse(w), w.shape[1])

    def store(self, product: ProductWriter) -> dict[str, str]:
        """Put the directions into a product; returns the fact that names them."""
        turns, rows = (np.stack([getattr(d, name) for d in self.directions]) for name in ("turn", "rows"))
        text = "one standard uncertainty of each direction moves the unknowns of a pixel by this matrix times them"
        product.array("systematic_turns", turns, "", text)
        product.array("systematic_rows", rows, "", "measurement_matrix with one standard uncertainty of each direction")
        text = "standard uncertainty of each direction, in its own unit; NaN for several values together"
        product.array("systematic_u", np.array([d.u for d in self.directions]), "", text)
        bent = [d.counts for d in self.directions if d.counts is not None]
        if bent:
            each = [self._coefficients(d.counts) for d in self.directions]
            text = f"corrections of each direction by state, channel and {', '.join(FEATURES)} of counts / full_scale"
            product.array("systematic_counts", np.stack(each), "", text)
            product.array("full_scale", np.array(bent[0].full_scale), "count", "counts above black")
        return {INPUTS: "; ".join(d.label for d in self.directions)}

    def _coefficients(self, counts: CountsCorrection | None) -> Array:
        """(features, states, channels)."""
        coefficients = np.zeros((len(FEATURES), len(self.w) // self.channels, self.channels))
        for name, value in counts.response.items() if counts is not None else ():
            coefficients[FEATURES.index(name)] = value
        return coefficients

    @classmethod
    def of_product(cls, product: Product) -> "Systematic | None":
        """The directions that a Mueller or Stokes product was stored with; None where its instrument has none."""
        if not product.has_array("systematic_turns"):
            return None
        w = product.array("analyzers" if product.kind == "stokes" else "measurement_matrix")
        turns, rows = product.array("systematic_turns"), product.array("systematic_rows")
        labels = str(product.facts[INPUTS]).split("; ")
        counts: list[CountsCorrection | None] = [None] * len(turns)
        if product.has_array("systematic_counts"):
            top, each = float(product.array("full_scale")), product.array("systematic_counts")
            responses = [{f: c for f, c in zip(FEATURES, row, strict=True) if c.any()} for row in each]
            counts = [CountsCorrection(top, response, np.zeros((1, 2))) if response else None for response in responses]
        flat = w.reshape(-1, turns.shape[1])
        directions = map(Direction, labels, product.array("systematic_u").tolist(), turns, rows, counts)
        return cls(tuple(directions), flat, np.linalg.pinv(flat, rcond=SMALLEST), w.shape[-2])

    @property
    def labels(self) -> tuple[str, ...]:
        """What is uncertain, one name for each direction."""
        return tuple(d.label for d in self.directions)

    def moves(
        self, values: NDArray[np.floating], rows: Array | None = None, *, is_held: bool = True
    ) -> Iterator[Array]:
        """What each direction does to `rows` (J, K) times the unknowns (K, pixels): (J, pixels).

        Parameters
        ----------
        rows : by default the unknowns themselves.
        is_held : move ratios to the first (m00, S0) alone; else counts, the first included.
        """
        m = values.astype(np.float64)
        rows = np.eye(len(m)) if rows is None else rows
        shown = rows @ m
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = shown / shown[0]
        for direction in self.directions:
            moved = direction.turn @ m
            if direction.counts is not None:
                moved += self.inverse @ self.bent(direction, self.w @ m)
            moved = rows @ moved
            yield moved - relative * moved[0] if is_held else moved

    def bent(self, direction: Direction, intensities: NDArray[np.floating]) -> Array:
        """What a direction adds to intensities (L, pixels) in counts."""
        signal = intensities.astype(np.float32).reshape(-1, self.channels, intensities.shape[1])
        bent = signal.copy()
        if direction.counts is not None:
            # What grows from the middle of the image to its edges has no error in the middle.
            direction.counts.apply(bent, np.zeros(1), np.zeros(1))
        return np.asarray((bent - signal).reshape(intensities.shape), dtype=float)

    def errors(self, values: NDArray[np.floating], rows: Array | None = None) -> NDArray[np.float32]:
        """Standard errors (J, pixels) of what `moves` moves, in the unit of the values; that of the first is zero."""
        variance = sum(moved**2 for moved in self.moves(values, rows))
        return np.asarray(np.sqrt(variance), dtype=np.float32)
