"""Ways to spoil a file: bytes, text, YAML trees and HDF5 trees. Every choice comes from one random generator."""

import copy
import io
import os
import random
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from ruamel.yaml import YAML

#: What a hostile file names as a command or a place to write to: a file there says that somebody obeyed.
TRAP = Path(tempfile.gettempdir()) / f"umov-trap-{os.getpid()}"
#: Values that no measurement means.
ODD: tuple[Any, ...] = (
    float("nan"), float("inf"), float("-inf"), -1, 0, 1e308, -1e-308, 2**63, 10**40, 1e9, "", " ", "nan", "\u2028",
    "x" * 5000, None, True, [], {}, [[]], [1, 2, 3], {"a": 1}, "../../etc/passwd", "/dev/zero", "/dev/stdin", "a\nb",
    str(TRAP), f"$(touch {TRAP})", f"`touch {TRAP}`", ["/usr/bin/touch", str(TRAP)], f"| touch {TRAP}", "a\x1b[2J\x07",
    "[/A]", "[bold]", "4_5",
)  # fmt: skip
ODD_BYTES = (
    b"\0",
    b"\xff" * 4,
    b"\xff" * 8,
    b"\x7f\xff\xff\xff",
    struct.pack("<I", 0x7FFFFFFF),
    b"\0" * 8,
    b"::",
    b"]" * 9,
)
ODD_TEXT = (
    ".nan",
    ".inf",
    "1e999",
    "9" * 400,
    "-1",
    "0",
    "''",
    "[",
    "]",
    "{",
    "*a",
    "&a",
    "<<: *a",
    "!!binary x",
    "\t",
    ",,,",
    f'!!python/object/apply:os.system ["touch {TRAP}"]',
    "\x1b[2J",
)


def put_impostor(rng: random.Random, path: Path) -> None:
    """Something that is no plain file, or lies elsewhere, in the place of a file."""
    path.unlink()
    pipe = path.with_name(f"pipe_of_{path.name}")
    if not pipe.exists():
        os.mkfifo(pipe)
    places = (pipe, path.name, "/proc/kmsg", "/dev/zero", "/dev/tty", "/proc/self/mem", "..", str(TRAP), "/sys/kernel")
    if (place := rng.choice((*places, None))) is None:
        os.mkfifo(path)
    else:
        path.symlink_to(place)


def put_elsewhere(rng: random.Random, h5: h5py.File, name: str) -> None:
    """A part of an HDF5 file that lies in a pipe, a device or a file that is not there."""
    pipe = Path(h5.filename).with_name("pipe_of_parts")
    if not pipe.exists():
        os.mkfifo(pipe)
    place = rng.choice((str(pipe), "/proc/kmsg", "/dev/zero", "/etc/passwd", str(TRAP)))
    way = rng.randrange(3)
    if way == 0:
        h5[name] = h5py.ExternalLink(place, "/x")
    elif way == 1:
        h5.create_dataset(name, (4,), "u1", external=[(place, 0, 4)])
    else:
        layout = h5py.VirtualLayout((4,), "u1")
        layout[:] = h5py.VirtualSource(place, "x", shape=(4,))
        h5.create_virtual_dataset(name, layout)


def spoil_bytes(rng: random.Random, data: bytes) -> bytes:
    """One to four cuts, copies, flips or odd numbers in a file."""
    for _ in range(rng.randint(1, 4)):
        data = rng.choice(_BYTES)(rng, data)
    return data


def _flip(rng: random.Random, data: bytes) -> bytes:
    out = bytearray(data)
    for _ in range(rng.randint(1, 8)):
        # Headers stand at the beginning of most formats.
        end = min(len(out), 2048) if rng.random() < 0.7 else len(out)
        if end:
            out[rng.randrange(end)] ^= 1 << rng.randrange(8)
    return bytes(out)


def _cut(rng: random.Random, data: bytes) -> bytes:
    return data[: rng.randint(0, len(data))]


def _drop(rng: random.Random, data: bytes) -> bytes:
    at = rng.randint(0, len(data))
    return data[:at] + data[at + rng.randint(1, 64) :]


def _copy(rng: random.Random, data: bytes) -> bytes:
    at, size = rng.randint(0, len(data)), rng.randint(1, 200)
    return data[:at] + data[at : at + size] * rng.randint(2, 20) + data[at:]


def _number(rng: random.Random, data: bytes) -> bytes:
    odd = rng.choice(ODD_BYTES)
    at = rng.randint(0, min(len(data), 2048))
    return data[:at] + odd + data[at + len(odd) :]


