"""Content of a disc after a power cut, rebuilt from the record of all calls that changed it.

What was synced is there. Of what was not, each write may be there, or not, or some of its sectors; changes of names are
there up to some point of their order. This is stricter than most file systems: a new file's name counts as safe only
once its folder was synced.
"""

import random
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

SECTOR = 512


@dataclass(frozen=True)
class Call:
    """One recorded call: its kind, on which path, where, and the bytes of a write or the new name of a rename."""

    kind: str
    path: str
    offset: int
    data: bytes


def read_record(record: Path) -> Iterator[Call]:
    """Calls and notes in their order."""
    raw = record.read_bytes()
    position = 0
    while position < len(raw):
        end = raw.index(b"\n", position)
        kind, path, offset, size = raw[position:end].decode().split("\t")
        length = int(size) if kind in ("write", "rename") else 0
        yield Call(kind, path, int(offset), raw[end + 1 : end + 1 + length])
        position = end + 1 + length


@dataclass
class _File:
    folder: bool = False
    safe: bytearray = field(default_factory=bytearray)
    waiting: list[Call] = field(default_factory=list)


class UnreliableDisc:
    """Files and names, each as they are for programs and as they would be after a power cut now."""

    def __init__(self) -> None:
        self._names: dict[str, _File] = {}
        self._safe_names: dict[str, _File] = {}
        self._waiting: list[tuple[str, str, _File | None]] = []

    def apply(self, call: Call) -> None:
        """Carry out a call."""
        file = self._names.get(call.path)
        if call.kind in ("create", "open", "mkdir") and file is None:
            self._name(call.path, _File(folder=call.kind == "mkdir"))
        elif call.kind in ("write", "truncate", "allocate", "create") and file is not None:
            file.waiting.append(call)
        elif call.kind == "rename" and file is not None:
            self._waiting.append((call.path, call.data.decode(), file))
            self._names[call.data.decode()] = self._names.pop(call.path)
        elif call.kind == "unlink":
            self._names.pop(call.path, None)
            self._waiting.append((call.path, "", None))
        elif call.kind == "sync":
            self._sync(call.path, file)

    def _name(self, path: str, file: _File) -> None:
        self._names[path] = file
        self._waiting.append(("", path, file))

    def _sync(self, path: str, file: _File | None) -> None:
        if file is not None and not file.folder:
            for call in file.waiting:
                _carry_out(file.safe, call)
            file.waiting.clear()
            return
        # A folder: its names are safe from now on.
        renames = [change for change in self._waiting if str(Path(change[1] or change[0]).parent) == path]
        self._waiting = [change for change in self._waiting if change not in renames]
        for change in renames:
            _rename(self._safe_names, change)

    def after_power_cut(self, chance: random.Random | None) -> dict[str, bytes]:
        """Content of every file there is after a power cut; without `chance` nothing that was not synced."""
        names = dict(self._safe_names)
        count = chance.randint(0, len(self._waiting)) if chance else 0
        for change in self._waiting[:count]:
            _rename(names, change)
        lost_folders = [path for path, file in self._names.items() if file.folder and path not in names]
        return {
            path: _content(file, chance)
            for path, file in names.items()
            if not file.folder and not any(path.startswith(f"{folder}/") for folder in lost_folders)
        }


def _rename(names: dict[str, _File], change: tuple[str, str, _File | None]) -> None:
    before, after, file = change
    names.pop(before, None)
    if file is not None and after:
        names[after] = file


def _content(file: _File, chance: random.Random | None) -> bytes:
    content = bytearray(file.safe)
    for call in file.waiting if chance else ():
        assert chance is not None
        fate = chance.random()
        if fate < 0.4:
            _carry_out(content, call)
        elif fate < 0.6 and call.kind == "write":
            for start in range(0, len(call.data), SECTOR):
                if chance.random() < 0.5:
                    sector = Call("write", call.path, call.offset + start, call.data[start : start + SECTOR])
                    _carry_out(content, sector)
    return bytes(content)


def _carry_out(content: bytearray, call: Call) -> None:
    if call.kind in ("create", "truncate"):
        del content[call.offset :]
    size = call.offset + len(call.data)
    if size > len(content):
        content.extend(bytes(size - len(content)))
    if call.kind == "write":
        content[call.offset : size] = call.data
