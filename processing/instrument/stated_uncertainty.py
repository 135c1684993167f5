"""Standard uncertainties that an instrument file states: `{value: ..., u: ...}`, and how they are correlated."""

from collections.abc import Mapping
from typing import Any, Self

import numpy as np
from pydantic import Field, model_validator

from processing.arrays import Array
from processing.section import Section

#: Where a file has elements.
TRAINS = ("generator", "analyzer", "channels", "elements")


class Correlation(Section):
    """Correlation of standard uncertainties, as `process calibrate --write` finds it.

    Attributes
    ----------
    between : "element.field" of each of K values.
    coefficients : K (K - 1) / 2, below the diagonal, row by row.
    """

    between: tuple[str, ...] = Field(description="values, element.field")
    coefficients: tuple[float, ...] = Field(description="below the diagonal of their matrix, row by row")
    wavelength_nm: float | None = Field(default=None, description="wavelength that it holds at, nm")

    @model_validator(mode="after")
    def _fits(self) -> Self:
        count = len(self.between)
        if len(self.coefficients) != count * (count - 1) // 2:
            raise ValueError(f"{count} values have {count * (count - 1) // 2} correlation coefficients between them")
        if np.linalg.eigvalsh(self.matrix)[0] < -1e-3:
            raise ValueError("these correlations contradict each other: their matrix has a negative eigenvalue")
        return self

    @property
    def matrix(self) -> Array:
        """(K, K), symmetric, 1 on the diagonal."""
        matrix = np.zeros((len(self.between),) * 2)
        matrix[np.tril_indices(len(matrix), -1)] = self.coefficients
        return np.asarray(matrix + matrix.T + np.eye(len(matrix)))


def split_uncertainties(node: Any, errors: dict[str, Any]) -> Any:
    """A train as a file has it, without standard uncertainties; those by "element.field" are put into `errors`."""
    if isinstance(node, list | tuple):
        return [split_uncertainties(part, errors) for part in node]
    if not isinstance(node, Mapping):
        return node
    plain = {}
    for field, value in node.items():
        plain[field] = split_uncertainties(value, errors) if field in TRAINS else value
        if field in TRAINS or not isinstance(value, Mapping):
            continue
        if set(value) == {"value", "u"}:
            plain[field], errors[f"{node.get('name')}.{field}"] = value["value"], value["u"]
            continue
        at = {nm: entry for nm, entry in value.items() if isinstance(entry, Mapping) and set(entry) == {"value", "u"}}
        if at:
            plain[field] = {nm: at[nm]["value"] if nm in at else entry for nm, entry in value.items()}
            errors[f"{node.get('name')}.{field}"] = {nm: entry["u"] for nm, entry in at.items()}
    return plain
