"""Pixel formats: what a camera's format code means in memory, and how to get right-aligned counts out of it.

Codes are those of the GenICam Pixel Format Naming Convention (PFNC) and, for the polarization cameras whose
makers have their own, of public code that uses them. In every code bits 16 to 23 hold the bits that a pixel
occupies. A format that is not listed here is refused: the layout would be a guess.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from drivers.errors import UnknownPixelFormat

# "plain": one or two bytes a pixel, little-endian. "p": bits packed end to end, lowest bit first (PFNC).
# "packed": two pixels in three bytes, high bits outside, low nibbles in the middle byte (GigE Vision).
Layout = Literal["plain", "p", "packed"]


@dataclass(frozen=True, slots=True)
class PixelFormat:
    """One way to lay out a monochrome image in memory.

    Attributes
    ----------
    name : the camera's name for it (SFNC `PixelFormat` entry).
    code : 32-bit PFNC code; None where it is not published: the camera's own node map then tells it.
    bits : bits that carry the value: 8, 10, 12, 14 or 16.
    layout : {"plain", "p", "packed"}
        How pixels share bytes.
    polarized : True where the maker marks the format as that of a polarization sensor.
    colours : filters over the first two pixels of the first row, such as "GR"; the other two lie below them. Empty
        without a colour filter. On a polarization sensor each colour covers a whole super-pixel.
    angles : True where each pixel is sent as four counts, those behind 0, 45, 90 and 135 degrees. `decode` lays them
        out as the super-pixel of the raw mosaic, so a frame has twice as many rows and columns.
    """

    name: str
    code: int | None
    bits: int
    layout: Layout = "plain"
    polarized: bool = False
    colours: Literal["", "RG", "GR", "GB", "BG"] = ""
    angles: bool = False

    @property
    def bits_in_memory(self) -> int:
        """Bits that one pixel occupies, which are bits 16 to 23 of the code."""
        count = {"plain": 8 if self.bits == 8 else 16, "p": self.bits, "packed": 12}[self.layout]
        return count * self.counts_per_pixel

    @property
    def counts_per_pixel(self) -> int:
        """Counts that the camera sends for each of its pixels."""
        return 4 if self.angles else 1

    @property
    def scale(self) -> int:
        """Rows and columns of a decoded frame for each row and column that the camera announces."""
        return 2 if self.angles else 1

    def payload_bytes(self, width: int, height: int) -> int:
        """Bytes of an image without padding."""
        return (width * height * self.bits_in_memory + 7) // 8

    def decode(self, memory: NDArray[np.uint8], width: int, height: int, shift: int = 0) -> NDArray[np.uint16]:
        """Copy an image out of a transfer buffer as right-aligned counts.

        Parameters
        ----------
        memory : ndarray of uint8
            At least `payload_bytes(width, height)` bytes; not kept.
        width, height : image size in pixels.
        shift : empty bits below the value, where a camera left-aligns its data in a wider word (Mono16).

        Returns
        -------
        ndarray of uint16, shape (scale * height, scale * width)
            New memory that shares nothing with the buffer.

        Raises
        ------
        ValueError
            The buffer is too short.
        """
        size = self.payload_bytes(width, height)
        if memory.size < size:
            raise ValueError(f"{self.name}, {width} x {height}: needs {size} bytes, the buffer has {memory.size}")
        pixels = _decode(self, memory[:size], width * height * self.counts_per_pixel)
        if shift:
            pixels >>= np.uint16(shift)
        if self.angles:
            return _super_pixels(pixels.reshape(height, width, 4))
        return pixels.reshape(height, width)

    def misalignment(self, memory: NDArray[np.uint8], pixels: NDArray[np.uint16], bits: int, shift: int) -> str:
        """Say how an image contradicts `bits` real bits above `shift` empty ones; empty text if it does not.

        `memory` is the whole image as it came, `pixels` what `decode` made of it.
        """
        room = 16 if self.layout == "plain" and self.bits > 8 else self.bits
        if bits < room - shift and int(pixels.max()) >> bits:
            return f"a count of {int(pixels.max())} needs more than {bits} bits"
        if shift and self.layout == "plain" and self.bits_in_memory == 16:
            size = 2 * pixels.size
            if int(np.bitwise_or.reduce(memory[:size].view("<u2"))) & ((1 << shift) - 1):
                return f"the {shift} low bits are not empty"
        return ""

    def encode(self, pixels: NDArray[np.uint16]) -> NDArray[np.uint8]:
        """Lay out an image as a camera would send it: the inverse of `decode` with no shift.

        Raises ValueError: a value needs more than `bits` bits.
        """
        if self.angles:
            pixels = np.stack([pixels[r::2, c::2] for r, c in _SUPER_PIXEL], axis=-1)
        flat = np.ascontiguousarray(pixels, dtype=np.uint16).ravel()
        if flat.size and int(flat.max()) >> self.bits:
            raise ValueError(f"{self.name} holds {self.bits} bits, the image has a value of {int(flat.max())}")
        return _encode(self, flat)


#: Angles by the camera's own names over the super-pixel that `decode` makes of a format with `angles`.
ANGLES_LAYOUT = (("90", "45"), ("135", "0"))
# Where 0, 45, 90 and 135 degrees stand in it, (row, column).
_SUPER_PIXEL = ((1, 1), (0, 1), (0, 0), (1, 0))


def _super_pixels(counts: NDArray[np.uint16]) -> NDArray[np.uint16]:
    out = np.empty((2 * counts.shape[0], 2 * counts.shape[1]), np.uint16)
    for k, (r, c) in enumerate(_SUPER_PIXEL):
        out[r::2, c::2] = counts[:, :, k]
    return out


def _decode(fmt: PixelFormat, memory: NDArray[np.uint8], count: int) -> NDArray[np.uint16]:
    if fmt.layout == "plain":
        source = memory if fmt.bits == 8 else memory.view("<u2")
        return source.astype(np.uint16)
    if fmt.bits == 12:
        return _decode_12(memory, count, gigevision=fmt.layout == "packed")
    # Mono10p and Mono10Packed are rare: unpacking bit by bit is slow and plain to read.
    if fmt.layout == "packed":
        padded = np.zeros(-(-count // 2) * 3, np.uint16)
        padded[: memory.size] = memory
        first, middle, last = padded.reshape(-1, 3).T
        pixels = np.empty(2 * first.size, np.uint16)
        pixels[0::2] = first << 2 | middle & 0x3
        pixels[1::2] = last << 2 | middle >> 4 & 0x3
        return pixels[:count]
    bits = np.unpackbits(memory, bitorder="little")[: count * fmt.bits].reshape(count, fmt.bits)
    values: NDArray[np.uint16] = np.zeros(count, np.uint16)
    for bit in range(fmt.bits):
        values |= bits[:, bit].astype(np.uint16) << np.uint16(bit)
    return values


def _decode_12(memory: NDArray[np.uint8], count: int, *, gigevision: bool) -> NDArray[np.uint16]:
    pairs = -(-count // 2)
    if memory.size < 3 * pairs:
        memory = np.append(memory, np.uint8(0))
    triples = memory.reshape(pairs, 3)
    first, middle, last = triples[:, 0], triples[:, 1].astype(np.uint16), triples[:, 2]
    pixels = np.empty(2 * pairs, np.uint16)
    even, odd = pixels[0::2], pixels[1::2]
    if gigevision:
        even[:] = first
        even <<= 4
        even |= middle & 0xF
        odd[:] = last
        odd <<= 4
        odd |= middle >> 4
    else:
        even[:] = middle & 0xF
        even <<= 8
        even |= first
        odd[:] = last
        odd <<= 4
        odd |= middle >> 4
    return pixels[:count]


def _encode(fmt: PixelFormat, flat: NDArray[np.uint16]) -> NDArray[np.uint8]:
    if fmt.layout == "plain":
        return flat.astype(np.uint8) if fmt.bits == 8 else flat.astype("<u2").view(np.uint8)
    size = (flat.size * fmt.bits_in_memory // fmt.counts_per_pixel + 7) // 8
    if fmt.layout == "p":
        bits = flat[:, np.newaxis] >> np.arange(fmt.bits, dtype=np.uint16) & 1
        return np.packbits(bits.astype(np.uint8).ravel(), bitorder="little")[:size]
    if flat.size % 2:
        flat = np.append(flat, np.uint16(0))
    low = fmt.bits - 8
    triples = np.empty((flat.size // 2, 3), np.uint8)
    triples[:, 0] = flat[0::2] >> low
    triples[:, 1] = flat[0::2] & ((1 << low) - 1) | (flat[1::2] & ((1 << low) - 1)) << 4
    triples[:, 2] = flat[1::2] >> low
    return triples.ravel()[:size]


# PFNC codes of the four orders of the colour filters, in the order of their codes.
_BAYER_CODES: dict[tuple[int, Layout], dict[Literal["RG", "GR", "GB", "BG"], int]] = {
    (8, "plain"): {"GR": 0x01080008, "RG": 0x01080009, "GB": 0x0108000A, "BG": 0x0108000B},
    (10, "plain"): {"GR": 0x0110000C, "RG": 0x0110000D, "GB": 0x0110000E, "BG": 0x0110000F},
    (10, "packed"): {"GR": 0x010C0026, "RG": 0x010C0027, "GB": 0x010C0028, "BG": 0x010C0029},
    (10, "p"): {"BG": 0x010A0052, "GB": 0x010A0054, "GR": 0x010A0056, "RG": 0x010A0058},
    (12, "plain"): {"GR": 0x01100010, "RG": 0x01100011, "GB": 0x01100012, "BG": 0x01100013},
    (12, "packed"): {"GR": 0x010C002A, "RG": 0x010C002B, "GB": 0x010C002C, "BG": 0x010C002D},
    (12, "p"): {"BG": 0x010C0053, "GB": 0x010C0055, "GR": 0x010C0057, "RG": 0x010C0059},
    (14, "plain"): {"GR": 0x01100109, "RG": 0x0110010A, "GB": 0x0110010B, "BG": 0x0110010C},
    (14, "p"): {"GR": 0x010E0105, "RG": 0x010E0106, "GB": 0x010E0107, "BG": 0x010E0108},
    (16, "plain"): {"GR": 0x0110002E, "RG": 0x0110002F, "GB": 0x01100030, "BG": 0x01100031},
}
_ENDINGS: dict[Layout, str] = {"plain": "", "packed": "Packed", "p": "p"}


def _bayer() -> Iterator[PixelFormat]:
    for (bits, layout), codes in _BAYER_CODES.items():
        for order, code in codes.items():
            yield PixelFormat(f"Bayer{order}{bits}{_ENDINGS[layout]}", code, bits, layout, colours=order)


PIXEL_FORMATS: tuple[PixelFormat, ...] = (
    # PFNC and GigE Vision.
    PixelFormat("Mono8", 0x01080001, 8),
    PixelFormat("Mono10", 0x01100003, 10),
    PixelFormat("Mono10Packed", 0x010C0004, 10, "packed"),
    PixelFormat("Mono10p", 0x010A0046, 10, "p"),
    PixelFormat("Mono12", 0x01100005, 12),
    PixelFormat("Mono12Packed", 0x010C0006, 12, "packed"),
    PixelFormat("Mono12p", 0x010C0047, 12, "p"),
    PixelFormat("Mono14", 0x01100025, 14),
    PixelFormat("Mono16", 0x01100007, 16),
    PixelFormat("Mono14p", 0x010E0104, 14, "p"),
    *_bayer(),
    # Lucid, from one public header that lists its codes; the layout is that of the Mono format of the same name
    # (unverified on hardware).
    PixelFormat("PolarizeMono8", 0x81080001, 8, polarized=True),
    PixelFormat("PolarizeMono12", 0x81100008, 12, polarized=True),
    PixelFormat("PolarizeMono12Packed", 0x810C0006, 12, "packed", polarized=True),
    PixelFormat("PolarizeMono12p", 0x810C0047, 12, "p", polarized=True),
    PixelFormat("PolarizeMono16", 0x81100007, 16, polarized=True),
    # Lucid, four counts a pixel: codes of the same header, the order of the angles by name. Not raw: how the camera
    # makes them of the mosaic is not published (unverified on hardware).
    PixelFormat("PolarizedAngles_0d_45d_90d_135d_Mono8", 0x8220000F, 8, polarized=True, angles=True),
    PixelFormat("PolarizedAngles_0d_45d_90d_135d_Mono12p", 0x8230001F, 12, "p", polarized=True, angles=True),
    PixelFormat("PolarizedAngles_0d_45d_90d_135d_Mono16", 0x8240002F, 16, polarized=True, angles=True),
    # The same of the colour sensor: each count has the colour of its super-pixel, which make a Bayer pattern.
    PixelFormat("PolarizedAngles_0d_45d_90d_135d_BayerRG8", 0x8220020F, 8, polarized=True, colours="RG", angles=True),
    PixelFormat(
        "PolarizedAngles_0d_45d_90d_135d_BayerRG12p", 0x8230021F, 12, "p", polarized=True, colours="RG", angles=True
    ),
    # FLIR, named in Spinnaker's public interface without codes; layout by the rule of the names (unverified).
    PixelFormat("Polarized8", None, 8, polarized=True),
    PixelFormat("Polarized10p", None, 10, "p", polarized=True),
    PixelFormat("Polarized12p", None, 12, "p", polarized=True),
    PixelFormat("Polarized16", None, 16, polarized=True),
    PixelFormat("BayerRGPolarized8", None, 8, polarized=True, colours="RG"),
    PixelFormat("BayerRGPolarized10p", None, 10, "p", polarized=True, colours="RG"),
    PixelFormat("BayerRGPolarized12p", None, 12, "p", polarized=True, colours="RG"),
    PixelFormat("BayerRGPolarized16", None, 16, polarized=True, colours="RG"),
    # The Imaging Source, from its own public IC4 bindings and its Aravis example.
    PixelFormat("PolarizedMono8", 0x8108000A, 8, polarized=True),
    PixelFormat("PolarizedMono12p", 0x810C000B, 12, "p", polarized=True),
    PixelFormat("PolarizedMono12Packed", 0x810C0010, 12, "packed", polarized=True),
    PixelFormat("PolarizedMono16", 0x8110000C, 16, polarized=True),
)
_BY_CODE = {fmt.code: fmt for fmt in PIXEL_FORMATS if fmt.code is not None}
_BY_NAME = {fmt.name: fmt for fmt in PIXEL_FORMATS}


def pixel_format_of(code: int, name: str) -> PixelFormat:
    """The format that a camera is set to, by the code and the name that it tells; the code decides.

    Raises UnknownPixelFormat: as `pixel_format`; also where the name is known, but the code says another size of a
    pixel.
    """
    code &= 0xFFFFFFFF
    entry = _BY_NAME.get(name)
    if code not in _BY_CODE and entry is not None and entry.code is None and entry.bits_in_memory == code >> 16 & 0xFF:
        return replace(entry, code=code)
    return pixel_format(code)


def pixel_format(name_or_code: str | int) -> PixelFormat:
    """Look up a format by the camera's name or by its code.

    Raises UnknownPixelFormat: not in `PIXEL_FORMATS`, including the processed outputs (angle and degree of
    polarization, Stokes, full colour) of cameras, which are not raw intensities.
    """
    code = name_or_code & 0xFFFFFFFF if isinstance(name_or_code, int) else None
    known_format = _BY_NAME.get(str(name_or_code)) if code is None else _BY_CODE.get(code)
    if known_format is None:
        label = str(name_or_code) if code is None else f"code 0x{code:08x} ({code >> 16 & 0xFF} bits a pixel)"
        raise UnknownPixelFormat(
            f"pixel format {label}",
            "its layout in memory is not known here",
            "Choose one of " + ", ".join(fmt.name for fmt in PIXEL_FORMATS),
        )
    return known_format
