"""What an import was asked for, for one measurement or for several."""

import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from processing.doors import one_line, read_text
from processing.storage.captures.schema import Detector, Sample
from processing.storage.formats.foreign_arrays import ImportFailed
from processing.storage.integrity.h5_door import read_npy

#: What stands for each of several measurements in the options of an import.
ITEM = "{item}"

#: Most bytes of a file of 16 numbers.
MOST_SAMPLE_BYTES = 1 << 16


@dataclass(frozen=True)
class ImportRequest:
    """What `process import` was asked for; see its help."""

    states: Path | None
    out: Path
    wavelength_nm: float
    stack: str | None = None
    instrument: Path | None = None
    sample: Sample = field(default_factory=Sample)
    detector: Detector = field(default_factory=Detector)
    omega_deg: float | None = None
    title: str = ""
    overwrite: bool = False
    columns: dict[str, str] = field(default_factory=dict)
    angles: Literal["degrees", "radians"] | None = None
    darks: str | None = None
    repeats: int = 1


def for_item(request: ImportRequest, item: str) -> ImportRequest:
    """The request for one of several measurements: `item` replaces `{item}`, and a stack without `{item}`."""

    def of_item(text: str) -> str:
        return text.replace(ITEM, item)

    columns = {name: of_item(column) for name, column in request.columns.items()}
    has_own_table = columns != request.columns or ITEM in str(request.states)
    stack = request.stack or ("" if has_own_table else ITEM)
    return replace(
        request,
        states=request.states and Path(of_item(str(request.states))),
        stack=(of_item(stack) if ITEM in stack else item) if stack else None,
        darks=request.darks and of_item(request.darks),
        columns=columns,
    )


def name_of_item(item: str) -> Path:
    """The usual capture of one of several measurements: NAME.h5 next to it, NAME_DATASET.h5 for `NAME.h5::/dataset`."""
    file, _, inside = item.partition("::")
    path = Path(file) if Path(file).name.strip(".") else Path(file).resolve()
    stem = path.name if path.is_dir() else path.stem
    return path.parent / ("_".join([stem, *re.findall(r"\w+", inside)]) + ".h5")


def read_sample(text: str) -> Sample:
    """Sample from `--sample`: air, mirror, unknown, or a file with 16 numbers (text or .npy)."""
    if text in ("air", "mirror", "unknown"):
        return Sample(kind=text)  # type: ignore[arg-type]
    path = Path(text)
    try:
        if path.suffix == ".npy":
            values = read_npy(path, ImportFailed, MOST_SAMPLE_BYTES).astype(float)
        else:
            values = np.array(read_text(path, ImportFailed, MOST_SAMPLE_BYTES).replace(",", " ").split(), dtype=float)
    except (ImportFailed, ValueError) as error:
        raise ImportFailed(
            f"--sample {text}: neither air, mirror, unknown nor a readable file of numbers ({one_line(error)}). "
            "Of a sample that is to be measured give --sample unknown, and its name with --title."
        ) from error
    if values.size != 16 or not np.all(np.isfinite(values)):
        raise ImportFailed(f"--sample {text}: a Mueller matrix has 16 finite numbers; found {values.size}")
    return Sample(kind="mueller", name=path.stem, mueller=tuple(float(v) for v in values.reshape(-1)))
