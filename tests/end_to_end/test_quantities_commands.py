"""`process quantities`, `from-axostep`, `to-axostep` and raw AxoStep frames, from files to files."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from processing.instrument.model import InstrumentModel
from processing.instrument.states import rotating_retarders
from processing.polarization import mueller, quantities
from processing.polarization.cloude import coherency_eigenvalues
from processing.polarization.decompositions.lu_chipman import lu_chipman
from processing.polarization.triply_degenerate import mueller_matrix
from processing.storage.formats.axostep import read_mueller_file
from processing.storage.products.product import Product

ROWS, COLUMNS = 40, 60
Run = Callable[..., tuple[int, str, str]]


def truth() -> np.ndarray:
    """One matrix, a depolarized diattenuating retarder that is not triply degenerate, m00 = 1."""
    m0 = mueller.retarder(0.5, 1.1) @ mueller.diattenuator(0.9, 1.0, 0.4) / 0.7
    second = mueller.polarizer(1.2) * 2
    return 0.9 * mueller_matrix(m0, 0.7) + 0.1 * second


@pytest.fixture
def capture(synthetic_capture, configs: Path) -> Path:
    """Photon noise of gain 1 e/count on a uniform image; ten columns on the left see nothing."""
    instrument = configs / "instruments/rgb950.yaml"
    table = rotating_retarders(0.01)
    w = InstrumentModel.load(instrument).at(662).rows(table.angles_deg).reshape(40, 16)
    signal = 40_000 * (w @ truth().reshape(16))
    rng = np.random.default_rng(8)
    frames = rng.poisson(signal[:, None, None, None], size=(40, 1, ROWS, COLUMNS)).astype(float)
    frames += rng.normal(0, 3, frames.shape)
    frames[..., :10] = rng.normal(0, 3, (40, 1, ROWS, 10))
    return synthetic_capture(
        frames + 50,
        dict(table.angles_deg),
        instrument_yaml=instrument.read_text(),
        detector={"gain_e_per_count": 1.0, "read_noise_e": 3.0, "black_level_counts": 50.0},
    )


@pytest.mark.usefixtures("figures")
@pytest.mark.long
def test_all_maps_with_errors(process: Run, capture: Path, tmp_path: Path) -> None:
    out, figure = tmp_path / "q.h5", tmp_path / "q.png"
    options = ("--also", "symmetric", "--also", "differential", "--out", out, "--figure", figure)
    text = process.made("quantities", capture, *options)
    assert "SIMULATED" in text
    assert figure.stat().st_size > 20_000
    m = truth()
    vector = quantities.retardance_vector(lu_chipman(m).retarder)
    expected = {
        "depolarization_index": quantities.depolarization_index(m),
        "td_missed": quantities.td_missed(coherency_eigenvalues(m)),
        "diattenuation_linear": quantities.linear_magnitude(quantities.diattenuation_vector(m)),
        "polarizance_orientation_deg": np.rad2deg(quantities.orientation(quantities.polarizance_vector(m))),
        "retardance_deg": np.rad2deg(quantities.magnitude(vector)),
        "crossed_linear": quantities.between(m, "vertical", "horizontal"),
    }
    with Product(out) as product:
        assert product.kind == "quantities"
        assert [s.name for s in product.steps] == ["reduce", "quantities"]
        lit = product.get("lit") > 0
        np.testing.assert_array_equal(lit, np.arange(COLUMNS) >= 10 * np.ones((ROWS, 1)))
        for name, value in expected.items():
            pull = ((product.get(name) - value) / product.get(f"{name}_errors"))[lit]
            # The error of what follows from near eigenvalues has the noise between them, too.
            assert (0.7 if name == "td_missed" else 0.9) < pull.std() < 1.1, name
            assert pull.mean() == pytest.approx(0, abs=0.2), name
        xi = product.get("coherency_eigenvalues")
        np.testing.assert_allclose(xi.sum(axis=0)[lit], 1, atol=1e-5)
        assert product.get("dominant_mueller_jones").shape == (4, 4, ROWS, COLUMNS)
        median = product.facts["median_xi0"]
        for name in ("lu_chipman_defined", "symmetric_defined", "differential_defined"):
            assert product.get(name)[lit].all(), name
        for name in ("symmetric_d1", "differential_retardance_deg"):
            assert np.isfinite(product.get(name)[lit]).all()
            # Elements of the depolarizer that noise may have exchanged have no error bar.
            assert np.isfinite(product.get(f"{name}_errors")[lit]).mean() > 0.75
    # One sample has one median of xi0.
    assert process("xi0", capture, "--out", tmp_path / "xi0.h5", "--no-figure")[0] == 0
    with Product(tmp_path / "xi0.h5") as product:
        assert product.facts["median_xi0"] == pytest.approx(median, abs=1e-6)


@pytest.mark.long
def test_pairs_and_refusals(process: Run, capture: Path, tmp_path: Path) -> None:
    out = tmp_path / "q.h5"
    process.made("quantities", capture, "--pair", "45,right", "--out", out, "--no-figure")
    with Product(out) as product:
        assert "45_to_right" in product.names
        assert "crossed_linear" in product.names
    assert process("quantities", capture, "--out", out)[0] == 2
    for option, value, message in [
        ("--pair", "up,down", "give GENERATOR,ANALYZER"),
        ("--also", "arrow", "unknown decomposition 'arrow'; there are: symmetric, differential"),
    ]:
        assert message in process.refused("quantities", capture, option, value, "--out", tmp_path / "r.h5")
    err = process.refused("quantities", out, "--out", tmp_path / "r.h5")
    assert "holds a quantities image; this needs: mueller" in err


@pytest.mark.long
def test_axostep_mueller_files(process: Run, capture: Path, tmp_path: Path) -> None:
    assert process("reduce", capture, "--no-figure")[0] == 0
    product = capture.with_suffix(".mueller.h5")
    text = process.made("to-axostep", product)
    file = Path(text.split()[-1])
    assert file.suffix == ".bmmi"
    with Product(product) as source:
        values = source.get("mueller")
    np.testing.assert_array_equal(read_mueller_file(file).mueller, values)
    back = tmp_path / "back.h5"
    text = process.made("from-axostep", file, "--omega-deg", "35", "--out", back)
    assert f"{COLUMNS} x {ROWS} pixels, 662 nm" in text
    with Product(back) as reader:
        np.testing.assert_array_equal(reader.get("mueller"), values)
        assert np.isnan(reader.get("mueller_errors")).all()
        assert reader.header.omega_deg == 35
    code, _, err = process("quantities", back, "--out", tmp_path / "q.h5", "--no-figure")
    assert code == 0, err
    assert "holds no standard errors" in err
    # The same again is unchanged; another file of that name is not replaced.
    assert process("to-axostep", product)[0] == 0
    file.write_bytes(b"of somebody else")
    assert "exists" in process.refused("to-axostep", product)
    assert "expected a .cmmi or .bmmi file" in process.refused("from-axostep", product)


def test_raw_axostep_frames_are_imported_without_the_closing_repeat(
    process: Run, configs: Path, tmp_path: Path
) -> None:
    frames = np.random.default_rng(0).integers(100, 60_000, size=(41, 6, 8)).astype(np.int32)
    words = np.concatenate([np.array([1, *frames.shape]), frames[:, ::-1].reshape(-1)])
    (tmp_path / "raw.rmmd").write_bytes(words.astype(">i4").tobytes())
    table = rotating_retarders(0.01)
    lines = ["state,psg_deg,psa_deg"]
    lines += [f"{k},{table.angles_deg['psg'][k]},{table.angles_deg['psa'][k]}" for k in range(40)]
    states = tmp_path / "states.csv"
    states.write_text("\n".join(lines))
    code, _, err = process(
        *("import", "--states", states, "--stack", tmp_path / "raw.rmmd", "--wavelength-nm", "662"),
        *("--instrument", configs / "instruments/rgb950.yaml", "--out", tmp_path / "c.h5"),
    )
    assert code == 0, err
    from processing.storage.captures.capture import Capture

    with Capture(tmp_path / "c.h5") as capture:
        for k in (0, 17, 39):
            np.testing.assert_array_equal(capture.frames(k)[0], frames[k])
        assert len(capture.role) == 40
    assert process("reduce", tmp_path / "c.h5")[0] == 0
