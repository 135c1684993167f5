"""The catalogue of public measured data, and their files: from a folder of one's own, or from the network."""

import hashlib
import os
from collections.abc import Callable, Sequence
from pathlib import Path

from pydantic import RootModel

from processing.errors import ProcessError
from processing.section import Section
from processing.yaml_file import load_yaml

HERE = Path(__file__).parent
#: Environment variable: a folder with one folder for each set, used in place of the network.
VARIABLE = "UMOV_DATA"
#: Sets that the repository holds; not there outside a checkout.
SHIPPED = HERE.parents[1] / "tests" / "data"

Progress = Callable[[int, int], None]


class SetFile(Section):
    """A file of a set.

    Attributes
    ----------
    path : in the source repository.
    sha256 : of its content.
    name : on this machine; default: the last part of `path`.
    commit : if it is not that of the set.
    """

    path: str
    sha256: str
    name: str = ""
    commit: str = ""

    @property
    def local(self) -> str:
        """Path below the folder of the set."""
        return self.name or self.path.rpartition("/")[2]


class PublicSet(Section):
    """Public measured data: where they come from and what may be done with them.

    Attributes
    ----------
    title, citation, licence, doi, note : for people.
    source, commit : GitHub repository, and the commit that the files are of.
    instrument : instrument file of `configs/instruments`; empty where no capture can be made.
    in_repository : what of it `tests/data` holds, in words.
    files, registry : its files, or the name of a list of them beside the catalogue, as `sha256sum` writes it.
    reduced : files with the same numbers in a smaller form, which may be used in place of `files`.
    """

    title: str
    source: str
    commit: str
    licence: str
    citation: str
    doi: str = ""
    note: str = ""
    instrument: str = ""
    in_repository: str = ""
    files: tuple[SetFile, ...] = ()
    registry: str = ""
    reduced: tuple[SetFile, ...] = ()

    def all_files(self) -> tuple[SetFile, ...]:
        """Every file; those of a registry keep their folders."""
        if not self.registry:
            return self.files
        lines = (HERE / self.registry).read_text(encoding="utf-8").splitlines()
        return tuple(SetFile(path=path, sha256=sha, name=path) for sha, path in (line.split("  ") for line in lines))


class _Catalogue(RootModel[dict[str, PublicSet]]):
    pass


def catalogue() -> dict[str, PublicSet]:
    """Every set by its name."""
    return load_yaml(HERE / "catalogue.yaml", _Catalogue).root


def get_files(name: str, cache: Path, progress: Progress | None = None) -> dict[str, Path]:
    """The files of a set by their local names: found in a folder of one's own, or downloaded.

    Parameters
    ----------
    name : of the set.
    cache : folder for downloads; files that it holds are not downloaded again.

    Returns
    -------
    Local name to path. Every file has the SHA-256 of the catalogue.

    Raises
    ------
    ProcessError : there is no set of that name, or a file can neither be found nor downloaded.
    """
    sets = catalogue()
    if name not in sets:
        raise ProcessError(f"there is no data set {name!r}; there are: {', '.join(sets)}.")
    folder = os.environ.get(VARIABLE)
    if folder is not None and not Path(folder).is_dir():
        raise ProcessError(f"{VARIABLE}={folder}: no such folder. It should hold a folder {name}.")
    present = find_files(name, [SHIPPED] if folder is None else [Path(folder), SHIPPED])
    if present is not None:
        return present
    files = sets[name].all_files()
    downloaded = {}
    for number, file in enumerate(files, 1):
        downloaded[file.local] = _download(name, sets[name], file, cache)
        if progress:
            progress(number, len(files))
    return downloaded


def find_files(name: str, roots: Sequence[Path]) -> dict[str, Path] | None:
    """The files of a set (or its reduced form) in the folder `name` of one of `roots`; None if not all are there."""
    public_set = catalogue()[name]
    for root in roots:
        for form in filter(None, (public_set.all_files(), public_set.reduced)):
            if (files := _find_complete(root / name, form)) is not None:
                return files
    return None


def _find_complete(folder: Path, files: Sequence[SetFile]) -> dict[str, Path] | None:
    """The files where all are there with the right content."""
    paths = {}
    for file in files:
        places = (folder / file.local, folder / file.path)
        path = next((p for p in places if p.is_file() and _sha256(p) == file.sha256), None)
        if path is None:
            return None
        paths[file.local] = path
    return paths


def _sha256(path: Path) -> str:
    with path.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def _download(name: str, public_set: PublicSet, file: SetFile, cache: Path) -> Path:
    import logging

    import pooch

    # A command has a progress bar in place of its lines about every file.
    pooch.get_logger().setLevel(logging.ERROR)
    raw = public_set.source.replace("https://github.com", "https://raw.githubusercontent.com")
    url = f"{raw}/{file.commit or public_set.commit}/{file.path}"
    target = cache / file.local
    try:
        return Path(pooch.retrieve(url, f"sha256:{file.sha256}", target.name, target.parent))
    except (OSError, ValueError) as error:
        # Errors of the connection are OSErrors, other content than expected is a ValueError.
        why = " ".join(str(error).split())[:120]
        raise ProcessError(
            f"{url} cannot be downloaded ({why}). Copy the files of the set into a folder DATA/{name}, "
            f"then run: {VARIABLE}=DATA ./lab data get {name}"
        ) from error
