"""Columns as comma-separated text that reads back to the same numbers."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.whole_file import whole_file


def write_csv(
    path: Path, facts: Mapping[str, Any], units: Mapping[str, str], columns: Mapping[str, NDArray[Any]]
) -> None:
    """Write columns (N,) under their names; comments at the top tell the facts and the units."""
    with whole_file(path) as new, new.open("w", encoding="utf-8") as file:
        for key, value in facts.items():
            file.write(f"# {key}: {value}\n")
        for name, unit in units.items():
            if unit:
                file.write(f"# {name} in {unit}\n")
        file.write(",".join(columns) + "\n")
        rows = np.rec.fromarrays(list(columns.values()))
        np.savetxt(file, rows, fmt=[_digits(column.dtype) for column in columns.values()], delimiter=",")


def _digits(dtype: np.dtype[Any]) -> str:
    """All digits of a value, so that reading it back gives the same number."""
    return {"f": "%.9g" if dtype.itemsize <= 4 else "%.17g", "i": "%d", "u": "%d"}.get(dtype.kind, "%s")
