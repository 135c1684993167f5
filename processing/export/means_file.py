"""Means with their uncertainties as CSV, or as JSON with the budget of each."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from processing.export.csv_file import write_csv
from processing.maps.means import MeanValue
from processing.whole_file import write_new_text

COLUMNS = ("value", "u_noise", "u_systematic", "scatter", "u", "degrees_of_freedom", "k", "low", "high")


def write_means(path: Path, values: Sequence[MeanValue], facts: dict[str, Any]) -> None:
    """Write means as CSV, or as JSON with the budget of each; what is infinite or not known is null there."""
    if path.suffix == ".json":
        means = [asdict(v) | {name: getattr(v, name) for name in ("u", "degrees_of_freedom", "k")} for v in values]
        write_new_text(path, json.dumps(_finite({**facts, "means": means}), indent=1) + "\n")
        return
    columns = {name: np.array([getattr(v, name) for v in values]) for name in ("name", "unit")}
    columns |= {name: np.array([getattr(v, name) for v in values], dtype=float) for name in COLUMNS}
    write_csv(path, facts, {}, columns)


def _finite(node: Any) -> Any:
    if isinstance(node, dict):
        return {key: _finite(part) for key, part in node.items()}
    if isinstance(node, list | tuple):
        return [_finite(part) for part in node]
    return None if isinstance(node, float) and not np.isfinite(node) else node
