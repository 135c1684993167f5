"""Two public captures of an imaging polarimeter at 630 nm: reduced, and its train fitted on a mirror."""

from pathlib import Path

import numpy as np
import pytest
import scipy.io

from processing.calibration.known_sample import part_of
from processing.calibration.train import fit_trains
from processing.instrument.model import InstrumentModel
from processing.public_data.conversion import tables_of
from processing.reduction.mueller import reduce_mueller
from processing.storage.captures.capture import Capture
from processing.storage.formats.import_request import ImportRequest, read_sample
from processing.storage.formats.importing import import_capture
from processing.storage.products.images import MuellerImage
from processing.storage.products.product import Step

pytestmark = pytest.mark.measured

FREE = (
    "psg_retarder.retardance_deg",
    "psa_retarder.retardance_deg",
    "psg_retarder.azimuth_deg",
    "psa_retarder.azimuth_deg",
    "analyzer.azimuth_deg",
)


def imported(files: dict[str, Path], name: str, target: Path, configs: Path) -> Path:
    """Capture of the frames "mirror" or "smileys"."""
    table = next(t for t in tables_of("drr-imaging-630nm", files) if t.name == name)
    request = ImportRequest(
        states=table.write(target.parent)[0],
        out=target,
        wavelength_nm=630,
        instrument=configs / "instruments/drr_imaging_630nm.yaml",
        sample=read_sample(table.sample),
    )
    import_capture(request)
    return target


def test_smileys_are_almost_perfect_depolarizers(public_files, configs: Path, tmp_path: Path) -> None:
    path = imported(public_files("drr-imaging-630nm"), "smileys", tmp_path / "smileys.h5", configs)
    with Capture(path) as capture:
        assert len(capture.role) == 64
        assert not capture.simulated
        assert capture.instrument is not None
        facts = reduce_mueller(capture, capture.instrument, tmp_path / "m.h5", (Step("reduce", {}),))
        counts = np.stack([capture.frames(k)[0] for k in range(64)])
    assert facts["median_residual_over_signal"] == pytest.approx(0.0053, abs=0.0003)
    image = MuellerImage.load(tmp_path / "m.h5")
    # The residual by the shortest other way: numpy's least squares on a few pixels.
    some = counts[:, 200:204, 300:310].reshape(64, -1).astype(float)
    solution = np.linalg.lstsq(image.w, some, rcond=None)[0]
    rms = np.sqrt(np.mean((some - image.w @ solution) ** 2, axis=0))
    np.testing.assert_allclose(image.residual_rms[200:204, 300:310].reshape(-1), rms, rtol=1e-3)
    normalized = image.values / image.values[0, 0]
    diagonal = [float(np.median(normalized[k, k])) for k in range(1, 4)]
    assert np.max(np.abs(diagonal)) < 0.1
    off = normalized.reshape(16, -1)[[1, 2, 3, 4, 6, 7, 8, 9, 11, 12, 13, 14]]
    assert np.max(np.abs(np.median(off, axis=1))) < 0.01


def test_mirror_gives_the_train(public_files, configs: Path, tmp_path: Path) -> None:
    files = public_files("drr-imaging-630nm")
    path = imported(files, "mirror", tmp_path / "mirror.h5", configs)
    model = InstrumentModel.load(configs / "instruments/drr_imaging_630nm.yaml").at(630)
    with Capture(path) as capture:
        assert len(capture.role) == 512
        result = fit_trains([part_of(capture, model, slice(150, 330), slice(150, 490))], FREE)[0]
    train = dict(zip(result.names, result.values, strict=True))
    assert train["psg_retarder.retardance_deg"] == pytest.approx(72.4, abs=0.1)
    assert train["psa_retarder.retardance_deg"] == pytest.approx(72.4, abs=0.1)
    assert result.residual_over_mean == pytest.approx(0.014, abs=0.0005)
    # The authors' own fit of the same frames: zeros are subtracted there, and modulo 90 degrees for a retarder.
    calibration = scipy.io.loadmat(str(files["calibration_reflexion.mat"]))
    for name, key, period in (
        ("analyzer.azimuth_deg", "theta_0_a", 180),
        ("psg_retarder.azimuth_deg", "alpha_0_g", 90),
        ("psa_retarder.azimuth_deg", "alpha_0_a", 90),
    ):
        difference = (train[name] + calibration[key].item() + period / 2) % period - period / 2
        assert abs(difference) < 0.2, name
    for name, end in (("psg", "g"), ("psa", "a")):
        k1, k2 = calibration[f"k_1_{end}"].item(), calibration[f"k_2_{end}"].item()
        expected = np.rad2deg(k1 / 630 + k2 / 630**3)
        assert train[f"{name}_retarder.retardance_deg"] == pytest.approx(expected, abs=0.3)
