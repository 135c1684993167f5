"""Pull and coverage of every quoted error bar, by Monte Carlo: quantity x light x sample x instrument x darks.

    python benchmarks/error_bars.py [--pixels 1000] [--short] [--out cells.csv]

Each of 19 samples is measured `--pixels` times with own Poisson and read noise (`noisy_images.py`) and goes through the
same functions as `process reduce`, `process quantities` and `process xi0`. Every pixel counts. A quantity that the
sample does not have (the azimuth of no diattenuation) is left out. Components are taken together.
"""

import argparse
import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from noisy_images import nineteen_samples, noisy_image, seven_instruments

from processing.maps.intervals import ANGLES_OF, whole_range
from processing.maps.quantities import EXTRA, quantities_block
from processing.maps.xi0 import eigenvalue_block
from processing.polarization.magnitude import NORMAL_95
from processing.polarization.quantities import PAPER_PAIRS
from processing.reports.colours import period_deg

LIGHT = (20.0, 60.0, 200.0, 2000.0, 20_000.0)
DARKS = (0, 1, 4)
#: Brightness of the truth: its noise is below rounding.
BRIGHT = 1e13
#: A quantity that varies by less than this in the truth's own error is fixed by definition.
FIXED = 1e-9
#: Of float32, and of what is zero.
ROUNDING = 1e-6
#: A vector shorter than so many errors at `BRIGHT` has no direction.
UNDEFINED_LENGTH = 30
#: More than this covers too often; pixels of a cell fewer than this part do not tell.
MOST_95, FEW = 0.97, 0.05
#: A quantity whose error at `BRIGHT` is larger than this does not exist.
UNDEFINED = 0.01


@dataclass(frozen=True)
class Cell:
    """How well one error bar holds.

    Attributes
    ----------
    has_interval : part of the pixels that have one.
    in_68, in_95 : part of the truths within the intervals; a pixel without one does not cover.
    rms, mean : of the pulls.
    everything : part of the pixels whose 95 % interval is all that the quantity can be.
    in_95_others : part of the truths within the 95 % intervals of all other pixels; NaN where there is none.
    """

    quantity: str
    instrument: str
    darks: int
    electrons: float
    sample: str
    has_interval: float
    in_68: float
    in_95: float
    rms: float
    mean: float
    everything: float
    in_95_others: float


def cells(
    instrument: str,
    darks: int,
    electrons: float,
    pixels: int,
    *,
    samples: Sequence[str] = (),
    extra: Sequence[str] = EXTRA,
    first_seed: int = 7,
) -> Iterator[Cell]:
    """Every quantity of every one of the 19 samples, or of those named, seen by one of the seven instruments."""
    matrices = {name: m for name, m in nineteen_samples().items() if not samples or name in samples}
    seed = [first_seed, darks, int(electrons), list(seven_instruments()).index(instrument)]
    w = {instrument: seven_instruments()[instrument]}
    yield from cells_of(matrices, w, darks, electrons, pixels=pixels, extra=extra, seed=seed)


def cells_of(
    matrices: Mapping[str, np.ndarray],
    instrument: Mapping[str, np.ndarray],
    darks: int,
    electrons: float,
    *,
    pixels: int,
    extra: Sequence[str],
    seed: Sequence[int],
) -> Iterator[Cell]:
    """The same of samples (4, 4) by name and of one instrument W (N, 16) by name."""
    ((name_of_w, w),) = instrument.items()
    stack = np.stack(list(matrices.values()))
    truth = _planes(noisy_image(stack, BRIGHT, 0, w), extra)
    planes = _planes(noisy_image(np.repeat(stack, pixels, axis=0), electrons, seed, w, darks=darks), extra)
    length_of = {angle: length for length, angles in ANGLES_OF.items() for angle in angles}
    for k, sample in enumerate(matrices):
        block = slice(k * pixels, (k + 1) * pixels)
        for name in planes:
            if f"{name}_errors" not in planes:
                continue
            value, error = (planes[n][..., block].astype(float) for n in (name, f"{name}_errors"))
            true, true_error = (truth[n][..., k : k + 1].astype(float) for n in (name, f"{name}_errors"))
            if name == "mueller":
                true = stack[k].reshape(4, 4, 1, 1) * electrons / w[:, 0].mean()
                true_error = 1e-6 * np.ones_like(true)
            bounds = planes.get(f"{name}_95")
            least, most = whole_range(name, value)
            if bounds is None:
                low, high = value - NORMAL_95 * error, value + NORMAL_95 * error
                is_unbounded = ~np.isfinite(value) & (error >= most - least)
                low, high = np.where(is_unbounded, least, low), np.where(is_unbounded, most, high)
            else:
                low, high = bounds[..., block].astype(float)
            period = period_deg(name, "degree" if name.endswith("_deg") else "")
            deviation = value - true
            if period is not None:
                deviation -= period * np.round(deviation / period)
            exists = np.isfinite(true) & (true_error < UNDEFINED * (180 if "_deg" in name else 1))
            if name in length_of:
                length, noise = (truth[n][..., k : k + 1] for n in (length_of[name], f"{length_of[name]}_errors"))
                exists &= length > UNDEFINED_LENGTH * noise
            exists = np.broadcast_to(exists & (np.nan_to_num(error).max(axis=-1, keepdims=True) > FIXED), value.shape)
            if not exists.any():
                continue
            is_finite = exists & np.isfinite(error) & np.isfinite(value)
            tolerance = ROUNDING + 3 * true_error
            with np.errstate(invalid="ignore", divide="ignore"):
                pull = (deviation / error)[is_finite]
                inside_95 = ((deviation <= value - low + tolerance) & (deviation >= value - high - tolerance))[exists]
                inside_68 = (np.abs(deviation) <= error + tolerance)[exists]
                if f"{name}_68" in planes:
                    bounds = planes[f"{name}_68"][..., block]
                    inside_68 = ((bounds[0] <= true + tolerance) & (true - tolerance <= bounds[1]))[exists]
            # Where there is no value the interval is everything.
            unknown = (~np.isfinite(value) & (low <= true + tolerance) & (true - tolerance <= high))[exists]
            inside_68, inside_95 = inside_68 | unknown, inside_95 | unknown
            close = ROUNDING * (360 if "_deg" in name else 1)
            everything = ((low <= least + close) & (high >= most - close))[exists]
            yield Cell(
                name,
                name_of_w,
                darks,
                electrons,
                sample,
                float((exists & ~np.isnan(low)).sum() / exists.sum()),
                float(inside_68.mean()),
                float(inside_95.mean()),
                float(np.sqrt(np.mean(pull**2))) if pull.size else np.nan,
                float(np.mean(pull)) if pull.size else np.nan,
                float(everything.mean()),
                float(inside_95[~everything].mean()) if not everything.all() else np.nan,
            )


