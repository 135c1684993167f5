"""A text with space taken for what it will be: as long as it is for every reader, and longer when it is written again.

HDF5 keeps the length of a text in the type of its dataset, four bytes of the header, and the room in its layout. A room
that is larger than the text is as good to every reader (HDF5 File Format Specification 3.0, sections IV.A.1.a, "Version
1 Data Object Header Prefix", IV.A.2.d, "Datatype Message", and IV.A.2.i, "Data Layout Message").
"""

import os
import struct

import h5py

#: Bytes of an object header of version 1 before its first message, and of a message before its content.
PREFIX, MESSAGE = 16, 8
DATATYPE = 3
#: First byte of the type of a text of fixed length: class 3, version 1. Its length stands four bytes behind.
FIXED_TEXT = 0x13
LENGTH = struct.Struct("<I")


class TextBox:
    """Where a text of fixed length lies in an open file.

    Parameters
    ----------
    file : descriptor of the file or of its image in memory, with all that HDF5 knows written to it.
    dataset : of that file, without chunks.

    Attributes
    ----------
    offset, room : first byte of the text and bytes that it may have.
    length_at : the byte at which its length stands; None for a box of bytes, as in older files.
    """

    def __init__(self, file: int, dataset: h5py.Dataset) -> None:
        offset = dataset.id.get_offset()
        if offset is None:
            raise ValueError(f"{dataset.name} has no place of its own in the file")
        self.offset: int = offset
        self.room: int = dataset.id.get_storage_size()
        self.length_at = _length_at(file, dataset) if dataset.dtype.kind == "S" else None

    def length(self, file: int) -> int:
        """Bytes that every reader is shown; zero bytes at their end are no part of the text."""
        if self.length_at is None:
            return self.room
        return min(int(LENGTH.unpack(os.pread(file, LENGTH.size, self.length_at))[0]), self.room)

    def set_length(self, file: int, length: int) -> None:
        """Have every reader shown so many bytes; a box of bytes has no length."""
        if self.length_at is not None:
            os.pwrite(file, LENGTH.pack(length), self.length_at)

    def read(self, file: int) -> bytes:
        """The text, with zero bytes behind it where it was being written when the program was killed."""
        return os.pread(file, self.length(file), self.offset)


def _length_at(file: int, dataset: h5py.Dataset) -> int:
    """At which byte the length of a text stands. Raises ValueError where it is not found."""
    header = h5py.h5o.get_info(dataset.id).addr
    version, size = struct.unpack("<B7xI", os.pread(file, 12, header))
    position, end = header + PREFIX, header + PREFIX + size
    while version == 1 and position < end:
        kind, size = struct.unpack("<HH", os.pread(file, 4, position))
        first, length = struct.unpack("<B3xI", os.pread(file, 8, position + MESSAGE))
        if kind == DATATYPE and first == FIXED_TEXT and length == dataset.dtype.itemsize:
            return int(position + MESSAGE + 4)
        position += MESSAGE + size
    raise ValueError(f"the length of {dataset.name} stands where this program does not look for it")
