"""A step whose product is one file, which is found again by what it was made of, never by its name or time stamp."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from types import UnionType
from typing import NamedTuple, get_args, get_origin

from processing.computing.blas import one_blas_thread
from processing.doors import require_place
from processing.errors import ProcessError
from processing.storage.products.provenance import Step, made_of

#: Called with (parts done, parts in all).
Progress = Callable[[int, int], None]


class StepProduct(NamedTuple):
    """A product, and whether it was there already."""

    path: Path
    existed: bool


class OfFiles:
    """A frozen dataclass of input files and options; file names may come as text."""

    def __post_init__(self) -> None:
        for entry in fields(self):  # type: ignore[arg-type]  # its subclasses are dataclasses
            value = getattr(self, entry.name)
            forms = get_args(entry.type) if isinstance(entry.type, UnionType) else (entry.type,)
            if value is not None and any(get_origin(form) is tuple and Path in get_args(form) for form in forms):
                value = tuple(map(Path, [value] if isinstance(value, str | Path) else value))
            elif value is not None and Path in forms:
                value = Path(value)
            object.__setattr__(self, entry.name, value)


class FileStep(OfFiles, ABC):
    """A step as a value: subclasses are frozen dataclasses of input files and options."""

    @abstractmethod
    def record(self) -> Step:
        """What is to be made: name, options and the content of every input. Reads the inputs."""

    @property
    @abstractmethod
    def usual_path(self) -> Path:
        """Where the product goes if nothing else is said."""

    @abstractmethod
    def _write(self, out: Path, record: Step, overwrite: bool, progress: Progress | None) -> None:
        """Write the product that `record` asks for."""

    @one_blas_thread()
    def make(self, out: Path | str | None = None, overwrite: bool = False, progress: Progress | None = None) -> Path:
        """Make the product, whatever is there; `overwrite` replaces a file of that name.

        Raises ProcessError: the file exists and `overwrite` is false, its folder is not there, or its name is that of
        no HDF5 file of ours: reports, campaigns and the browser find files by it.
        """
        out = Path(out) if out else self.usual_path
        require_place(out, overwrite)
        if out.suffix != ".h5":
            raise ProcessError(f"{out}: what this makes is an HDF5 file; give a name that ends in .h5.")
        self._write(out, self.record(), overwrite, progress)
        return out

    def kept_or_made(
        self, out: Path | str | None = None, overwrite: bool = False, progress: Progress | None = None
    ) -> StepProduct:
        """The product at `out` (default: the usual path): kept if it is exactly this one, else made as by `make`.

        `overwrite` makes it in any case. Raises ProcessError as `make` does.
        """
        out = Path(out) if out else self.usual_path
        if not overwrite and out.is_file() and made_of(out) == self.record().made_of:
            return StepProduct(out, True)
        return StepProduct(self.make(out, overwrite, progress), False)

    @one_blas_thread()
    def found_or_made(self, path: Path | str | None = None, progress: Progress | None = None) -> StepProduct:
        """The product, made now unless `path` (default: the usual one) holds exactly it.

        No file is ever replaced: where the name is taken by anything else, the product gets one of its own that ends
        in the first digits of what it is made of.
        """
        path, record = Path(path) if path else self.usual_path, self.record()
        content = record.made_of
        own_path = path.with_name(f"{path.stem}-{content[:8]}{path.suffix}")
        for candidate in (path, own_path):
            if made_of(candidate) == content:
                return StepProduct(candidate, True)
        target = own_path if path.exists() else path
        require_place(target, overwrite=False)
        self._write(target, record, False, progress)
        return StepProduct(target, False)


def path_beside(source: Path, kind: str) -> Path:
    """Name of a product of this kind beside the product that it is made from: `NAME.kind.h5` for `NAME.other.h5`."""
    return source.with_name(f"{source.name.removesuffix('.h5').rsplit('.', 1)[0]}.{kind}.h5")
