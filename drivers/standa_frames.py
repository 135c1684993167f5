"""Frames of Standa's 8SMC4 and 8SMC5: four letters, little-endian data, and a checksum (CRC-16/MODBUS) of the data.

Layouts: the protocol definition (version 20.3) that the maker's own library `libximc` is generated from. An answer
begins with the letters of its question, and a command is answered with its letters alone. Zeros before an answer mean
nothing.
"""

import struct

# Longer than any command: it completes a partial command, which the controller refuses by its checksum.
RESYNCHRONIZE = bytes(250)
UNKNOWN_COMMAND, WRONG_CHECKSUM, WRONG_VALUE = b"errc", b"errd", b"errv"

# Layout of the data behind the letters, both ways; blanks are bytes that the maker reserves.
LAYOUTS = {
    b"gets": struct.Struct("<5BihqihhhhhhIIB4x"),
    b"geti": struct.Struct("<4s2s8sBBH12x"),
    b"gser": struct.Struct("<I"),
    b"gfwv": struct.Struct("<BBH"),
    b"gmov": struct.Struct("<IBHHIB10x"),
    b"geng": struct.Struct("<HHIBHhBH12x"),
    b"gent": struct.Struct("<BB6x"),
    b"gfbs": struct.Struct("<HBBI4x"),
    b"geds": struct.Struct("<BBihih6x"),
    b"ghom": struct.Struct("<IBIBihH9x"),
    b"gpos": struct.Struct("<ihq6x"),
    b"move": struct.Struct("<ih6x"),
}
# Answered with the letters alone.
ECHOED = frozenset((b"move", b"home", b"zero", b"sstp", b"stop"))
ERRORS = frozenset((UNKNOWN_COMMAND, WRONG_CHECKSUM, WRONG_VALUE))


def checksum(data: bytes) -> bytes:
    """CRC-16/MODBUS, low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
    return crc.to_bytes(2, "little")


def message(letters: bytes, data: bytes = b"") -> bytes:
    """Build a command, a question or an answer; one without data has no checksum."""
    return letters + data + checksum(data) if data else letters


def framer(buffer: bytearray) -> bytes | None:
    """Take one whole answer off the buffer, without its checksum; bytes that start none are dropped one by one."""
    while len(buffer) >= 4:
        letters = bytes(buffer[:4])
        if letters in ECHOED | ERRORS:
            del buffer[:4]
            return letters
        layout = LAYOUTS.get(letters)
        if layout is not None:
            end = 4 + layout.size
            if len(buffer) < end + 2:
                return None
            frame = bytes(buffer[:end])
            if checksum(frame[4:]) == bytes(buffer[end : end + 2]):
                del buffer[: end + 2]
                return frame
        del buffer[0]
    return None
