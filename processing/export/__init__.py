"""Captures, products and scattering tables in the formats of other programs.

Captures and products start from the labelled arrays of `processing.labelled`: states that were not taken are left out,
and checksums are verified. Each file says what its numbers are, in which unit, and whether they are simulated.
"""

from collections.abc import Sequence
from pathlib import Path

from processing.doors import require_place
from processing.errors import ProcessError
from processing.export.figure import FIGURES, write_figure
from processing.export.numbers import FORMATS
from processing.export.scattering_table import table_to_csv
from processing.labelled import open_dataset
from processing.reflectance.tables import is_table


def export(source: Path, to: str, out: Path, planes: Sequence[str] = (), *, overwrite: bool = False) -> list[Path]:
    """Write a capture, product or table in another format; returns the files written.

    Parameters
    ----------
    to : one of `FORMATS` or `FIGURES`; csv for a table.
    out : file name, with its ending or without; TIFF adds the name of the plane.
    planes : names of planes; all by default, for a capture `counts`. In CSV a capture is its table of states.

    Raises
    ------
    ProcessError
        The format or a plane is unknown, a file exists, or the format cannot hold the data.
    """
    if to.lower() in ("nexus", "nxs", "hdf5", "h5"):
        raise ProcessError(f"{source} is a NeXus file (HDF5) already: open it as it is, or copy it to the name wanted.")
    if to not in (*FORMATS, *FIGURES):
        raise ProcessError(f"unknown format {to!r}; there are: {', '.join((*FORMATS, *FIGURES))}")
    if out.suffix.lower() in (f".{to}", ".tif" if to == "tiff" else None):
        out = out.with_suffix("")
    if is_table(source):
        if to != "csv":
            raise ProcessError(f"{source} is a scattering table: it goes into csv, and `export-pbsdf` writes a .pbsdf.")
        return table_to_csv(source, out, planes, overwrite)
    if to in FIGURES:
        path = out.with_name(f"{out.name}.{to}")
        require_place(path, overwrite)
        write_figure(source, path, planes)
        return [path]
    dataset = open_dataset(source)
    names = list(planes) or [str(name) for name in dataset.data_vars]
    unknown = [name for name in names if name not in dataset.data_vars]
    if unknown:
        raise ProcessError(f"{source} has no {unknown[0]!r}; it has: {', '.join(map(str, dataset.data_vars))}")
    return FORMATS[to](dataset, names, out, overwrite)
