"""Rows of packed datasets, unpacked without HDF5, are what HDF5 reads; damage is an error of the file."""

import h5py
import numpy as np
import pytest
from isal import isal_zlib

from processing.storage.integrity import packing
from processing.storage.integrity.unpacking import KeptChunks, is_packed, read_rows

SHAPE = (3, 2, 70, 40)


@pytest.fixture
def write(tmp_path, monkeypatch):
    """Writes a packed dataset in chunks of 16 rows, the last of each plane not full."""
    monkeypatch.setattr(packing, "CHUNK_PIXELS", 640)

    def file(values: np.ndarray) -> h5py.File:
        h5 = h5py.File(tmp_path / "rows.h5", "w")
        h5["plain"] = values
        packing.pack(h5["plain"], packing.create_packed(h5, "packed", values.shape, values.dtype))
        return h5

    return file


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int32, np.float32, np.float64])
@pytest.mark.parametrize("threads", ["1", "2"])
def test_rows_are_what_hdf5_reads(write, monkeypatch, dtype, threads):
    monkeypatch.setenv("UMOV_THREADS", threads)
    values = (1000 * np.random.default_rng(1).normal(size=SHAPE)).astype(np.int64).astype(dtype)
    with write(values) as h5:
        assert is_packed(h5["packed"])
        assert not is_packed(h5["plain"])
        for name in ("packed", "plain"):
            np.testing.assert_array_equal(read_rows(h5[name], slice(None)), values)
            np.testing.assert_array_equal(read_rows(h5[name], slice(15, 66)), values[..., 15:66, :])
            np.testing.assert_array_equal(read_rows(h5[name], slice(3, 60, 7), (1,)), values[1, ..., 3:60:7, :])
            np.testing.assert_array_equal(read_rows(h5[name], slice(64, 99), (2, 1)), values[2, 1, 64:, :])
            assert read_rows(h5[name], slice(5, 5)).shape == (3, 2, 0, 40)


@pytest.mark.parametrize("most_bytes", [1 << 25, 3000])
def test_who_reads_row_by_row_has_each_chunk_unpacked_once(write, monkeypatch, most_bytes):
    monkeypatch.setattr(KeptChunks, "MOST_BYTES", most_bytes)
    unpacked = []
    decompress = isal_zlib.decompress
    monkeypatch.setattr(isal_zlib, "decompress", lambda raw: unpacked.append(raw) or decompress(raw))
    values = np.arange(np.prod(SHAPE), dtype=np.uint16).reshape(SHAPE)
    cache = KeptChunks()
    with write(values) as h5:
        for state in range(3):
            for row in range(70):
                rows = read_rows(h5["packed"], slice(row, row + 1), (state,), cache)
                np.testing.assert_array_equal(rows, values[state, :, row : row + 1])
    # Three states of two channels of five chunks; where two fit, those of the two channels take turns.
    assert len(unpacked) == 3 * 2 * 5


def test_a_chunk_that_was_never_written_is_zero(write):
    with write(np.ones(SHAPE, np.uint16)) as h5:
        begun = packing.create_packed(h5, "begun", SHAPE, np.uint16)
        begun[0, 0, :16] = 5
        np.testing.assert_array_equal(read_rows(begun, slice(None)), begun[...])


def test_a_damaged_chunk_is_an_error_of_the_file(write):
    with write(np.arange(np.prod(SHAPE), dtype=np.uint16).reshape(SHAPE)) as h5:
        _, raw = h5["packed"].id.read_direct_chunk((1, 0, 16, 0))
        h5["packed"].id.write_direct_chunk((1, 0, 16, 0), raw[: len(raw) // 2])
        h5.flush()
        with pytest.raises(OSError, match="filter"):
            read_rows(h5["packed"], slice(None))
        read_rows(h5["packed"], slice(None), (0,))


def test_bytes_that_are_noise_are_stored_and_every_reader_finds_the_values(write):
    """Exponents shrink, mantissas do not: to deflate those as well costs most of the time and gains next to nothing."""
    values = np.random.default_rng(2).normal(1.0, 0.1, (3, 2, 64, 40)).astype(np.float32)
    with write(values) as h5:
        best = packing.Packing.of(h5["plain"])
        assert best.deflated == (False, False, False, True)
        _, stream = h5["packed"].id.read_direct_chunk((1, 1, 16, 0))
        # The first bytes of the chunk's values stand in its stream as they are.
        assert values[1, 1, 16:32].tobytes()[::4] in stream
        dataset = packing.create_packed(h5, "every", values.shape, np.float32)
        packing.pack(h5["plain"], dataset, packing.Packing(1.0, (True,) * 4))
        for name in ("packed", "every"):
            np.testing.assert_array_equal(h5[name][...], values)
            np.testing.assert_array_equal(read_rows(h5[name], slice(None)), values)
        assert h5["packed"].id.get_storage_size() < 1.05 * dataset.id.get_storage_size()
        size = h5["plain"].nbytes / best.ratio
        assert h5["packed"].id.get_storage_size() == pytest.approx(size, rel=0.15)


def test_a_stored_piece_may_be_longer_than_a_block_of_the_stream(tmp_path):
    values = np.random.default_rng(3).integers(0, 1 << 16, (1, 400, 400)).astype(np.uint16)
    with h5py.File(tmp_path / "large.h5", "w") as h5:
        h5["plain"] = values
        packing.pack(h5["plain"], packing.create_packed(h5, "packed", values.shape, values.dtype))
        assert packing.Packing.of(h5["plain"]).deflated == (False, False)
        np.testing.assert_array_equal(h5["packed"][...], values)
