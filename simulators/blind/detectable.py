"""Could a fault be seen at all: the chi-square that it adds in noise-free intensities, what else is free taken out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from processing.arrays import Array
from processing.diagnosis.captured.capture_data import CaptureData
from processing.diagnosis.captured.read_capture import read_capture
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.search.candidate import pool
from processing.diagnosis.search.fit import minimize
from processing.diagnosis.search.space import Space
from processing.instrument.model import InstrumentModel
from processing.storage.captures.capture import Capture
from simulators.blind.undeclared_captures import BITS, BLACK, Bench
from simulators.blind.undeclared_faults import Truth

#: Chi-square from which on a fault is detectable.
DETECTABLE = 50.0
#: Noise is made this much smaller in the fit of noise-free intensities, so that what is subtracted for it is nothing.
QUIET = 1e-6


def expected_electrons(bench: Bench, electrons: Array) -> Array:
    """Electrons (N, rows, columns) that the detector collects on average."""
    found = np.minimum(electrons, bench.full_well)
    for curve in bench.transfer:
        found = curve(found)
    return found


def expected(bench: Bench, electrons: Array) -> Array:
    """Counts (N, rows, columns) above black that the detector reports on average."""
    return np.asarray(expected_electrons(bench, electrons) / bench.gain)


def evidence(
    path: Path, model: InstrumentModel, counts: Array, fault: Truth, without: Array | None, others: Sequence[Truth]
) -> float:
    """Gain in chi-square on held-out data that the right name of a fault can expect, given the other faults.

    Every value that is fitted to one half of the data costs 2 on the other half. The other faults are fitted to the
    counts of all, so that what they could take up of this one is theirs. What their fit leaves of their own counts (by
    another route than the effect's) does not count for this one.

    Parameters
    ----------
    path : the capture, for its noise; the counts in it are not looked at.
    model : as declared, resolved at the wavelength.
    counts : (N, rows, columns) noise-free, above black, with all faults; `without` this one.
    """
    with Capture(path) as capture:
        data = read_capture(capture, model)
    size = next((c.size for c in pool(model, [data.conditions]) if c.kind == fault.kind), 0)
    left = _left(data, model, counts, others) - 2 * size
    return left if without is None else left - _left(data, model, without, others)


def _left(data: CaptureData, model: InstrumentModel, counts: Array, others: Sequence[Truth]) -> float:
    """Chi-square of noise-free counts that the free unknowns and the effects of `others` cannot take up."""
    if model.mosaic is None:
        planes = counts[:, None]
    else:
        where = {name: (r, c) for r, line in enumerate(model.mosaic) for c, name in enumerate(line)}
        planes = np.stack([counts[:, where[c.name][0] :: 2, where[c.name][1] :: 2] for c in model.channels], axis=1)
    signal = (planes / (2.0**BITS - 1 - BLACK)).astype(np.float32)
    quiet = replace(data, signal=signal, slope=data.slope * QUIET, floor=data.floor * QUIET)
    problem = InstrumentProblem(model, [quiet])
    wanted = {(t.kind, t.place) for t in others}
    space = Space(tuple(c for c in problem.pool() if (c.kind, c.place) in wanted))
    best = np.inf
    starts = [np.zeros(space.size), *([np.ones(space.size)] if space.fixed.any() else [])]
    for candidate, part in zip(space.candidates, space.slices, strict=True):
        for start in candidate.starts:
            far = np.zeros(space.size)
            far[part] = start
            starts.append(far)
    for start in starts:
        best = min(best, minimize(problem, space, start).excess)
    return float(best * QUIET)
