"""Pull and coverage of every quoted error bar, by Monte Carlo: quantity x light x sample x instrument x darks.

    python benchmarks/error_bars.py [--pixels 1000] [--short] [--out cells.csv]

Each of 19 samples is measured `--pixels` times with own Poisson and read noise (`noisy_images.py`) and goes through the
same functions as `process reduce`, `process quantities` and `process xi0`. Every pixel counts. A quantity that the
sample does not have (the azimuth of no diattenuation) is left out. Components are taken together.
"""

import argparse
import csv
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from noisy_images import nineteen_samples, noisy_image, seven_instruments
from scipy.stats import norm

from processing.maps.quantities import EXTRA, quantities_block
from processing.maps.ranges import ANGLES_OF, SIGNED, whole_range
from processing.maps.xi0 import eigenvalue_block
from processing.polarization.magnitude import NORMAL_95
from processing.polarization.quantities import PAPER_PAIRS
from processing.reports.colours import period_deg
from processing.storage.products.images import MuellerImage

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
#: Limits of both coverages and of pulls.
LIMITS = ((0.64, 0.72), (0.93, 0.97), (0.9, 1.1))
#: A cell is outside where its pixels are so many standard deviations beyond a limit: by chance one limit in 1000.
SURE = 3.09
#: Pixels of a cell fewer than this part do not tell.
FEW = 0.05
#: A quantity whose error at `BRIGHT` is larger than this does not exist.
UNDEFINED = 0.01


