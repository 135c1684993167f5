"""The door of GenICam descriptions: XML, or the zip archive with one XML file that most cameras serve."""

import io
import lzma
import zipfile
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from processing.doors import MOST_DEPTH, MOST_TEXT_BYTES, one_line, require_file
from processing.yaml_file import ConfigError
from simulators.camera.genicam.formula import Number

# Errors of a damaged archive: of the format, of its compressions, and of those that this Python lacks.
_DAMAGED = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, NotImplementedError, RuntimeError)


@dataclass(frozen=True, slots=True)
class Description:
    """A description of a camera.

    Attributes
    ----------
    served : the file as the camera serves it.
    name : name under which it does.
    root : tree of its XML.
    source : where it comes from, for messages.
    arming_s : time after an exposure in which the camera ignores a trigger.
    at_power_up : features that are not at their lowest value when the camera is switched on: entry or number by name.
    """

    served: bytes
    name: str
    root: Element
    source: Path
    arming_s: float = 0.0
    at_power_up: dict[str, str | Number] = field(default_factory=dict)


def is_description(name: str) -> bool:
    """True for the name of such a file."""
    return name.lower().endswith((".xml", ".zip"))


def read_description(path: Path) -> Description:
    """Read a GenICam description of at most 16 MiB, unpacked.

    Raises ConfigError: not there, too large, nested too deep, with a document type (which could define entities), or no
    GenICam.
    """
    require_file(path, ConfigError, MOST_TEXT_BYTES)
    try:
        served = path.read_bytes()
    except OSError as why:
        raise ConfigError(f"{path}: cannot be read ({why.strerror})") from why
    text = _unpacked(path, served) if path.suffix.lower() == ".zip" else served
    root = read_tree(path, text)
    if root.tag != "RegisterDescription":
        raise ConfigError(f"{path}: is <{one_line(root.tag, 60)}>, not the <RegisterDescription> of GenICam")
    return Description(served, "camera" + path.suffix.lower(), root, path)


def _unpacked(path: Path, served: bytes) -> bytes:
    try:
        with zipfile.ZipFile(io.BytesIO(served)) as archive:
            files = [entry for entry in archive.infolist() if entry.filename.lower().endswith(".xml")]
            if len(files) != 1:
                raise ConfigError(f"{path}: has {len(files)} XML files, and a camera's archive has one")
            with archive.open(files[0]) as file:
                # The stated size need not be true.
                text = file.read(MOST_TEXT_BYTES + 1)
    except (*_DAMAGED, OSError, ValueError) as why:
        raise ConfigError(f"{path}: is no zip archive that can be read ({one_line(why)})") from why
    if len(text) > MOST_TEXT_BYTES:
        raise ConfigError(f"{path}: unpacks to more than {MOST_TEXT_BYTES:,} bytes. Is it the right one?")
    return text


def read_tree(path: Path, text: bytes) -> Element:
    """Tree of the XML of a description. Raises ConfigError."""
    builder, depth = TreeBuilder(), 0
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > MOST_DEPTH:
            raise ConfigError(f"{path}: nested deeper than {MOST_DEPTH} levels")
        builder.start(_local(tag), attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(_local(tag))

    def refuse(*_: object) -> NoReturn:
        raise ConfigError(f"{path}: has a document type, and no camera's description needs one")

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.CharacterDataHandler = builder.data
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(text, True)
        return builder.close()
    except (expat.ExpatError, ValueError, LookupError) as why:
        raise ConfigError(f"{path}: is not the XML that it should be ({one_line(why)})") from why


def _local(tag: str) -> str:
    return tag.rpartition(":")[2]
