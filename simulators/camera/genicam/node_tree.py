"""Nodes of a GenICam description over the memory of a played camera: values by the name of a feature, both ways.

Node types and their children are those of the GenApi module of the GenICam standard (EMVA), as far as values need
them: Integer, Float, Enumeration, Boolean, Command, the registers with computed addresses, SwissKnife and Converter.
"""

import copy
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal
from xml.etree.ElementTree import Element

from processing.doors import one_line
from processing.yaml_file import ConfigError
from simulators.camera.genicam.formula import Formula, FormulaError, Number
from simulators.camera.genicam.register import Register, RegisterMemory

REGISTERS = ("IntReg", "MaskedIntReg", "StructEntry", "FloatReg", "StringReg", "Register")
_MOVES = ("pAddress", "pLength", "pIndex", "IntSwissKnife")
_FORMULAS = ("IntSwissKnife", "SwissKnife")
_CONVERTERS = ("IntConverter", "Converter")
_VARIABLES = ("Integer", "Float", "Enumeration", "Boolean", "Command", "String")
_NODES = (*REGISTERS, *_FORMULAS, *_CONVERTERS, *_VARIABLES, "Category", "Port")
# A value that goes through more nodes than this goes round in a circle.
_LONGEST_WAY = 40
# A hostile file could ask for a register of the whole memory.
_LONGEST_REGISTER = 1 << 16
# In place of infinity, which is a limit in some descriptions.
_LARGEST = 1e300

Limit = Literal["Min", "Max", "Inc"]


class NodeError(ConfigError):
    """A feature that cannot be played; the message names file and feature."""