_BYTES: tuple[Callable[[random.Random, bytes], bytes], ...] = (_flip, _flip, _cut, _drop, _copy, _number)


def spoil_text(rng: random.Random, text: str) -> str:
    """One to three words or lines replaced, doubled or dropped."""
    for _ in range(rng.randint(1, 3)):
        lines = text.splitlines() or [""]
        k = rng.randrange(len(lines))
        way = rng.randrange(5)
        if way == 0:
            words = lines[k].replace(",", " , ").split(" ")
            words[rng.randrange(len(words))] = rng.choice(ODD_TEXT)
            lines[k] = " ".join(words)
        elif way == 1:
            del lines[k]
        elif way == 2:
            lines.insert(k, lines[rng.randrange(len(lines))])
        elif way == 3:
            at = rng.randint(0, len(lines[k]))
            lines[k] = lines[k][:at] + rng.choice(ODD_TEXT) + lines[k][at:]
        else:
            lines[k] = lines[k] * rng.choice((2, 50))
        text = "\n".join(lines) + "\n"
    return text


def spoil_yaml(rng: random.Random, text: str) -> str:
    """A value of the tree replaced, renamed or dropped; the file stays YAML."""
    yaml = YAML(typ="safe", pure=True)
    tree = yaml.load(text)
    for _ in range(rng.randint(1, 3)):
        place = _place(rng, tree)
        if place is None:
            break
        node, key = place
        way = rng.randrange(4)
        if way == 0 and isinstance(node, dict):
            node[rng.choice(("amr", "x", 5, ""))] = node.pop(key)
        elif way == 1:
            del node[key]
        elif way == 2 and isinstance(node[key], list) and len(node[key]) > 1:
            node[key] = node[key][::-1]
        else:
            # A copy: a value that is put into itself has no end.
            node[key] = copy.deepcopy(rng.choice(ODD))
    out = io.StringIO()
    YAML(typ="safe", pure=True).dump(tree, out)
    return out.getvalue()


def _place(rng: random.Random, tree: Any) -> tuple[Any, Any] | None:
    places = []
    nodes = [tree]
    while nodes:
        node = nodes.pop()
        items = (
            list(node.items()) if isinstance(node, dict) else list(enumerate(node)) if isinstance(node, list) else []
        )
        places += [(node, key) for key, _ in items]
        nodes += [value for _, value in items]
    return rng.choice(places) if places else None


def spoil_h5(rng: random.Random, path: Path) -> None:
    """Datasets, groups and attributes dropped, replaced or reshaped; the file stays HDF5."""
    with h5py.File(path, "r+") as h5:
        for _ in range(rng.randint(1, 3)):
            names: list[str] = []
            h5.visit(names.append)
            name = rng.choice(names) if names else ""
            way = rng.randrange(4)
            if way == 0 and name:
                del h5[name]
            elif way == 1 and name:
                del h5[name]
                _put_odd(rng, h5, name)
            else:
                node = h5[name] if name and way == 2 else h5.get("entry", h5)
                keys = list(node.attrs)
                key = rng.choice(keys) if keys else "signal"
                _put_attribute(rng, node, key)


def _put_odd(rng: random.Random, h5: h5py.File, name: str) -> None:
    if rng.random() < 0.2:
        put_elsewhere(rng, h5, name)
        return
    shapes = ((), (0,), (3,), (44,), (2, 2), (1 << 40,), (44, 1, 1 << 20, 1 << 20), (44, 1, 4, 4))
    shape, kind = rng.choice(shapes), rng.choice(["f8", "u1", "i4", "S3", "c16", "f2", "u8"])
    if np.prod(shape, dtype=object) > 10_000:
        # A promise of terabytes that takes a few bytes.
        h5.create_dataset(name, shape, dtype="f8", chunks=tuple(min(n, 16) for n in shape))
    elif rng.random() < 0.3:
        h5[name] = rng.choice(("text", b"\xff\xfe", np.nan, -1, 10**9))
    else:
        h5[name] = np.full(shape, rng.choice((0, 1, 7)), dtype=kind)


def _put_attribute(rng: random.Random, node: Any, key: str) -> None:
    old = node.attrs.get(key)
    if isinstance(old, str) and old.startswith("{") and rng.random() < 0.7:
        node.attrs[key] = spoil_text(rng, old.replace(",", ",\n"))
    elif rng.random() < 0.2 and old is not None:
        del node.attrs[key]
    else:
        node.attrs[key] = rng.choice(("", "x", -1, 1e9, np.nan, [1, 2], b"\xff", np.zeros((2, 2)), 10**9))
