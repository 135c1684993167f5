"""Pixel formats byte by byte, from the GenICam naming convention and GigE Vision."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.aravis_library import load_aravis
from drivers.errors import UnknownPixelFormat
from drivers.pixel_formats import PIXEL_FORMATS, PixelFormat, pixel_format, pixel_format_of
from simulators.camera.pixel_stamp import read_stamp, stamp


@pytest.mark.parametrize(
    ("name", "memory", "counts"),
    [
        ("Mono8", "00 7f ff", [0, 0x7F, 0xFF]),
        ("Mono12", "bc 0a 23 01", [0xABC, 0x123]),
        ("Mono16", "34 12 ff ff", [0x1234, 0xFFFF]),
        # p: lowest bits first, end to end.
        ("Mono12p", "bc 3a 12", [0xABC, 0x123]),
        ("PolarizedMono12p", "bc 3a 12", [0xABC, 0x123]),
        ("Mono12p", "bc 3a 12 ef 0d", [0xABC, 0x123, 0xDEF]),
        ("Mono10p", "ff 03 00 00 80", [0x3FF, 0x000, 0x000, 0x200]),
        # packed: high bits in the outer bytes, low bits of both in the middle.
        ("Mono12Packed", "ab 3c 12", [0xABC, 0x123]),
        ("PolarizedMono12Packed", "ab 3c 12", [0xABC, 0x123]),
        ("Mono10Packed", "ff 13 00", [0x3FF, 0x001]),
        ("BayerRG12p", "bc 3a 12", [0xABC, 0x123]),
        ("Polarized10p", "ff 03 00 00 80", [0x3FF, 0x000, 0x000, 0x200]),
        ("BayerRGPolarized8", "00 7f ff", [0, 0x7F, 0xFF]),
    ],
)
def test_bytes_become_counts(name: str, memory: str, counts: list[int]) -> None:
    data = np.frombuffer(bytes.fromhex(memory), np.uint8)
    assert pixel_format(name).decode(data, len(counts), 1).tolist() == [counts]


@pytest.mark.parametrize(("name", "fits"), [("Mono12", False), ("BayerGB10", False), ("Mono16", True)])
def test_counts_that_the_camera_aligns_left_in_a_format_of_fewer_bits_are_told(name: str, fits: bool) -> None:
    fmt = pixel_format(name)
    memory = np.array([0xABC0, 0x1230], "<u2").view(np.uint8)
    told = fmt.misalignment(memory, fmt.decode(memory, 2, 1), fmt.bits, 0)
    assert told == ("" if fits else f"a count of 43968 needs more than {fmt.bits} bits")


@given(
    fmt=st.sampled_from(PIXEL_FORMATS),
    width=st.integers(1, 9),
    height=st.integers(1, 5),
    seed=st.integers(0, 2**32 - 1),
)
def test_an_image_survives_the_wire(fmt: PixelFormat, width: int, height: int, seed: int) -> None:
    shape = (fmt.scale * height, fmt.scale * width)
    pixels = np.random.default_rng(seed).integers(0, 1 << fmt.bits, shape).astype(np.uint16)
    memory = fmt.encode(pixels)
    assert memory.size == fmt.payload_bytes(width, height)
    assert np.array_equal(fmt.decode(memory, width, height), pixels)


def test_codes_are_those_that_aravis_has() -> None:
    aravis, _ = load_aravis()
    names = [name for name in dir(aravis) if name.startswith("PIXEL_FORMAT_")]
    codes = {name.replace("_", ""): int(getattr(aravis, name)) & 0xFFFFFFFF for name in names}
    aravis_codes = {fmt.name: codes.get(f"PIXELFORMAT{fmt.name.upper()}") for fmt in PIXEL_FORMATS}
    named_codes = {name: code for name, code in aravis_codes.items() if code is not None}
    assert {"Mono14", "BayerGR8", "BayerGB12p", "BayerBG10", "BayerBG16"} <= named_codes.keys()
    assert named_codes == {fmt.name: fmt.code for fmt in PIXEL_FORMATS if fmt.name in named_codes}


def test_bits_in_memory_are_in_the_code() -> None:
    for fmt in PIXEL_FORMATS:
        assert fmt.code is None or fmt.bits_in_memory == fmt.code >> 16 & 0xFF, fmt
    codes = [fmt.code for fmt in PIXEL_FORMATS if fmt.code is not None]
    assert len(set(codes)) == len(codes)
    assert len({fmt.name for fmt in PIXEL_FORMATS}) == len(PIXEL_FORMATS)


def test_four_counts_a_pixel_become_the_super_pixel_of_the_sensor() -> None:
    fmt = pixel_format("PolarizedAngles_0d_45d_90d_135d_Mono8")
    memory = np.array([0, 45, 90, 135, 1, 46, 91, 136], np.uint8)
    assert fmt.decode(memory, 2, 1).tolist() == [[90, 45, 91, 46], [135, 0, 136, 1]]


def test_a_format_without_a_published_code_is_known_by_the_name_that_the_camera_tells() -> None:
    fmt = pixel_format_of(0x810C0099, "Polarized12p")
    assert (fmt.code, fmt.bits, fmt.layout, fmt.polarized) == (0x810C0099, 12, "p", True)
    with pytest.raises(UnknownPixelFormat):
        pixel_format_of(0x81100099, "Polarized12p")
    # A code that is known decides, whatever it is called.
    assert pixel_format_of(0x01080001, "Polarized8").name == "Mono8"


def test_a_shift_takes_empty_low_bits_away() -> None:
    left_aligned = (np.arange(12, dtype=np.uint16).reshape(3, 4) * 300) << 4
    fmt = pixel_format("Mono16")
    assert np.array_equal(fmt.decode(fmt.encode(left_aligned), 4, 3, shift=4), left_aligned >> 4)


def test_decoded_counts_share_nothing_with_the_buffer() -> None:
    memory = np.full(8, 1, np.uint8)
    pixels = pixel_format("Mono8").decode(memory, 4, 2)
    memory[:] = 9
    assert pixels.tolist() == [[1] * 4] * 2


# The last one is a degree of polarization that a camera computed itself, not an intensity.
@pytest.mark.parametrize("unknown", ["Bayer", 0x02180014, 0x8218003F, "PolarizedDolp_Mono8"])
def test_an_unknown_format_is_refused_and_named(unknown: str | int) -> None:
    with pytest.raises(UnknownPixelFormat) as refused:
        pixel_format(unknown)
    assert (unknown if isinstance(unknown, str) else f"0x{unknown:08x}") in str(refused.value)


def test_a_code_that_a_library_sign_extended_is_the_same_code() -> None:
    assert pixel_format(0x810C0010 - (1 << 32)).name == "PolarizedMono12Packed"


def test_short_memory_and_counts_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="needs 12 bytes"):
        pixel_format("Mono12p").decode(np.zeros(11, np.uint8), 4, 2)
    with pytest.raises(ValueError, match="holds 12 bits"):
        pixel_format("Mono12p").encode(np.full((2, 2), 4096, np.uint16))


@given(values=st.lists(st.floats(allow_nan=False), max_size=4), bits=st.integers(8, 16), seed=st.integers(0, 1000))
def test_a_stamp_survives_noise(values: list[float], bits: int, seed: int) -> None:
    pixels = np.zeros((8, 16), np.uint16)
    stamp(pixels, values, bits=bits)
    noise = (1 << bits) // 32 - 1
    noisy = pixels + np.random.default_rng(seed).integers(-noise, noise + 1, pixels.shape)
    assert read_stamp(np.clip(noisy, 0, (1 << bits) - 1).astype(np.uint16), bits=bits) == tuple(values)


def test_a_picture_without_a_stamp_is_told() -> None:
    for pixels in (np.zeros((8, 16), np.uint16), np.full((1, 2), 9, np.uint16)):
        with pytest.raises(ValueError, match="no stamp"):
            read_stamp(pixels)
    disturbed = np.zeros((8, 16), np.uint16)
    stamp(disturbed, [1.5])
    disturbed[0, 7] ^= 0xF00
    with pytest.raises(ValueError, match="disturbed"):
        read_stamp(disturbed)
    with pytest.raises(ValueError, match="needs"):
        stamp(np.zeros((2, 2), np.uint16), [1.0])
