"""Darks with light in them, and a black level that jitters or does not."""

import numpy as np
import pytest
from steady_capture import steady_capture

from processing.diagnosis.captures.black_jitter import black_jitter
from processing.reduction.counts_to_signal import CountCorrection
from processing.reduction.lit_darks import LitDarks
from processing.storage.captures.capture import Capture
from processing.storage.captures.schema import Detector

BLACK = 64.0
SHAPE = (64, 80)
POSES = [(9.0 * k,) for k in range(12)]


def frame(light: float, seed: int, rng_scale: float = 2.0) -> np.ndarray:
    """A bright disc on a dark ground, with noise."""
    r, c = np.mgrid[: SHAPE[0], : SHAPE[1]]
    disc = np.hypot(r - 32, c - 40) < 18
    return BLACK + light * disc + np.random.default_rng(seed).normal(0, rng_scale, SHAPE)


def verdict(dark: float, lights: list[float], *, mosaic: bool = False, black: float = BLACK) -> str | None:
    look = LitDarks(black, mosaic=mosaic, lights=len(lights))
    look.dark(0.01, POSES[0], frame(dark, 99))
    for k, light in enumerate(lights):
        wrong = look.light(0.01, POSES[k], frame(light, k))
        if wrong is not None:
            return wrong
    return None


@pytest.mark.parametrize("drift", [0.97, 1.0, 1.03])
def test_lit_darks_are_found_in_a_mosaic_at_the_first_light_state(drift: float) -> None:
    wrong = verdict(900.0, [900.0 * drift], mosaic=True)
    assert wrong is not None
    assert "as bright as a light state in the same pose" in wrong


def test_lit_darks_are_found_in_a_rotation_whose_states_differ() -> None:
    assert verdict(500.0, [500.0, 900.0, 100.0, 30.0, 700.0, 250.0, 900.0, 20.0]) is not None


@pytest.mark.parametrize(
    "lights",
    [
        [0.0, 900.0, 400.0, 100.0, 700.0, 20.0, 300.0, 800.0],  # crossed polarizers in the first pose
        [5.0, 40.0, 12.0, 30.0, 8.0, 25.0, 36.0, 18.0],  # a dim sample
        [900.0] * 8,
    ],
)
@pytest.mark.parametrize("wrong_black", [0.0, -10.0, 1.0])
def test_dark_darks_pass(lights: list[float], wrong_black: float) -> None:
    assert verdict(0.0, lights, black=BLACK + wrong_black) is None


@pytest.mark.parametrize("mosaic", [True, False])
def test_lit_darks_of_a_light_that_is_weaker_than_the_noise_are_found(mosaic: bool) -> None:
    # A pixel's noise is 2 counts.
    assert verdict(1.5, [1.5, 1.4, 1.6], mosaic=mosaic) is not None


@pytest.mark.parametrize("light", [0.0, 0.2, 0.5, 1.0])
def test_dark_darks_of_a_light_in_the_noise_pass(light: float) -> None:
    for seed in range(20):
        look = LitDarks(BLACK, mosaic=True, lights=1)
        look.dark(0.01, POSES[0], frame(0.0, 2 * seed))
        assert look.light(0.01, POSES[0], frame(light, 2 * seed + 1)) is None


@pytest.mark.parametrize("mosaic", [True, False])
@pytest.mark.parametrize(("light", "is_visible"), [(0.0, False), (3.0, True), (900.0, True)])
def test_light_states_that_are_as_dark_as_the_darks_are_told_once(mosaic: bool, light: float, is_visible: bool) -> None:
    for seed in range(10):
        look = LitDarks(BLACK, mosaic=mosaic, lights=12)
        look.dark(0.01, POSES[0], frame(0.0, 100 + seed))
        remarks = []
        for k, pose in enumerate(POSES):
            # Crossed polarizers in every second pose.
            assert look.light(0.01, pose, frame(light * (k % 2 or mosaic), 1000 * seed + k)) is None
            remarks.append(look.without_light(0.01))
        texts = [text for text in remarks if text is not None]
        assert len(texts) == (0 if is_visible else 1)
        assert all("the light states of 0.01 s are no brighter than the dark ones" in text for text in texts)
        assert look.without_light(0.02) is None


def test_single_bright_pixels_are_no_noise_that_hides_lit_darks() -> None:
    sparkles = np.where(np.random.default_rng(0).random(SHAPE) < 1 / 256, 3000.0, 0.0)
    look = LitDarks(BLACK, mosaic=True, lights=1)
    look.dark(0.01, POSES[0], frame(0.0, 1) + sparkles)
    assert look.light(0.01, POSES[0], frame(0.0, 2) + sparkles) is not None


def test_darks_of_another_exposure_say_nothing() -> None:
    look = LitDarks(BLACK, mosaic=True, lights=1)
    look.dark(0.01, POSES[0], frame(900.0, 1))
    assert look.light(0.02, POSES[0], frame(900.0, 2)) is None


