"""Files of the folder: captures, products, tables and campaigns, with their inputs and products."""

import json
import os
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields
from functools import lru_cache
from pathlib import Path
from typing import Any

from acquisition.campaign.identity import IDENTITY
from acquisition.capture.partial_file import PARTIAL
from processing.errors import ProcessError
from processing.reflectance.tables import ScatteringTable, is_table, table_steps
from processing.storage.captures.capture import Capture
from processing.storage.captures.schema import CaptureHeader
from processing.storage.products.product import Product, is_product
from processing.storage.products.provenance import MADE_OF, Step, content_of, file_identity, made_of, program
from processing.whole_file import write_whole_text

#: Part of the pixels of a state beyond which its saturation is pointed out.
SATURATED = 0.001
#: Where the application keeps its own files; a hidden folder is never looked into.
OWN = ".umov-view"
#: Index of every file, in the folder above; written after so many files were read anew.
INDEX, READ_ANEW = "index.json", 50
#: Parts of a header that no list shows.
LONG = {"instrument_yaml", "plan_yaml", "rig_yaml", "camera_settings_json", "devices_json", "versions"}


class NotHere(ProcessError):
    """A name that leads to nothing in the folder."""


@dataclass(frozen=True)
class Entry:
    """One file, as far as a list tells.

    Attributes
    ----------
    name : path from the folder on, with forward slashes.
    kind : "capture", "table", the kind of a product, or "unreadable".
    status : of a capture; "complete" for what has none.
    flags : problems to look at, in words.
    inputs : identities of the files that it was made from, as the provenance keeps them.
    content : identifies the file in the provenance of other files: `made_of` of a product.
    """

    name: str
    kind: str
    changed_s: float
    size: int
    header: CaptureHeader | None = None
    simulated: bool = False
    status: str = "complete"
    states: tuple[int, int] | None = None
    begun: str = ""
    flags: tuple[str, ...] = ()
    inputs: tuple[dict[str, Any], ...] = ()
    content: str | None = None
    step: str = ""

    @property
    def title(self) -> str:
        """The title in the header, or the file's name."""
        return self.header.title if self.header is not None else Path(self.name).name

    @property
    def sample(self) -> str:
        """Name of the sample, or its kind; empty where the file has no header."""
        return "" if self.header is None else self.header.sample.name or self.header.sample.kind

    @property
    def words(self) -> str:
        """The text that a search looks through, in small letters."""
        parts = [self.name, self.kind, self.status, self.step, *self.flags]
        if self.header is not None:
            header = self.header
            omega = "" if header.omega_deg is None else f"omega {header.omega_deg:g}"
            parts += [header.title, header.mode, header.sample.name, f"{header.wavelength_nm:g} nm", omega]
        return " ".join(parts).lower()


@dataclass
class Library:
    """A folder; every file is opened once and again when it has changed, or while it is written."""

    root: Path
    _cache: dict[Path, tuple[tuple[int, int], Entry]] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _read_anew: int = 0

    def __post_init__(self) -> None:
        self.root = self.root.resolve()
        self._load_index()

    def path(self, name: str) -> Path:
        """The file or folder of that name. Raises NotHere if there is none, or it is outside the folder."""
        try:
            path = (self.root / name).resolve()
            if path.is_relative_to(self.root) and path.exists():
                return path
        except (OSError, RuntimeError, ValueError):
            # Too long, a link to itself, a zero byte.
            pass
        raise NotHere(f"{name}: there is no such file in {self.root}")

    def name(self, path: Path) -> str:
        """Name of a file inside the folder."""
        return path.resolve().relative_to(self.root).as_posix()

    def holds(self, path: Path) -> bool:
        """Whether there is a file of that path and it lies in the folder; links are followed."""
        return path.is_file() and path.resolve().is_relative_to(self.root)

    def entries(self, say: Callable[[str], None] | None = None) -> list[Entry]:
        """Every HDF5 file, newest first; `say` is called with the name of each before it is read."""
        candidates: list[Entry | None] = []
        with self._lock:
            for path in self._files(".h5", f".h5{PARTIAL}"):
                if say is not None:
                    say(f"{len(candidates) + 1}: {path.name}")
                candidates.append(self._entry(path))
            if self._read_anew >= READ_ANEW:
                self._save_index()
        # A link has the name of the file that it leads to, which is listed once.
        by_name = {e.name: e for e in candidates if e is not None}
        return sorted(by_name.values(), key=lambda e: (-e.changed_s, e.name))

    def entry(self, name: str) -> Entry:
        """One file. Raises NotHere."""
        with self._lock:
            result = self._entry(self.path(name))
        if result is None:
            raise NotHere(f"{name}: there is no such file in {self.root}")
        return result

    def campaigns(self) -> list[Path]:
        """Folders that campaigns were taken into, the one last written to first."""
        folders = [Path(folder) for folder, _, files in self._walk() if IDENTITY in files]
        return sorted(folders, key=lambda folder: -_changed_s(folder))

    def yaml_files(self, mark: str) -> list[Path]:
        """Configuration files that have a line which begins so, as `kind: instrument`."""
        paths = []
        for path in self._files(".yaml"):
            if path.stat().st_size < 1 << 20 and any(f"{line} ".startswith(f"{mark} ") for line in _lines(path)):
                paths.append(path)
        return paths

    def _load_index(self) -> None:
        """Load the index of an earlier run; none if it is damaged, or from another version of this program."""
        try:
            index = json.loads((self.root / OWN / INDEX).read_text(encoding="utf-8"))
            for name, (stamp, facts) in index["files"].items() if index["program"] == program() else ():
                header = facts["header"] and CaptureHeader.model_validate(facts["header"])
                lists = {key: tuple(facts[key]) for key in ("flags", "inputs")}
                lists["states"] = facts["states"] and tuple(facts["states"])
                self._cache[self.root / name] = (tuple(stamp), Entry(**(facts | lists | {"header": header})))
        except (OSError, ValueError, KeyError, TypeError):
            self._cache.clear()

    def _save_index(self) -> None:
        files = {}
        for stamp, entry in self._cache.values():
            header = entry.header and entry.header.model_dump(mode="json", exclude=LONG)
            facts = {f.name: getattr(entry, f.name) for f in fields(entry)} | {"header": header}
            files[entry.name] = (stamp, facts)
        try:
            (self.root / OWN).mkdir(exist_ok=True)
            write_whole_text(self.root / OWN / INDEX, json.dumps({"program": program(), "files": files}))
        except (OSError, ValueError):
            # A read-only folder, or a name that is not UTF-8: the files are read again next time.
            pass
        self._read_anew = 0

    def _walk(self) -> Iterator[tuple[str, list[str], list[str]]]:
        for folder, folders, files in os.walk(self.root):
            folders[:] = sorted(f for f in folders if not f.startswith("."))
            yield folder, folders, files

    def _files(self, *endings: str) -> Iterator[Path]:
        for folder, _, files in self._walk():
            for name in sorted(files):
                if name.endswith(endings) and self.holds(path := Path(folder) / name):
                    yield path

    def _entry(self, path: Path) -> Entry | None:
        try:
            stat = path.stat()
        except OSError:
            return None
        stamp = (stat.st_mtime_ns, stat.st_size)
        if path in self._cache and self._cache[path][0] == stamp:
            return self._cache[path][1]
        self._read_anew += 1
        common: dict[str, Any] = {"name": self.name(path), "changed_s": stat.st_mtime, "size": stat.st_size}
        try:
            if not _is_utf8(common["name"]):
                raise ProcessError("its name is not UTF-8, so no page can ask for it; give it another")
            entry = read_entry(path, common)
        except ProcessError as error:
            entry = Entry(**common, kind="unreadable", status="failed", flags=(str(error),))
        # HDF5 answers for a file that another page has open with what it was then; its end changes neither size nor,
        # within one tick of the clock, the time.
        if entry.status == "running":
            self._cache.pop(path, None)
        else:
            self._cache[path] = (stamp, entry)
        return entry


