"""A region at an odd offset, and the border that campaigns leave out."""

import re
from pathlib import Path

import h5py
import numpy as np
import pytest

from processing.campaign import run as campaign
from processing.diagnosis.captures.read_capture import read_capture
from processing.instrument.model import InstrumentModel
from processing.maps import material_fit as material_fit_images
from processing.reduction.mosaic.demosaic import method_of
from processing.reduction.stokes import DEFAULT_METHOD, reduce_stokes
from processing.storage.captures.capture import Capture
from processing.storage.captures.schema import Detector
from processing.storage.products.product import Step

LEVEL = {"0": 400, "45": 800, "90": 1200, "135": 1600}


@pytest.mark.parametrize(("top", "left"), [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_the_diagnosis_reads_each_channel_behind_its_own_analyzer(
    synthetic_capture, configs: Path, top: int, left: int
) -> None:
    model = InstrumentModel.load(configs / "instruments" / "linear_stokes.yaml").at(662.0)
    sensor = np.array(model.mosaic)
    r, c = np.mgrid[top : top + 16, left : left + 20]
    frame = np.vectorize(LEVEL.get)(sensor[r % 2, c % 2])
    noise = np.random.default_rng(1).normal(0, 3, (4, 1, 16, 20))
    path = synthetic_capture(
        (frame + 64 + noise).astype(np.uint16),
        {"psg": np.zeros(4)},
        channels=("mosaic",),
        mosaic=tuple(map(tuple, np.roll(sensor, (-top, -left), axis=(0, 1)))),
        detector=Detector(black_level_counts=64, gain_e_per_count=2.6, read_noise_e=2.3, bits=12),
    )
    with Capture(path) as capture:
        data = read_capture(capture, model)
    means = data.signal.mean(axis=(0, 2, 3)) * (4095 - 64)
    np.testing.assert_allclose(means, [LEVEL[channel.name] for channel in model.channels], rtol=0.02)


def test_channels_may_have_any_names(synthetic_capture, configs: Path, tmp_path: Path) -> None:
    """The default method reads the azimuths of the analyzers from the elements of the instrument."""
    text = (configs / "instruments" / "linear_stokes.yaml").read_text()
    renamed = re.sub(r'"(0|45|90|135)"', r"pixel_\1", text)
    frames = np.random.default_rng(3).integers(500, 2000, (1, 1, 16, 20)).astype(np.uint16)
    images = []
    for k, instrument in enumerate((text, renamed)):
        file = tmp_path / f"{k}.yaml"
        file.write_text(instrument)
        model = InstrumentModel.load(file)
        path = synthetic_capture(
            frames,
            {"psg": np.zeros(1)},
            name=f"{k}.h5",
            channels=("mosaic",),
            mosaic=model.mosaic,
            detector=Detector(black_level_counts=64, gain_e_per_count=2.6, read_noise_e=2.3, bits=12),
        )
        out = tmp_path / f"{k}.stokes.h5"
        with Capture(path) as capture:
            reduce_stokes(capture, model.at(662.0), out, (Step("reduce", {}),), method="oriented")
        with h5py.File(out) as h5:
            images.append(h5["entry/data/s1"][:])
    np.testing.assert_array_equal(*images)


def test_campaigns_leave_out_what_demosaicing_mixes() -> None:
    assert campaign.BORDER_PX == material_fit_images.BORDER_PX == method_of(DEFAULT_METHOD).reach
