"""Frames of the Thorlabs APT protocol: little-endian, a header of six bytes, data behind some of them."""

import struct

# A rack answers at RACK, the unit in its first bay at BAY, the next one behind that.
HOST, UNIT, RACK, BAY = 0x01, 0x50, 0x11, 0x21

# Every message that a unit sends to this host, with its whole length. A frame is recognized by id and length, not
# by its addresses: a K10CR2 sends a malformed destination (PnPQ), others a source of zero (thorlabs-apt-device).
# A K10CR2 also sends a longer status (PnPQ), with words for a second channel.
_LENGTHS = {
    0x0006: 6 + 84,
    0x0061: 6,
    0x0080: 6,
    0x0081: 6 + 68,
    0x0212: 6,
    0x0412: 6 + 6,
    0x0415: 6 + 14,
    0x042A: 6 + 6,
    0x0442: 6 + 14,
    0x0444: 6,
    0x0464: 6 + 14,
    0x0466: 6 + 14,
    0x0481: 6 + 14,
    0x0491: 6 + 14,
}
_LONG_STATUS = 6 + 28
_OF_THE_STATUS = (0x0464, 0x0466, 0x0481)
REPLY_NAMES = {
    0x0006: "hardware information",
    0x0061: "state of a bay",
    0x0412: "position",
    0x0415: "velocity parameters",
    0x042A: "status bits",
    0x0442: "homing parameters",
}


def apt_framer(buffer: bytearray) -> bytes | None:
    """Take one whole message off the buffer; bytes that start none are dropped one by one."""
    while len(buffer) >= 6:
        message_id = int.from_bytes(buffer[:2], "little")
        length = _LENGTHS.get(message_id)
        if message_id in _OF_THE_STATUS and int.from_bytes(buffer[2:4], "little") == _LONG_STATUS - 6:
            length = _LONG_STATUS
        data_follows = length is not None and length > 6
        if length is None or (data_follows and int.from_bytes(buffer[2:4], "little") != length - 6):
            del buffer[0]
            continue
        if len(buffer) < length:
            return None
        frame = bytes(buffer[:length])
        del buffer[:length]
        return frame
    return None


def short_message(message_id: int, first: int = 0, second: int = 0, to: int = UNIT) -> bytes:
    """Build a message without data, from host to unit."""
    return struct.pack("<HBBBB", message_id, first, second, to, HOST)


def long_message(message_id: int, data: bytes, to: int = UNIT) -> bytes:
    """Build a message with data, from host to unit."""
    return struct.pack("<HHBB", message_id, len(data), to | 0x80, HOST) + data
