"""AxoStep's files: hand-built bytes, round trips, both headers, and what is refused."""

import struct
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from processing.storage.formats.axostep import (
    METADATA,
    AxoStepError,
    MuellerFile,
    RawFrames,
    read_mueller_file,
    read_rmmd,
    write_mueller_file,
)


def test_raw_frames_byte_by_byte(tmp_path: Path) -> None:
    # Two frames of 2 rows x 3 columns; the file's first row is the image's last.
    for header in ([7, 2, 2, 3], [7, 2, 2, 3, 99]):
        file = tmp_path / "a.rmmd"
        file.write_bytes(struct.pack(f">{len(header) + 12}i", *header, *range(100, 112)))
        raw = read_rmmd(file)
        np.testing.assert_array_equal(raw.frames[0], [[103, 104, 105], [100, 101, 102]])
        np.testing.assert_array_equal(raw.frames[1], [[109, 110, 111], [106, 107, 108]])
        assert (raw.header, raw.header_words, raw.extra) == (7, len(header), 99 if len(header) == 5 else 0)


def test_closing_repeat_is_dropped_and_tells_the_drift() -> None:
    frames = np.full((41, 4, 4), 1000, np.int32)
    frames[-1] = 990
    raw = RawFrames(frames)
    assert raw.states(40).shape == (40, 4, 4)
    assert raw.drift(40) == pytest.approx(0.99)
    assert raw.drift(41) is None
    with pytest.raises(AxoStepError, match="holds 41 frames; a table of 24 states needs 24, or 25"):
        raw.states(24)


def test_mueller_image_byte_by_byte(tmp_path: Path) -> None:
    # N1 = 2 columns, N2 = 3 rows: pixel p = column, q counted from the bottom; two reduced parameters.
    values = {(p, q): [1000 * p + 100 * q + e for e in range(16)] for p in range(2) for q in range(3)}
    body = [v for p in range(2) for q in range(3) for v in values[p, q]]
    reduced = [v for p in range(2) for q in range(3) for v in (p + 0.5, q + 0.25)]
    names = [n for n in METADATA if n != "date"]
    numbers = dict(zip(names, map(float, range(1, len(names) + 1)), strict=True))
    seconds = 3.7e9 + 0.5
    date = struct.pack(">d", seconds)
    tail = b"".join(date if n == "date" else struct.pack(">f", numbers[n]) for n in METADATA) + b"\x00\x01\x02\x03"
    for header in ([2.0, 3, 4, 4], [5.0, 2, 3, 4, 4]):
        file = tmp_path / "a.cmmi"
        file.write_bytes(struct.pack(f">{len(header) + 97 + 12}f", *header, *body, 2, *reduced) + tail)
        image = read_mueller_file(file)
        assert image.mueller.shape == (4, 4, 3, 2)
        assert image.header_words == len(header)
        for (p, q), pixel in values.items():
            np.testing.assert_array_equal(image.mueller[:, :, 2 - q, p].ravel(), pixel)
            np.testing.assert_array_equal(image.reduced[:, 2 - q, p], [p + 0.5, q + 0.25])
        assert image.metadata == numbers
        assert image.date is not None
        assert (image.date - datetime(1904, 1, 1, tzinfo=UTC)).total_seconds() == seconds
        assert image.trailer == b"\x00\x01\x02\x03"
        copy = tmp_path / "b.cmmi"
        write_mueller_file(copy, image)
        assert copy.read_bytes() == file.read_bytes()


def test_the_labs_own_indexing_of_a_square_image(tmp_path: Path) -> None:
    # Element i of pixel p at word 5 + i + 16 p; image[row, column] = file(column, 599 - row).
    m = np.random.default_rng(1).normal(size=(4, 4, 600, 600)).astype(np.float32)
    file = tmp_path / "a.cmmi"
    write_mueller_file(file, MuellerFile(m, np.empty((0, 600, 600), np.float32)))
    words = np.fromfile(file, ">f4")
    for i, row, column in [(0, 0, 0), (5, 17, 431), (15, 599, 2)]:
        p = 600 * column + 599 - row
        assert words[5 + i + 16 * p] == m.reshape(16, 600, 600)[i, row, column]


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 5), st.integers(1, 5), st.integers(0, 31), st.sampled_from([4, 5]), st.booleans())
def test_round_trip(
    tmp_path_factory: pytest.TempPathFactory, rows: int, columns: int, reduced: int, header_words: int, plain: bool
) -> None:
    rng = np.random.default_rng(rows * 7 + columns)
    image = MuellerFile(
        rng.normal(size=(4, 4, rows, columns)).astype(np.float32),
        rng.normal(size=(0 if plain else reduced, rows, columns)).astype(np.float32),
        {"wavelength_nm": 662.0, "shutter_ms": 20.5},
        datetime(2021, 8, 16, 12, 30, tzinfo=UTC),
        header_words=header_words,
    )
    file = tmp_path_factory.mktemp("axostep") / ("x.bmmi" if plain else "x.cmmi")
    write_mueller_file(file, image)
    copy = read_mueller_file(file)
    np.testing.assert_array_equal(copy.mueller, image.mueller)
    np.testing.assert_array_equal(copy.reduced, image.reduced)
    assert copy.metadata["wavelength_nm"] == 662
    assert copy.date == image.date
    assert copy.header_words == header_words


def test_what_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "x.rmmd"
    for data, message in [
        (b"\x00" * 7, "no whole number of 32-bit words"),
        (b"\x00" * 12, "less than any header"),
        (struct.pack(">10i", 0, 2, 2, 3, *range(6)), "says 2 frames of 2 x 3, which is 12 words"),
        (struct.pack(">5i", 0, -1, 2, 3, 0), "truncated, or no .rmmd"),
    ]:
        file.write_bytes(data)
        with pytest.raises(AxoStepError, match=message):
            read_rmmd(file)
    image = tmp_path / "x.cmmi"
    for data, message in [
        (struct.pack(">8f", 2, 2, 4, 4, 0, 0, 0, 0), r"has 8 words and starts with 2, 2, 4, 4, 0"),
        (struct.pack(">4f", 2, 2, 3, 4), "expected N1, N2, 4, 4"),
        (struct.pack(">23f", 1, 1, 4, 4, *range(16), 0.5, 1, 1), "number of reduced parameters and says 0.5; 2 words"),
        (struct.pack(">22f", 1, 1, 4, 4, *range(16), 31, 1), "says 31; 1 words follow"),
    ]:
        image.write_bytes(data)
        with pytest.raises(AxoStepError, match=message):
            read_mueller_file(image)
