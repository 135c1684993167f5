"""A damaged text of an HDF5 file that the library would read for ever is refused before it is read."""

from pathlib import Path

import h5py
import pytest

from processing.errors import ProcessError
from processing.storage.captures.capture import Capture
from processing.storage.integrity.h5_door import mark_of, open_h5
from processing.storage.integrity.text_heaps import endless_heap


def _with_texts(path: Path) -> Path:
    with h5py.File(path, "w") as h5:
        h5.attrs["kind"], h5.attrs["other"] = "mueller", "a longer text than the first"
    return path


def _free_space(image: bytes) -> int:
    """Where the size of the free space stands: object 0, after the two texts."""
    at = image.index(b"GCOL") + 16
    while (index := int.from_bytes(image[at : at + 2], "little")) != 0:
        assert index <= 2
        at += 16 + (int.from_bytes(image[at + 8 : at + 16], "little") + 7) // 8 * 8
    return at + 8


@pytest.fixture
def endless(tmp_path: Path) -> Path:
    path = _with_texts(tmp_path / "damaged.h5")
    image = bytearray(path.read_bytes())
    at = _free_space(bytes(image))
    image[at : at + 8] = bytes(8)
    path.write_bytes(image)
    return path


def test_a_sound_file_is_opened(tmp_path: Path) -> None:
    path = _with_texts(tmp_path / "sound.h5")
    assert endless_heap(path) is None
    assert mark_of(path, "kind") == "mueller"


def test_it_is_refused_in_words(endless: Path) -> None:
    assert mark_of(endless, "kind") is None
    for read in (lambda: Capture(endless), lambda: open_h5(endless, ProcessError)):
        with pytest.raises(ProcessError, match=r"damaged\.h5 cannot be read as HDF5: its texts at byte 2,048"):
            read()


def test_a_heap_far_from_the_beginning_is_seen_too(endless: Path, tmp_path: Path) -> None:
    far = tmp_path / "far.h5"
    far.write_bytes(bytes(5 << 20) + endless.read_bytes())
    assert endless_heap(far) == (5 << 20) + 2048