def _planes(image: object, extra: Sequence[str]) -> dict[str, np.ndarray]:
    planes = quantities_block(image, tuple(extra), PAPER_PAIRS)  # type: ignore[arg-type]
    xi0 = eigenvalue_block(image)  # type: ignore[arg-type]
    return planes | {
        "mueller": image.values,  # type: ignore[attr-defined]
        "mueller_errors": image.errors,  # type: ignore[attr-defined]
        "process xi0": xi0["xi0"],
        "process xi0_errors": xi0["xi0_errors"],
        "process xi0_68": xi0["xi0_68"],
        "process xi0_95": xi0["xi0_95"],
    }


def table(results: Sequence[Cell]) -> str:
    """Markdown: of every quantity and light level the median and the range of coverage and pulls."""
    lines = ["| quantity | electrons | cells | 68 % | 95 % | pull | in all limits |", "|---|---|---|---|---|---|---|"]
    for name in dict.fromkeys(c.quantity for c in results):
        for electrons in dict.fromkeys(c.electrons for c in results):
            group = [c for c in results if c.quantity == name and c.electrons == electrons]
            if group:
                parts = [[100 * c.in_68 for c in group], [100 * c.in_95 for c in group]]
                shares = [f"{np.median(p):.0f} ({min(p):.0f} to {max(p):.0f})" for p in parts]
                pulls = [c.rms for c in group if np.isfinite(c.rms)]
                pull = f"{np.median(pulls):.2f} ({min(pulls):.2f} to {max(pulls):.2f})" if pulls else "-"
                valid = sum(holds(c) for c in group)
                lines.append(f"| {name} | {electrons:g} | {len(group)} | {' | '.join(shares)} | {pull} | {valid} |")
    return "\n".join(lines) + "\n"


def table_of_everything(results: Sequence[Cell]) -> str:
    """Markdown: of cells whose 95 % intervals cover above 97 %, how many do so as their data do not say more."""
    lines = ["| quantity | electrons | above 97 % | by whole ranges | whole ranges | others |", 6 * "|---" + "|"]
    for name in dict.fromkeys(c.quantity for c in results):
        for electrons in dict.fromkeys(c.electrons for c in results):
            group = [c for c in results if c.quantity == name and c.electrons == electrons]
            over_97 = [c for c in group if c.in_95 > MOST_95]
            # The others cover no more than they claim, or are too few to tell.
            by_range = [c for c in over_97 if not c.in_95_others > MOST_95 or c.everything > 1 - FEW]
            weights = np.array([1 - c.everything for c in group])
            weighted = np.array([c.in_95_others for c in group])[weights > 0] @ weights[weights > 0]
            share = 100 * np.mean([c.everything for c in group]) if group else 0
            coverage = f"{100 * weighted / weights.sum():.1f}" if weights.sum() > 0 else "-"
            lines.append(f"| {name} | {electrons:g} | {len(over_97)} | {len(by_range)} | {share:.0f} | {coverage} |")
    return "\n".join(lines) + "\n"


def holds(cell: Cell) -> bool:
    """Whether a cell is within the limits: 64 to 72 %, 93 to 97 %, pulls of 0.9 to 1.1."""
    return 0.64 <= cell.in_68 <= 0.72 and 0.93 <= cell.in_95 <= 0.97 and 0.9 <= cell.rms <= 1.1


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pixels", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=7, help="another one draws other noise")
    parser.add_argument("--short", action="store_true", help="one instrument, no darks")
    parser.add_argument("--out", type=Path, help="every cell as CSV")
    arguments = parser.parse_args()
    instruments = list(seven_instruments())[: 1 if arguments.short else None]
    every = [
        cell
        for instrument in instruments
        for darks in DARKS[: 1 if arguments.short else None]
        for electrons in LIGHT
        for cell in cells(instrument, darks, electrons, arguments.pixels, first_seed=arguments.seed)
    ]
    if arguments.out:
        with arguments.out.open("w", newline="", encoding="utf-8") as stream:
            writer = csv.DictWriter(stream, list(asdict(every[0])))
            writer.writeheader()
            writer.writerows(asdict(cell) for cell in every)
    print(table(every))
    print(table_of_everything(every))
