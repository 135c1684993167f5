"""Pull, bias and coverage of every quoted error bar: quantity x light level x sample, by Monte Carlo.

    python benchmarks/error_bars.py [--pixels 1000] [--states "24 random states"] [--out table.md]

Each of five samples is measured many times at 20, 200 and 20 000 electrons a state with own Poisson and read noise
(`noisy_images.py`), and goes through the same functions as `process quantities` and `process xi0`. An entry is
"rms pull / mean pull / coverage of +- 1 error in %"; "-" where the program says "not determined" in most pixels, with
the part of the pixels that are determined in brackets where it does in some. Components are taken together.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from noisy_images import LIGHT_LEVELS, five_samples, noisy_image, state_tables

from processing.maps.quantities import EXTRA, quantities_block
from processing.maps.xi0 import eigenvalue_block
from processing.polarization.cloude import coherency_eigenvalues
from processing.polarization.quantities import PAPER_PAIRS
from processing.reports.colours import period_deg

#: Brightness of the truth: its noise is below rounding.
BRIGHT = 1e13
#: A quantity that varies by less than this in the truth's own error is fixed by definition.
FIXED = 1e-9


class Entry(NamedTuple):
    """How well one error bar holds."""

    quantity: str
    sample: str
    electrons: float
    determined: float
    rms: float
    bias: float
    coverage: float


def entries(
    sample: str, electrons: float, pixels: int, extra: tuple[str, ...] = (), w: np.ndarray | None = None
) -> Iterator[Entry]:
    """Every quantity of one sample at one light level, with the RGB950's states or those of w (N, 16)."""
    matrix = five_samples()[sample]
    truth = quantities_block(noisy_image(matrix[None], BRIGHT, 0, w), extra, PAPER_PAIRS)
    image = noisy_image(np.tile(matrix, (pixels, 1, 1)), electrons, 7, w)
    found = quantities_block(image, extra, PAPER_PAIRS)
    for name in found:
        if f"{name}_errors" in found and name not in ("coherency_eigenvalues", "eigenvalue_deviation"):
            yield _entry(name, sample, electrons, found[name], found[f"{name}_errors"], truth[name])
    xi = coherency_eigenvalues(matrix[None])[0]
    for k in range(4):
        values, errors = found["coherency_eigenvalues"][k], found["coherency_eigenvalues_errors"][k]
        yield _entry(f"coherency_eigenvalues[{k}]", sample, electrons, values, errors, xi[k])
    of_xi0 = eigenvalue_block(image)
    yield _entry("process xi0", sample, electrons, of_xi0["xi0"], of_xi0["xi0_errors"], xi[0])


def _entry(
    name: str, sample: str, electrons: float, values: np.ndarray, errors: np.ndarray, truth: np.ndarray
) -> Entry:
    error = values.astype(float) - truth
    if (period := period_deg(name, "degree" if name.endswith("_deg") else "")) is not None:
        error -= period * np.round(error / period)
    known = np.isfinite(error) & np.isfinite(errors) & (errors > FIXED)
    varies = known.mean(axis=-1, keepdims=True) > 0.5
    pull = (error / np.where(known, errors, 1))[known & varies]
    share = float(known.mean())
    if not pull.size:
        return Entry(name, sample, electrons, share, np.nan, np.nan, np.nan)
    return Entry(
        name,
        sample,
        electrons,
        share,
        float(np.sqrt(np.mean(pull**2))),
        float(np.mean(pull)),
        float(np.mean(np.abs(pull) < 1)),
    )


def table(pixels: int, extra: tuple[str, ...] = EXTRA, w: np.ndarray | None = None) -> str:
    """The whole table in Markdown."""
    samples = list(five_samples())
    cells = {
        (e.quantity, e.electrons, e.sample): _cell(e)
        for sample in samples
        for electrons in LIGHT_LEVELS
        for e in entries(sample, electrons, pixels, extra, w)
    }
    names = list(dict.fromkeys(name for name, _, _ in cells))
    lines = [f"| quantity | electrons | {' | '.join(samples)} |", "|---|---|" + "---|" * len(samples)]
    for name in names:
        for electrons in LIGHT_LEVELS:
            row = [cells.get((name, electrons, sample), "") for sample in samples]
            lines.append(f"| {name} | {electrons:g} | " + " | ".join(row) + " |")
    return "\n".join(lines) + "\n"


def _cell(e: Entry) -> str:
    if not np.isfinite(e.rms) or e.determined < 0.5:
        return "-"
    part = "" if e.determined > 0.99 else f" ({100 * e.determined:.0f} %)"
    return f"{e.rms:.2f} / {e.bias:+.2f} / {100 * e.coverage:.0f}{part}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pixels", type=int, default=1000)
    parser.add_argument("--states", choices=state_tables(), default="RGB950's 40", help="good and poor states")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    text = table(arguments.pixels, w=state_tables()[arguments.states])
    if arguments.out:
        arguments.out.write_text(text, encoding="utf-8")
    print(text)
