"""Two public captures of an imaging polarimeter at 630 nm: reduced, and its train fitted on a mirror."""

from pathlib import Path

import numpy as np
import pytest
import scipy.io

from processing.calibration.known_sample import part_of
from processing.calibration.train import fit_trains
from processing.instrument.model import InstrumentModel
from processing.reduction.mueller import reduce_mueller
from processing.storage.capture import Capture
from processing.storage.images import MuellerImage
from processing.storage.importing import ImportRequest, import_capture, read_sample
from processing.storage.product import Step

pytestmark = pytest.mark.measured

#: The file names hold rounded degrees (the data's README): the grid has steps of 22.5.
EXACT_DEG = {0: 0.0, 23: 22.5, 45: 45.0, 68: 67.5, 90: 90.0, 113: 112.5, 135: 135.0, 158: 157.5}
FREE = (
    "psg_retarder.retardance_deg",
    "psa_retarder.retardance_deg",
    "psg_retarder.azimuth_deg",
    "psa_retarder.azimuth_deg",
    "analyzer.azimuth_deg",
)


def states_csv(folder: Path, target: Path) -> Path:
    """states.csv from file names <a1>_<a2>_<a3>.png or <a2>_<a3>.png: analyzer (not rounded), PSG and PSA retarder."""
    lines = ["state,analyzer_deg,psg_deg,psa_deg,file"]
    for k, file in enumerate(sorted(folder.glob("*.png"))):
        *analyzer, psg, psa = (int(part) for part in file.stem.split("_"))
        lines.append(f"{k},{analyzer[0] if analyzer else 0},{EXACT_DEG[psg]},{EXACT_DEG[psa]},{file}")
    target.write_text("\n".join(lines), encoding="utf-8")
    return target


def imported(source: Path, target: Path, configs: Path, sample: str) -> Path:
    request = ImportRequest(
        states=states_csv(source, target.with_suffix(".csv")),
        out=target,
        wavelength_nm=630,
        instrument=configs / "instruments/drr_imaging_630nm.yaml",
        sample=read_sample(sample),
    )
    import_capture(request)
    return target


def test_smileys_are_almost_perfect_depolarizers(shared_data: Path, configs: Path, tmp_path: Path) -> None:
    path = imported(shared_data / "drr-imaging-630nm/Data/Smileys/630", tmp_path / "smileys.h5", configs, "unknown")
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


def test_mirror_gives_the_train(shared_data: Path, configs: Path, tmp_path: Path) -> None:
    source = shared_data / "drr-imaging-630nm"
    path = imported(source / "Data/Reflexion/630", tmp_path / "mirror.h5", configs, "mirror")
    model = InstrumentModel.load(configs / "instruments/drr_imaging_630nm.yaml").at(630)
    with Capture(path) as capture:
        assert len(capture.role) == 512
        result = fit_trains([part_of(capture, model, slice(150, 330), slice(150, 490))], FREE)[0]
    found = dict(zip(result.names, result.values, strict=True))
    assert found["psg_retarder.retardance_deg"] == pytest.approx(72.4, abs=0.1)
    assert found["psa_retarder.retardance_deg"] == pytest.approx(72.4, abs=0.1)
    assert result.residual_over_mean == pytest.approx(0.014, abs=0.0005)
    # The authors' own fit of the same frames: zeros are subtracted there, and modulo 90 degrees for a retarder.
    theirs = scipy.io.loadmat(str(source / "calibration_reflexion.mat"))
    for name, key, period in (
        ("analyzer.azimuth_deg", "theta_0_a", 180),
        ("psg_retarder.azimuth_deg", "alpha_0_g", 90),
        ("psa_retarder.azimuth_deg", "alpha_0_a", 90),
    ):
        difference = (found[name] + theirs[key].item() + period / 2) % period - period / 2
        assert abs(difference) < 0.2, name
    for name, end in (("psg", "g"), ("psa", "a")):
        k1, k2 = theirs[f"k_1_{end}"].item(), theirs[f"k_2_{end}"].item()
        expected = np.rad2deg(k1 / 630 + k2 / 630**3)
        assert found[f"{name}_retarder.retardance_deg"] == pytest.approx(expected, abs=0.3)
