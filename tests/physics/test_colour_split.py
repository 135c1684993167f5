"""A colour polarization sensor: every colour is a mosaic of its own, wherever the region begins."""

from pathlib import Path

import numpy as np
import pytest

from processing.diagnosis.captures.read_capture import read_capture
from processing.errors import ProcessError
from processing.instrument.model import InstrumentModel
from processing.reduction.mosaic.layout import MosaicLayout
from processing.steps.reduction import Reduction
from processing.storage.captures.capture import Capture, CaptureError
from processing.storage.captures.colour_split import split_colours

MOSAIC = np.array([["90", "45"], ["135", "0"]])
COLOURS = np.array([["red", "green"], ["green", "blue"]])
LEVEL = {"red": 1000, "green": 2000, "blue": 3000}
ANALYZER = {"0": 0, "45": 100, "90": 200, "135": 300}


def rolled(pattern: np.ndarray, top: int, left: int) -> tuple[tuple[str, ...], ...]:
    return tuple(map(tuple, np.roll(pattern, (-top, -left), axis=(0, 1))))


@pytest.mark.parametrize(("top", "left"), [(0, 0), (1, 3), (2, 1), (3, 0)])
def test_each_colour_has_its_four_analyzers(synthetic_capture, tmp_path: Path, top: int, left: int) -> None:
    r, c = np.mgrid[top : top + 18, left : left + 22]
    colour, analyzer = COLOURS[r // 2 % 2, c // 2 % 2], MOSAIC[r % 2, c % 2]
    frame = np.vectorize(LEVEL.get)(colour) + np.vectorize(ANALYZER.get)(analyzer)
    path = synthetic_capture(
        frame.astype(np.uint16)[None, None],
        {"psg": np.zeros(1)},
        mosaic=rolled(MOSAIC, top, left),
        colours=rolled(COLOURS.repeat(2, 0).repeat(2, 1), top, left),
        channels=("mosaic",),
    )
    parts, _ = split_colours(path, tmp_path / "parts")
    assert {p.suffixes[0][1:] for p in parts} == {"red", "green_a", "green_b", "blue"}
    for part in parts:
        name = part.suffixes[0][1:].partition("_")[0]
        with Capture(part) as capture:
            counts = capture.frames(0)[0]
            layout = MosaicLayout.of(capture.header.mosaic, list(ANALYZER))
            for k, analyzer_name in enumerate(ANALYZER):
                assert set(layout.samples(counts, k).ravel()) == {LEVEL[name] + ANALYZER[analyzer_name]}
            assert min(counts.shape) >= 6


def test_a_plain_bayer_sensor_is_split_pixel_by_pixel(synthetic_capture, tmp_path: Path) -> None:
    r, c = np.mgrid[1:9, 0:10]
    frame = np.vectorize(LEVEL.get)(COLOURS[r % 2, c % 2])
    path = synthetic_capture(frame.astype(np.uint16)[None, None], {"psg": np.zeros(1)}, colours=rolled(COLOURS, 1, 0))
    for part in split_colours(path, tmp_path / "parts")[0]:
        with Capture(part) as capture:
            assert set(capture.frames(0).ravel()) == {LEVEL[part.suffixes[0][1:].partition("_")[0]]}


def test_what_cannot_be_split_says_so(synthetic_capture, tmp_path: Path) -> None:
    plain = synthetic_capture(np.zeros((1, 1, 8, 8), np.uint16), {"psg": np.zeros(1)})
    with pytest.raises(ProcessError, match="no colour filter"):
        split_colours(plain, tmp_path)


def test_several_colours_are_refused_where_something_turns_too(synthetic_capture, configs: Path) -> None:
    file = configs / "instruments" / "mosaic_polarimeter.yaml"
    model = InstrumentModel.load(file)
    path = synthetic_capture(
        np.full((24, 1, 8, 8), 500, np.uint16),
        {"psg": 15.0 * np.arange(24)},
        mosaic=model.mosaic,
        colours=rolled(COLOURS.repeat(2, 0).repeat(2, 1), 0, 0),
        channels=("mosaic",),
        instrument_yaml=file.read_text(),
    )
    with pytest.raises(CaptureError, match="process colours"):
        Reduction(path).make()
    with Capture(path) as capture, pytest.raises(CaptureError, match="process colours"):
        read_capture(capture, model)