def read_entry(path: Path, common: dict[str, Any]) -> Entry:
    """The entry of a file, whatever it is, with the fields that all have in `common`."""
    if is_product(path):
        return _product(path, common)
    if is_table(path):
        table = ScatteringTable.load(path)
        inputs, step = _origin(tuple(table_steps(path)))
        return Entry(**common, kind="table", simulated=table.simulated, inputs=inputs, step=step, content=made_of(path))
    with Capture(path) as capture:
        flags = [str(message) for message in capture.closing.get("messages", [])]
        saturated = capture.column("saturated_fraction")
        if (worst := max(saturated, default=0.0)) > SATURATED:
            flags.append(f"up to {100 * worst:.2f} % of the pixels of a state are saturated")
        return Entry(
            **common,
            kind="capture",
            header=capture.header,
            simulated=capture.simulated,
            status=capture.status,
            states=(len(capture.done), capture.planned_states),
            begun=capture.start_time,
            flags=tuple(flags),
        )


def _product(path: Path, common: dict[str, Any]) -> Entry:
    with Product(path) as product:
        inputs, step = _origin(product.steps)
        return Entry(
            **common,
            kind=product.kind,
            header=product.header,
            simulated=product.simulated,
            begun=product.steps[-1].date if product.steps else "",
            flags=tuple(str(warning) for warning in product.facts.get("warnings", [])),
            inputs=inputs,
            step=step,
            content=made_of(path),
        )


def _origin(steps: tuple[Step, ...]) -> tuple[tuple[dict[str, Any], ...], str]:
    return (steps[-1].inputs, steps[-1].name) if steps else ((), "")


def inputs_of(entry: Entry, entries: list[Entry], root: Path) -> list[tuple[str, str, Entry | None]]:
    """Inputs of a file: role, path, and the file in the folder that it is."""
    return [
        (str(identity.get("role", "")), str(identity.get("path", "")), input_of(identity, entries, root))
        for identity in entry.inputs
    ]


def input_of(identity: dict[str, Any], entries: list[Entry], root: Path) -> Entry | None:
    """The file in the folder that an input was: by its content, by its path, or moved with its folder."""
    path, content = str(identity.get("path", "")), identity.get(MADE_OF)
    if content is not None and (match := next((e for e in entries if e.content == content), None)):
        return match
    if match := next((e for e in entries if f"{root}/{e.name}" == path), None):
        return match
    # A capture elsewhere: its content is read only where name and size are right.
    name, size = path.rpartition("/")[2], identity.get("bytes")
    candidates = (e for e in entries if e.kind == "capture" and e.size == size and e.name.rpartition("/")[2] == name)
    return next((e for e in candidates if _content(root / e.name, e.changed_s) == content_of(identity)), None)


@lru_cache(maxsize=4096)
def _content(path: Path, changed_s: float) -> str | None:
    try:
        return content_of(file_identity(path))
    except OSError:
        return None


def outputs_of(entry: Entry, entries: list[Entry], root: Path) -> list[Entry]:
    """Files of the folder that were made from this one."""
    return [e for e in entries if any(source is entry for _, _, source in inputs_of(e, entries, root))]


def _changed_s(folder: Path) -> float:
    return max((path.stat().st_mtime for path in folder.iterdir() if path.is_file()), default=0.0)


def _is_utf8(name: str) -> bool:
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return []
