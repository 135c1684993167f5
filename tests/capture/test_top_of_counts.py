"""Where the counts of a camera end, found from its frames: every converter in every format; no end where none is."""

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.top_of_counts import TopOfCounts

SHAPE = (240, 320)


def scene(rng: np.random.Generator, brightest: float, full_well_e: float) -> NDArray[np.float64]:
    """Electrons of a smooth scene with a bright spot, shot and read noise; the brightest is a factor on the well."""
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    spot = np.exp(-((x - 200) ** 2 + (y - 100) ** 2) / (2 * rng.uniform(20, 60) ** 2))
    light = brightest * full_well_e * (0.1 + 0.9 * spot)
    return rng.poisson(light) + rng.normal(0, 3, SHAPE)


def counts(electrons: NDArray[np.float64], converter: int, full_well_e: float, shift: int) -> NDArray[np.uint16]:
    """Counts of a converter of so many bits, whose range is the full well, left-shifted into a wider format."""
    black = 2 ** (converter - 8)
    top = 2**converter - 1
    return (np.clip(np.rint(electrons / full_well_e * top + black), 0, top).astype(np.uint16)) << np.uint16(shift)


@pytest.mark.parametrize("aligned", ["left", "right"])
@pytest.mark.parametrize(
    ("converter", "bits"), [(8, 8), (8, 12), (8, 16), (10, 10), (10, 12), (10, 16), (12, 12), (12, 16)]
)
def test_the_end_is_found_wherever_the_converter_ends(converter: int, bits: int, aligned: str) -> None:
    rng = np.random.default_rng(converter * 100 + bits)
    shift = bits - converter if aligned == "left" else 0
    for _ in range(4):
        well = 10 ** rng.uniform(3.8, 4.8)
        top = TopOfCounts(bits)
        # Darks first, as a capture has them, then light that clips up to a third of the pixels.
        top.look(counts(rng.normal(0, 3, SHAPE), converter, well, shift))
        for brightest in (0.3, 0.7, rng.uniform(1.1, 3.0)):
            frame = counts(scene(rng, brightest, well), converter, well, shift)
            top.look(frame)
        assert np.count_nonzero(frame == frame.max()) > 100
        assert top.counts == (2**converter - 1) << shift


@pytest.mark.parametrize(("converter", "bits"), [(8, 8), (10, 12), (12, 12), (12, 16)])
def test_no_end_is_found_in_frames_that_do_not_clip(converter: int, bits: int) -> None:
    rng = np.random.default_rng(7 + bits)
    for _ in range(6):
        well = 10 ** rng.uniform(3.8, 4.8)
        top = TopOfCounts(bits)
        top.look(counts(rng.normal(0, 3, SHAPE), converter, well, 0))
        for brightest in rng.uniform(0.02, 0.8, 6):
            # An even white target, too.
            even = rng.poisson(brightest * well, SHAPE) + rng.normal(0, 3, SHAPE)
            for electrons in (scene(rng, brightest, well), even):
                top.look(counts(electrons, converter, well, 0))
        assert (top.step, top.counts) == (1, 2**bits - 1)


def test_what_a_camera_tells_of_its_converter_holds_until_counts_say_otherwise() -> None:
    top = TopOfCounts(12, converter_bits=10)
    assert (top.step, top.counts) == (4, 4092)
    top.look(np.arange(1023, dtype=np.uint16).reshape(11, 93))
    assert (top.step, top.counts) == (1, 4095)


def test_a_patch_of_equal_pixels_is_no_end_once_something_is_brighter() -> None:
    rng = np.random.default_rng(3)
    dim = rng.normal(500, 20, SHAPE).astype(np.uint16)
    dim[:40, :40] = 1500
    top = TopOfCounts(12)
    top.look(dim)
    top.look(dim)
    assert top.counts == 1500
    dim[100, 100] = 1600
    top.look(dim)
    assert top.counts == 4095
