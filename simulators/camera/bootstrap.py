"""Registers that every GigE Vision camera has at the same addresses: identity, abilities, location of its XML."""

import socket
import struct

from simulators.camera.control_channel import CONTROL, HEARTBEAT_MS
from simulators.camera.genicam.node_tree import REGISTERS, NodeError, NodeTree
from simulators.camera.genicam.register import RegisterMemory

# Version 1.2; big-endian registers and UTF-8 texts; writing memory, several registers at once, packets again.
_VERSION, _MODE, _CAPABILITY = 0x0001_0002, 0x8000_0001, 0x0000_0007
_ADDRESS, _NETMASK = 0x0024, 0x0034
_TEXTS = {
    "DeviceVendorName": (0x48, 32),
    "DeviceModelName": (0x68, 32),
    "DeviceVersion": (0x88, 32),
    "DeviceID": (0xD8, 16),
}
_XML_URL, _URL_BYTES = 0x0200, 512
_TICKS_PER_S = 1_000_000_000
MOST_XML_BYTES = 1 << 24


def boot(memory: RegisterMemory, address: str, texts: dict[str, str], xml: tuple[str, int, int]) -> None:
    """Fill them in.

    Parameters
    ----------
    address : of the camera.
    texts : DeviceVendorName, DeviceModelName, DeviceVersion and DeviceID.
    xml : name of the description's file, its address and its length in bytes.
    """
    for register, value in (
        (0x0000, _VERSION),
        (0x0004, _MODE),
        # A hardware address that is administered locally, and an address that is fixed.
        (0x0008, 0x0200),
        (0x000C, struct.unpack(">I", socket.inet_aton(address))[0]),
        (0x0010, 0x0000_0005),
        (0x0014, 0x0000_0005),
        (_ADDRESS, struct.unpack(">I", socket.inet_aton(address))[0]),
        (_NETMASK, 0xFF00_0000),
        (0x0600, 1),
        (0x0900, 0),
        (0x0904, 1),
        (0x0934, _CAPABILITY),
        (HEARTBEAT_MS, 3000),
        (0x093C, _TICKS_PER_S >> 32),
        (0x0940, _TICKS_PER_S & 0xFFFF_FFFF),
        (CONTROL, 0),
        (0x0D00, 0),
        (0x0D04, 1500),
        (0x0D18, 0),
    ):
        memory.write(register, struct.pack(">I", value))
    for name, (register, length) in _TEXTS.items():
        memory.write(register, texts[name].encode()[: length - 1].ljust(length, b"\0"))
    name, place, length = xml
    memory.write(_XML_URL, f"Local:{name};{place:X};{length:X}".encode().ljust(_URL_BYTES, b"\0"))


def free_address(nodes: NodeTree) -> int:
    """An address for the XML at which no register lies."""
    registers = []
    for name in nodes:
        if nodes.node(name).tag in REGISTERS:
            try:
                registers.append(nodes.register(name))
            except NodeError:
                continue
    tops = range(0xFF00_0000, 0, -MOST_XML_BYTES)
    return next(top for top in tops if not any(register.overlaps(top, MOST_XML_BYTES) for register in registers))
