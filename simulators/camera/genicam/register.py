"""Memory of a played camera, and registers in it as GenICam describes them: bytes, byte order, bit fields."""

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

_PAGE = 4096

Number = int | float


class RegisterMemory:
    """Bytes at the addresses that were written to; zero everywhere else."""

    def __init__(self) -> None:
        self._pages: dict[int, bytearray] = {}

    def read(self, address: int, count: int) -> bytes:
        """So many bytes from an address on."""
        out = bytearray()
        while count > 0:
            page, start = divmod(address, _PAGE)
            part = min(count, _PAGE - start)
            out += self._pages[page][start : start + part] if page in self._pages else bytes(part)
            address, count = address + part, count - part
        return bytes(out)

    def write(self, address: int, data: bytes) -> None:
        """Write bytes from an address on."""
        while data:
            page, start = divmod(address, _PAGE)
            part = min(len(data), _PAGE - start)
            self._pages.setdefault(page, bytearray(_PAGE))[start : start + part] = data[:part]
            address, data = address + part, data[part:]

    def copy(self) -> "RegisterMemory":
        """The same bytes, apart from these."""
        duplicate = RegisterMemory()
        duplicate._pages = {page: bytearray(content) for page, content in self._pages.items()}
        return duplicate

    def restore(self, source: "RegisterMemory", but: Iterable[tuple[int, int]] = ()) -> None:
        """Take the bytes of another memory, except from each first address to before the last one of `but`."""
        pieces = [(first, self.read(first, last - first)) for first, last in but]
        self._pages = source.copy()._pages
        for first, data in pieces:
            self.write(first, data)


@dataclass(frozen=True, slots=True)
class Register:
    """Where a value stands, and how.

    Attributes
    ----------
    address, length : bytes.
    kind : {"whole", "real", "text"}
        Whole number, floating-point number of 4 or 8 bytes, or text that a zero byte ends.
    big_endian, signed : byte order; two's complement.
    bits : lowest and highest bit of a field, counted from the least significant bit of the number.
    """

    address: int
    length: int
    kind: Literal["whole", "real", "text"] = "whole"
    big_endian: bool = False
    signed: bool = False
    bits: tuple[int, int] | None = None

    def overlaps(self, address: int, count: int) -> bool:
        """True if any of these bytes is its own."""
        return address < self.address + self.length and self.address < address + count

    @property
    def limits(self) -> tuple[Number, Number]:
        """Smallest and largest number that fits."""
        if self.kind == "real":
            largest = 3.0e38 if self.length == 4 else 1.0e300
            return -largest, largest
        width = self._width
        return (-(1 << width - 1), (1 << width - 1) - 1) if self.signed else (0, (1 << width) - 1)

    def number(self, memory: RegisterMemory) -> Number:
        """Read the number."""
        raw = memory.read(self.address, self.length)
        if self.kind == "real":
            return float(struct.unpack(self._format, raw)[0])
        value = int.from_bytes(raw, self._order)
        if self.bits is not None:
            value = value >> self.bits[0] & ((1 << self._width) - 1)
        return value - (1 << self._width) if self.signed and value >> (self._width - 1) else value

    def set_number(self, memory: RegisterMemory, value: Number) -> None:
        """Write a number, cut to the limits; other fields of the same register stay."""
        low, high = self.limits
        value = min(max(value, low), high)
        if self.kind == "real":
            memory.write(self.address, struct.pack(self._format, value))
            return
        mask = (1 << self._width) - 1
        word = round(value) & mask
        if self.bits is not None:
            old_word = int.from_bytes(memory.read(self.address, self.length), self._order)
            word = old_word & ~(mask << self.bits[0]) | word << self.bits[0]
        memory.write(self.address, word.to_bytes(self.length, self._order))

    def set_text(self, memory: RegisterMemory, text: str) -> None:
        """Write a text, cut to the length."""
        memory.write(self.address, text.encode()[: self.length].ljust(self.length, b"\0"))

    @property
    def _order(self) -> Literal["big", "little"]:
        return "big" if self.big_endian else "little"

    @property
    def _width(self) -> int:
        return 8 * self.length if self.bits is None else self.bits[1] - self.bits[0] + 1

    @property
    def _format(self) -> str:
        return (">" if self.big_endian else "<") + ("f" if self.length == 4 else "d")