def warned(synthetic_capture, dark: np.ndarray, light: np.ndarray, **header: object) -> list[str]:
    counts = np.stack([dark, dark, light, light]).astype(np.uint16)[:, None]
    roles = ("dark", "dark", "sample", "sample")
    header = {"detector": Detector(black_level_counts=BLACK), "mosaic": (("90", "45"), ("135", "0"))} | header
    path = synthetic_capture(counts, {"psg": np.zeros(4)}, role=roles, channels=("mosaic",), **header)
    with Capture(path) as capture:
        return [text for text in CountCorrection.of(capture).warnings if "dark" in text]


def test_the_reduction_warns_of_darks_that_are_brighter_in_a_part_or_in_one_analyzer(synthetic_capture) -> None:
    light = frame(800.0, 1)
    corner, analyzer = frame(0.0, 2), frame(0.0, 2)
    corner[:20, :40] += 500.0
    analyzer[::2, 1::2] += 900.0
    (text,) = warned(synthetic_capture, corner, light)
    assert "in 25 % of the image of single analyzers the dark states are brighter" in text
    (text,) = warned(synthetic_capture, analyzer, light)
    assert "of single analyzers the dark states are brighter" in text
    assert not warned(synthetic_capture, frame(0.0, 2), light)


def test_the_reduction_warns_of_darks_that_hold_a_part_of_the_light(synthetic_capture) -> None:
    leak = frame(0.0, 2) + 300.0
    (text,) = warned(synthetic_capture, leak, frame(800.0, 1) + 300.0)
    assert "299 counts above the declared black level 64" in text
    undeclared = Detector(black_level_counts=0.0)
    assert not warned(synthetic_capture, frame(0.0, 2), frame(100.0, 1), detector=undeclared)


def test_the_reduction_warns(synthetic_capture) -> None:
    counts = np.stack([frame(800.0, k) for k in range(5)]).astype(np.uint16)[:, None]
    header = {"detector": Detector(black_level_counts=BLACK), "mosaic": (("90", "45"), ("135", "0"))}
    roles = ("dark", "dark", "sample", "sample", "sample")
    path = synthetic_capture(counts, {"psg": np.zeros(5)}, role=roles, channels=("mosaic",), **header)
    with Capture(path) as capture:
        (warning,) = [text for text in CountCorrection.of(capture).warnings if "as bright as" in text]
        assert "light shut off" in warning


def test_the_reduction_warns_of_a_capture_without_light(synthetic_capture) -> None:
    (text,) = warned(synthetic_capture, frame(0.0, 2), frame(0.0, 3))
    assert "the light states of 0.01 s are no brighter than the dark ones" in text


STATES, SIDE, SIGMA = 20, 60, 1e-4


def capture(offset, misfit):
    """A bright surface under a dim background that grows brighter downwards, each with a misfit of its own."""
    random = np.random.default_rng(3)
    bright, dim = np.sqrt(STATES) * np.linalg.qr(random.normal(size=(STATES, 2)))[0].T
    light = np.full((SIDE, SIDE), 0.5)
    light[:20] = np.linspace(0.003, 0.009, 20)[:, None]
    lit = light > 0.1
    signal = light * (1 + misfit * np.where(lit, bright[:, None, None], dim[:, None, None]))
    signal = signal + offset * random.normal(size=(STATES, 1, 1)) + SIGMA * random.normal(size=signal.shape)
    return steady_capture(signal, SIGMA)


@pytest.mark.parametrize(("offset", "misfit", "is_jitter"), [(0.0, 0.0, False), (0.0, 0.2, False), (3e-4, 0.0, True)])
def test_an_offset_is_the_same_in_darker_and_brighter_dim_pixels(offset, misfit, is_jitter):
    assert (black_jitter(capture(offset, misfit), np.ones((STATES, 1))) is not None) == is_jitter


@pytest.mark.parametrize("seed", range(4))
def test_whole_counts_of_a_steady_camera_are_no_jitter(seed):
    """The median of whole counts jumps by one where their mean moves by a part of one."""
    random, light = np.random.default_rng(seed), 1 + 0.2 * np.sin(np.arange(STATES))
    counts = np.full((SIDE, SIDE), 2000.0)
    counts[:2] = 20.5
    counts = counts * light[:, None, None] + 1.5 * random.normal(size=(STATES, SIDE, SIDE))
    assert black_jitter(steady_capture(np.rint(counts) / 4095, 1.5 / 4095), light[:, None]) is None


def in_counts(black, read_noise):
    """The same surface as whole counts of twelve bits, on a `black` (N,) level in counts."""
    counts = 4095 * capture(0.0, 0.0).signal[:, 0] + black[:, None, None]
    return np.rint(counts + read_noise * np.random.default_rng(4).normal(size=counts.shape)) / 4095


def test_a_drift_in_whole_counts_leaves_its_steps():
    """The drift is a fault and stays for the fit; the steps beside it belong to no cause."""
    drift = 8 * np.arange(STATES) / (STATES - 1)
    data = steady_capture(in_counts(np.rint(drift), 1.0), 1.0 / 4095)
    jitter = black_jitter(data, np.ones((STATES, 1)))
    assert jitter is not None
    steps = np.rint(drift) - 4095 * jitter[0]
    line = np.polyval(np.polyfit(drift, steps, 1), drift)
    assert np.std(steps - line) < np.std(np.rint(drift) - drift) / 2
    assert np.ptp(line) == pytest.approx(8, abs=0.5)