@dataclass(frozen=True)
class Cell:
    """How well one error bar holds.

    Attributes
    ----------
    has_interval : part of the pixels that have one.
    in_68, in_95 : part of the truths within the intervals; a pixel without one does not cover.
    rms, mean : of the pulls of pixels without `all_95`, each over the error of the side where the truth is.
    rms_error : standard error of `rms`.
    all_68, all_95 : part of the pixels whose interval is all that the quantity can be.
    others_68, others_95 : part of the truths within the intervals of all other pixels; NaN where there is none.
    at_end : whether the truth is within three errors (the median) of an end of the range.
    folds : whether the retardance is as near to 180 degrees, where a turn by x is one by x - 360.
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
    rms_error: float
    all_68: float
    all_95: float
    others_68: float
    others_95: float
    at_end: bool
    folds: bool


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
    w = seven_instruments()[instrument]
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
            tolerance = ROUNDING + 3 * true_error
            has_68, is_lost = f"{name}_68" in planes, ~np.isfinite(value)
            bounds = planes[f"{name}_68"][..., block] if has_68 else (value - error, value + error)
            low_68, high_68 = (np.where(is_lost, *ends) for ends in zip((low, high), bounds, strict=True))
            close = ROUNDING * (360 if "_deg" in name else 1)
            inside, everything = [], []
            with np.errstate(invalid="ignore", divide="ignore"):
                for down, up in ((low_68, high_68), (low, high)):
                    # Both from the value: an angle's interval goes on beyond its period.
                    near = np.where(is_lost, true, value)
                    distance = np.where(is_lost, 0, deviation)
                    inside.append(((distance <= near - down + tolerance) & (distance >= near - up - tolerance))[exists])
                    everything.append(((down <= least + close) & (up >= most - close))[exists])
                # An interval of 68 % that is even about the value may have to end beyond the range on one side.
                everything[0] |= everything[1]
                sides = np.where(deviation > 0, value - low, high - value) / NORMAL_95
                # An end of the range is no error.
                end = np.where(deviation > 0, (low <= least + close) | (low == 0), high >= most - close)
                over = np.where(end | (sides <= 0) | ~np.isfinite(sides), error, sides)
                pull = (deviation / over)[exists][~everything[1] & (np.isfinite(value) & np.isfinite(error))[exists]]
                first, last = whole_range(name, true)
                distance = np.minimum(true - first, last - true) - tolerance
                near_end = (distance < 3 * np.nanmedian(error, axis=-1, keepdims=True)) & exists[..., :1]
                at_end = period is None and bool(near_end.any())
                turn, noise = truth["retardance_deg"][..., k : k + 1], planes["retardance_deg_errors"][..., block]
                folds = name in SIGNED and bool(180 - turn.max() < 3 * np.nanmedian(noise))
            square = np.square(pull)
            rms = np.sqrt(square.mean()) if pull.size else np.nan
            yield Cell(
                name,
                instrument,
                darks,
                electrons,
                sample,
                float((exists & ~np.isnan(low)).sum() / exists.sum()),
                *(float(part.mean()) for part in inside),
                float(rms),
                float(np.mean(pull)) if pull.size else np.nan,
                float(square.std() / np.sqrt(len(square)) / (2 * rms)) if pull.size else np.nan,
                *(float(part.mean()) for part in everything),
                *(
                    float(part[~whole].mean()) if not whole.all() else np.nan
                    for part, whole in zip(inside, everything, strict=True)
                ),
                at_end,
                folds,
            )


def _planes(image: MuellerImage, extra: Sequence[str]) -> dict[str, np.ndarray]:
    planes = quantities_block(image, tuple(extra), PAPER_PAIRS) | {
        "mueller": image.values,
        "mueller_errors": image.errors,
    }
    xi0 = eigenvalue_block(image)
    return planes | {f"process {name}": xi0[name] for name in ("xi0", "xi0_errors", "xi0_68", "xi0_95")}


def verdicts(cell: Cell, pixels: int) -> tuple[str, str, str]:
    """Of the 68 and the 95 % interval and the pulls: see `VERDICTS`.

    Parameters
    ----------
    pixels : of the cell; components of one pixel count as one.
    """
    results = []
    covered = ((cell.in_68, cell.all_68, cell.others_68), (cell.in_95, cell.all_95, cell.others_95))
    for (least, most), (inside, whole, others) in zip(LIMITS[:2], covered, strict=True):
        spread = [SURE * np.sqrt(limit * (1 - limit) / pixels) for limit in (least, most)]
        rest = SURE * np.sqrt(most * (1 - most) / max(pixels * (1 - whole), 1))
        if inside < least - spread[0]:
            results.append("low")
        elif inside <= most + spread[1]:
            results.append("in")
        elif whole > 0 and (not others > most + rest or whole > 1 - FEW):
            results.append("range")
        else:
            results.append("fold" if cell.folds else "high")
    least, most = LIMITS[2]
    # All that an interval may miss is in the pixels whose interval is no whole range: they are chosen by their noise.
    missed = min((1 - LIMITS[1][0]) / max(1 - cell.all_95, 1e-9), 1.0)
    most *= max(NORMAL_95 / max(norm.isf(missed / 2), 1e-9), 1.0)
    off = max(least - cell.rms, cell.rms - most) / cell.rms_error if cell.rms_error > 0 else -1.0
    few = cell.all_95 > 1 - FEW
    reason = "range" if few else "end" if cell.at_end else "fold" if cell.folds else "low" if cell.rms > 1 else "high"
    results.append(reason if off > SURE else "in")
    return results[0], results[1], results[2]


#: Verdicts of coverage and pulls, from best to worst. Why "range", "end" and "fold" are no faults: see the study.
VERDICTS = {
    "in": "within the limits",
    "range": "too often by pixels whose interval is the whole range",
    "end": "pulls at an end of the range",
    "fold": "a turn by x is one by x - 360",
    "low": "too seldom, or pulls too large",
    "high": "too often, or pulls too small",
}


def table(results: Sequence[Cell], pixels: int) -> str:
    """Markdown: of every quantity and light level median and range of coverage and pulls, and the cells by verdict."""
    heads = ["quantity", "electrons", "cells", "68 %", "95 %", "pull", *VERDICTS]
    lines = [f"| {' | '.join(heads)} |", len(heads) * "|---" + "|"]
    total = dict.fromkeys(VERDICTS, 0)
    for name in dict.fromkeys(c.quantity for c in results):
        for electrons in dict.fromkeys(c.electrons for c in results):
            group = [c for c in results if c.quantity == name and c.electrons == electrons]
            if not group:
                continue
            shares = []
            for numbers, form in (([c.in_68 for c in group], ".0%"), ([c.in_95 for c in group], ".0%")):
                ends = [format(x, form)[:-1] for x in (np.median(numbers), min(numbers), max(numbers))]
                shares.append("{} ({} to {})".format(*ends))
            pulls = [c.rms for c in group if np.isfinite(c.rms)]
            pull = f"{np.median(pulls):.2f} ({min(pulls):.2f} to {max(pulls):.2f})" if pulls else "-"
            counts = dict.fromkeys(VERDICTS, 0)
            for cell in group:
                # The worst of the three.
                counts[max(verdicts(cell, pixels), key=list(VERDICTS).index)] += 1
            total = {key: total[key] + count for key, count in counts.items()}
            numbers = " | ".join(str(n) for n in counts.values())
            lines.append(f"| {name} | {electrons:g} | {len(group)} | {' | '.join(shares)} | {pull} | {numbers} |")
    lines.append(f"| all | | {len(results)} | | | | {' | '.join(str(n) for n in total.values())} |")
    return "\n".join(lines) + "\n"


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
    print(table(every, arguments.pixels))
