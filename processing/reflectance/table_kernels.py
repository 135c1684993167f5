"""Loops over the samples of a table: in which row each is, and the sums of each row."""

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.computing.compiling import compiled
from processing.computing.threads import for_ranges


def _claim_rows_at_once(
    bins: NDArray[np.int32], row_of_bin: NDArray[np.int32], used: int, new_bins: NDArray[np.int32]
) -> int:
    in_range = bins >= 0
    new, first = np.unique(bins[in_range & (row_of_bin[bins] < 0)], return_index=True)
    new = new[np.argsort(first)]
    row_of_bin[new] = used + np.arange(new.size)
    new_bins[: new.size] = new
    bins[in_range] = row_of_bin[bins[in_range]]
    return new.size


@compiled(_claim_rows_at_once)
def claim_rows(bins, row_of_bin, used, new_bins):  # type: ignore[no-untyped-def]
    # Replaces each bin by its row in the sparse arrays; new bins get the next rows.
    new = 0
    for n in range(bins.size):
        b = bins[n]
        if b < 0:
            continue
        r = row_of_bin[b]
        if r < 0:
            r = used + new
            row_of_bin[b] = r
            new_bins[new] = b
            new += 1
        bins[n] = r
    return new


def add_sums(
    rows: NDArray[np.int32], values: NDArray[np.floating], total: Array, square: Array, count: NDArray[np.int64]
) -> None:
    """Add values (Q, N), their squares and their number to the row (Q, rows) of each sample."""
    for_ranges(
        (len(values) + 3) // 4,
        lambda start, stop: _accumulate(rows, values, total, square, count, start, stop),
        align=1,
        smallest=1,
    )


def _accumulate_at_once(
    rows: NDArray[np.int32], values: Array, total: Array, square: Array, count: NDArray[np.int64], start: int, stop: int
) -> None:
    index = np.flatnonzero(rows >= 0)
    row = rows[index]
    for n in range(4 * start, min(4 * stop, len(values))):
        plane = values[n, index].astype(float)
        total[n] += np.bincount(row, plane, count.size)
        square[n] += np.bincount(row, plane * plane, count.size)
    if start == 0:
        count += np.bincount(row, minlength=count.size)


@compiled(_accumulate_at_once, fastmath={"contract"})
def _accumulate(rows, values, total, square, count, start, stop):  # type: ignore[no-untyped-def]
    # Four quantities a thread: no two threads write to one place, and the eight sums do not wait for each
    # other. A run of pixels in one bin, the rule in an image, stays in registers.
    quantities = values.shape[0]
    for group in range(start, stop):
        first = 4 * group
        c1, c2, c3 = min(first + 1, quantities - 1), min(first + 2, quantities - 1), min(first + 3, quantities - 1)
        v0, v1, v2, v3 = values[first], values[c1], values[c2], values[c3]
        last, k = -1, 0
        s0 = s1 = s2 = s3 = q0 = q1 = q2 = q3 = 0.0
        for n in range(rows.size + 1):
            r = rows[n] if n < rows.size else -1
            if r != last:
                if last >= 0:
                    total[first, last] += s0
                    square[first, last] += q0
                    if c1 == first + 1:
                        total[c1, last] += s1
                        square[c1, last] += q1
                    if c2 == first + 2:
                        total[c2, last] += s2
                        square[c2, last] += q2
                    if c3 == first + 3:
                        total[c3, last] += s3
                        square[c3, last] += q3
                    if group == 0:
                        count[last] += k
                last, k = r, 0
                s0 = s1 = s2 = s3 = q0 = q1 = q2 = q3 = 0.0
            if r >= 0:
                a, b, c, d = np.float64(v0[n]), np.float64(v1[n]), np.float64(v2[n]), np.float64(v3[n])
                s0, s1, s2, s3 = s0 + a, s1 + b, s2 + c, s3 + d
                q0, q1, q2, q3 = q0 + a * a, q1 + b * b, q2 + c * c, q3 + d * d
                k += 1