class NodeTree:
    """Features of a description.

    Parameters
    ----------
    root : the `RegisterDescription`.
    memory : where its registers stand.
    source : file it came from, for messages.
    """

    def __init__(self, root: Element, memory: RegisterMemory, source: Path) -> None:
        self._memory = memory
        self._source = source
        self._nodes: dict[str, Element] = {}
        #: The StructReg around an entry of it: address, length and port are there.
        self._around: dict[str, Element] = {}
        self._collect(root)
        # Values of nodes that stand in no register: each program that opens the camera has its own of these.
        self._values: dict[str, Number] = {}
        self._assumed: dict[str, Number] = {}
        self._formulas: dict[tuple[str, str], Formula] = {}
        # Registers whose address and length follow from no other node.
        self._fixed: dict[str, Register] = {}
        self._way: list[str] = []

    def copy(self, memory: RegisterMemory) -> "NodeTree":
        """The same features with the same values of their own, whose registers stand in another memory."""
        duplicate = copy.copy(self)
        duplicate._memory = memory
        duplicate._values, duplicate._assumed, duplicate._way = dict(self._values), {}, []
        return duplicate

    def _collect(self, parent: Element) -> None:
        for node in parent:
            if node.tag == "Group":
                self._collect(node)
            elif node.tag == "StructReg":
                for entry in node.iter("StructEntry"):
                    self._nodes[entry.get("Name", "")] = entry
                    self._around[entry.get("Name", "")] = node
            elif node.tag in _NODES:
                self._nodes[node.get("Name", "")] = node

    def __contains__(self, name: str) -> bool:
        return name in self._nodes

    def __iter__(self) -> Iterator[str]:
        return iter(self._nodes)

    def node(self, name: str) -> Element:
        """The node of a name. Raises NodeError."""
        if name not in self._nodes:
            raise self.error(name, "is named in the file and not described there")
        return self._nodes[name]

    def error(self, name: str, why: str) -> NodeError:
        """The error of a feature that cannot be played."""
        return NodeError(f"{self._source}: feature {one_line(name, 80)} {why}")

    # --- values ------------------------------------------------------------------------------------------

    def value(self, name: str) -> Number:
        """Number of a node; the entry's value of an Enumeration. Raises NodeError."""
        with self._passing(name):
            if name in self._assumed:
                return self._assumed[name]
            node = self.node(name)
            if node.tag in REGISTERS:
                return self.register(name).number(self._memory)
            if node.tag in _FORMULAS:
                return self._calculated(name, "Formula", {})
            if node.tag in _CONVERTERS:
                return self._calculated(name, "FormulaFrom", {"TO": self.value(self._target(name) or "")})
            target = self._target(name)
            return self._own_value(name) if target is None else self.value(target)

    def set_value(self, name: str, value: Number) -> None:
        """Set a node through the nodes behind it, also a read-only one. Raises NodeError."""
        with self._passing(name):
            node = self.node(name)
            if node.tag in REGISTERS:
                self.register(name).set_number(self._memory, value)
                return
            if node.tag in _FORMULAS:
                raise self.error(name, "is calculated and cannot be set")
            if node.tag in _CONVERTERS:
                value = self._calculated(name, "FormulaTo", {"FROM": value})
            target = self._target(name)
            if target is None:
                self._values[name] = value
            else:
                self.set_value(target, value)

    def set_text(self, name: str, text: str) -> None:
        """Set a text that stands in a register; another is left as it is."""
        end = self.end(name)
        if self.node(end).tag == "StringReg":
            self.register(end).set_text(self._memory, text)

    def end(self, name: str) -> str:
        """The node that holds the value of a node: behind Integers, Enumerations, Converters and the like."""
        return list(self._way_down(name))[-1]

    def limit(self, name: str, tag: Limit) -> Number | None:
        """Smallest or largest value, or step, as a program sees it; None where no node says."""
        for source in self._way_down(name):
            node = self.node(source)
            reference = node.findtext(f"p{tag}")
            if reference is not None:
                return self.value(reference)
            if node.find(tag) is not None:
                return self._number(source, node.findtext(tag))
            if node.tag in _CONVERTERS:
                return None
        if node.tag in REGISTERS and tag != "Inc":
            return self.register(source).limits[tag == "Max"]
        return None

    def limit_node(self, name: str, tag: Limit) -> str | None:
        """The node that gives a limit of a feature; None where it is written down or not said."""
        references = (self.node(source).findtext(f"p{tag}") for source in self._way_down(name))
        return next((reference for reference in references if reference is not None), None)

    def _way_down(self, name: str) -> Iterator[str]:
        """A node, and the nodes that its value comes from, in order."""
        current: str | None = name
        for _ in range(_LONGEST_WAY):
            if current is None:
                return
            yield current
            current = self._target(current)
        raise self.error(name, "refers to itself")

    def command_value(self, name: str) -> Number:
        """The value that a program writes to give a command."""
        node = self.node(name)
        reference = node.findtext("pCommandValue")
        return self.value(reference) if reference is not None else self._number(name, node.findtext("CommandValue"))

    # --- enumerations ------------------------------------------------------------------------------------

    def entries(self, name: str) -> dict[str, int]:
        """Entries of an Enumeration that are implemented, with their values."""
        return {
            entry.get("Name", ""): int(self._number(name, entry.findtext("Value")))
            for entry in self.node(name).iter("EnumEntry")
            if self.is_true(entry, "pIsImplemented")
        }

    def is_true(self, node: Element, condition: str) -> bool:
        """Value of a condition of a node such as pIsImplemented; true where it has none."""
        reference = node.findtext(condition)
        return reference is None or bool(self.value(reference))

    def chosen(self, name: str) -> str:
        """Name of the entry that an Enumeration has now. Raises NodeError if its value is none of them."""
        value = self.value(name)
        for entry, code in self.entries(name).items():
            if code == value:
                return entry
        raise self.error(name, f"has the value {value}, which is none of its entries")

    def choose(self, name: str, entry: str) -> None:
        """Set an Enumeration to one of its entries."""
        self.set_value(name, self.entries(name)[entry])

    @contextmanager
    def assuming(self, name: str, entry: str) -> Iterator[None]:
        """Within the block a selector stands at an entry, wherever its value is kept; without it nothing changes.

        A selector that stands in no register is each program's own, and the camera cannot ask for it.
        """
        value = self.entries(name).get(entry) if name in self else None
        if value is None:
            yield
            return
        end = self.end(name)
        before = self._assumed.get(end)
        self._assumed[end] = value
        try:
            yield
        finally:
            if before is None:
                del self._assumed[end]
            else:
                self._assumed[end] = before

    # --- what stands behind a node -----------------------------------------------------------------------

    def register(self, name: str) -> Register:
        """Where the value of a register node stands now. Raises NodeError."""
        if name in self._fixed:
            return self._fixed[name]
        node = self.node(name)
        place = self._around.get(name, node)
        register = self._register(name, node, place)
        if not any(child.tag in _MOVES for child in place):
            self._fixed[name] = register
        return register

    def _register(self, name: str, node: Element, place: Element) -> Register:
        length = self._sum(name, place, "Length", "pLength")
        if not 0 < length <= _LONGEST_REGISTER:
            raise self.error(name, f"has {length} bytes")
        order = node.findtext("Endianess") or place.findtext("Endianess") or "LittleEndian"
        kind: Literal["whole", "real", "text"] = "whole"
        if node.tag == "FloatReg":
            kind = "real"
        elif node.tag in ("StringReg", "Register"):
            kind = "text"
        if (kind == "real" and length not in (4, 8)) or (kind == "whole" and length > 8):
            raise self.error(name, f"is a number of {length} bytes")
        big = order.strip() == "BigEndian"
        return Register(
            address=self._address(name, place, length),
            length=length,
            kind=kind,
            big_endian=big,
            signed=(node.findtext("Sign") or place.findtext("Sign") or "").strip() == "Signed",
            bits=self._bits(name, node, length, big),
        )

    def inputs(self, name: str) -> set[str]:
        """All register nodes that a value depends on."""
        registers: set[str] = set()
        waiting = [name]
        visited: set[str] = set()
        while waiting:
            current = waiting.pop()
            if current in visited or current not in self._nodes:
                continue
            visited.add(current)
            node = self._nodes[current]
            if node.tag in REGISTERS:
                registers.add(current)
            waiting += [
                child.text or ""
                for child in node
                if child.tag in ("pVariable", "pIndex") or child.tag.startswith("pValue")
            ]
        return registers

    def is_the_cameras_own(self, name: str) -> bool:
        """True for a register that programs can only read."""
        place = self._around.get(name, self.node(name))
        return (self.node(name).findtext("AccessMode") or place.findtext("AccessMode") or "RW").strip() == "RO"

    def _address(self, name: str, place: Element, length: int) -> int:
        address = self._sum(name, place, "Address", "pAddress")
        for child in place.findall("pIndex"):
            step = self._number(name, child.get("Offset")) if child.get("Offset") else length
            if child.get("pOffset"):
                step = self.value(child.get("pOffset", ""))
            address += int(step * self.value(child.text or ""))
        for child in place.findall("IntSwissKnife"):
            # Older descriptions have the formula of an address in the register itself.
            self._nodes.setdefault(child.get("Name", ""), child)
            address += int(self.value(child.get("Name", "")))
        if not 0 <= address < 1 << 32:
            raise self.error(name, f"stands at {address:#x}, outside what GigE Vision can address")
        return address

    def _sum(self, name: str, place: Element, plain: str, indirect: str) -> int:
        total = sum(int(self._number(name, child.text)) for child in place.findall(plain))
        return total + sum(int(self.value(child.text or "")) for child in place.findall(indirect))

    def _bits(self, name: str, node: Element, length: int, big: bool) -> tuple[int, int] | None:
        if node.tag not in ("MaskedIntReg", "StructEntry"):
            return None
        bit = node.findtext("Bit")
        ends = [self._number(name, bit or node.findtext(end)) for end in ("LSB", "MSB")]
        # Big-endian registers count their bits from the most significant one.
        low, high = sorted(8 * length - 1 - int(end) if big else int(end) for end in ends)
        if low < 0 or high >= 8 * length:
            raise self.error(name, f"has bits {low} to {high} of {8 * length}")
        return low, high

    def _target(self, name: str) -> str | None:
        """The node that a node takes its value from; None for one that has it itself."""
        node = self.node(name)
        if node.tag not in _VARIABLES and node.tag not in _CONVERTERS:
            return None
        index = node.findtext("pIndex")
        if index is not None:
            now = self.value(index)
            for child in node.findall("pValueIndexed"):
                if self._number(name, child.get("Index")) == now:
                    return child.text or ""
            return node.findtext("pValueDefault")
        return node.findtext("pValue")

    def _own_value(self, name: str) -> Number:
        if name in self._values:
            return self._values[name]
        node = self.node(name)
        index = node.findtext("pIndex")
        if index is not None:
            now = self.value(index)
            for child in node.findall("ValueIndexed"):
                if self._number(name, child.get("Index")) == now:
                    return self._number(name, child.text)
            return self._number(name, node.findtext("ValueDefault"))
        return self._number(name, node.findtext("Value"))

    def _calculated(self, name: str, tag: str, variables: dict[str, Number]) -> Number:
        node = self.node(name)
        try:
            formula = self._formula(name, node, tag)
            return formula.value(lambda variable: self._variable(name, node, variables, variable))
        except FormulaError as why:
            raise self.error(name, f"has a formula that cannot be played: {why}") from why

    def _formula(self, name: str, node: Element, tag: str) -> Formula:
        key = (name, tag)
        if key not in self._formulas:
            self._formulas[key] = Formula(node.findtext(tag) or "", integer=node.tag.startswith("Int"))
        return self._formulas[key]

    def _variable(self, name: str, node: Element, variables: dict[str, Number], variable: str) -> Number:
        if variable in variables:
            return variables[variable]
        for child in node:
            if child.get("Name") != variable:
                continue
            if child.tag == "pVariable":
                return self._with_suffix(child.text or "", variable)
            if child.tag == "Constant":
                return self._number(name, child.text)
            if child.tag == "Expression":
                inner = Formula(child.text or "", integer=node.tag.startswith("Int"))
                with self._passing(f"{name}.{variable}"):
                    return inner.value(lambda operand: self._variable(name, node, variables, operand))
        raise KeyError(variable)

    def _with_suffix(self, reference: str, variable: str) -> Number:
        suffix = variable.rpartition(".")[2] if "." in variable else "Value"
        if suffix in ("Min", "Max", "Inc"):
            limit = self.limit(reference, suffix)  # type: ignore[arg-type]
            if limit is None:
                raise self.error(reference, f"has no {suffix}, and a formula asks for it")
            return limit
        return self.value(reference)

    def _number(self, name: str, text: str | None) -> Number:
        text = (text or "").strip()
        if text in ("true", "false"):
            return int(text == "true")
        try:
            if text[:2].lower() == "0x":
                return int(text, 16)
            if text.lstrip("+-").isdecimal():
                return int(text)
            number = float(text)
        except ValueError:
            number = math.nan
        if math.isnan(number):
            raise self.error(name, f"has {one_line(text, 40)!r} where a number belongs")
        return min(max(number, -_LARGEST), _LARGEST)

    @contextmanager
    def _passing(self, name: str) -> Iterator[None]:
        if len(self._way) > _LONGEST_WAY:
            raise self.error(self._way[0], "refers to itself")
        self._way.append(name)
        try:
            yield
        finally:
            self._way.pop()
