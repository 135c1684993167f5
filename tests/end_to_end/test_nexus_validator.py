"""The validator of NeXus (pynxtools, which nobody here wrote) over every kind of file. `.ci/nexus` brings it."""

import logging
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from processing.calibration import mosaic, photon_transfer
from processing.geometry.rusinkiewicz import Angles
from processing.maps import extrapolation, xi0
from processing.reduction import stokes
from processing.reflectance.tables import ScatteringTable
from processing.steps.maps import Quantities, Xi0
from processing.steps.reduction import Reduction
from processing.storage.captures.packed_capture import pack_capture
from processing.storage.captures.schema import CaptureHeader, write_closing
from processing.storage.integrity.checksums import row_crc32, write_checksums
from processing.storage.products.product_writer import ProductWriter

STATES, SHAPE = 24, (6, 8)


@pytest.fixture
def complaints(caplog) -> Callable[[Path], list[str]]:
    """What `pynx validate --ignore-undocumented FILE` says of a file beside that it is valid."""
    reason = "pynxtools is not installed: .ci/nexus brings it and runs this"
    validator = pytest.importorskip("pynxtools.dataconverter.validate_file", reason=reason)

    def run(path: Path) -> list[str]:
        caplog.clear()
        with caplog.at_level(logging.INFO):
            validator.validate(str(path), ignore_undocumented=True)
        lines = [record.getMessage() for record in caplog.records if record.name.startswith("pynxtools")]
        valid = f"The entry `entry` in file `{path}` is valid according to the `NXoptical_spectroscopy` application"
        assert any(line.startswith(valid) for line in lines), lines
        return [line for line in lines if not line.startswith(valid)]

    return run


#: The definition has a list of experiments to which others may be added; ours says that it is added.
OURS = "The value 'polarimetry' at /entry/experiment_type does not match with the enumerated items"


def capture(synthetic_capture, configs: Path, name: str, **header: object) -> Path:
    psg = np.arange(STATES) * 7.5  # over one half turn, not commensurate with the analyzer
    frames = np.random.default_rng(3).integers(400, 3000, (STATES, 1, *SHAPE), dtype=np.uint16)
    path = synthetic_capture(
        frames,
        {"psg": psg, "psa": psg * 4.91, "arm": np.full(STATES, 35.0)},
        name=name,
        instrument_yaml=(configs / "instruments" / "drr_5to1.yaml").read_text(),
        detector={"gain_e_per_count": 2.5, "read_noise_e": 4.0, "bits": 12},
        **header,
    )
    with h5py.File(path, "r+") as h5:
        write_checksums(h5["entry"], row_crc32(frames))
    return Path(path)


def captures(synthetic_capture, configs: Path) -> list[Path]:
    """Complete, under way, compressed."""
    complete, partial, packed = (
        capture(synthetic_capture, configs, f"{name}.h5") for name in ("c", "partial", "packed")
    )
    with h5py.File(partial, "r+") as h5:
        h5["entry/states/done"][STATES // 2 :] = 0
        del h5["entry/closing"]
        write_closing(h5, "aborted", {})
    assert pack_capture(packed)
    return [complete, partial, packed]


def made_of(source: Path) -> list[Path]:
    """Mueller image, quantities, xi0."""
    mueller = Reduction(source).make()
    return [mueller, Quantities(mueller).make(), Xi0(mueller).make()]


def laid_out(folder: Path) -> list[Path]:
    """The other kinds, which need more than a few frames to be made of: what a validator sees is their layout."""
    kinds = {
        "stokes": stokes.PLANES,
        "xi0_of_stokes": xi0.STOKES_PLANES,
        "extrapolated": extrapolation.PLANES,
        "camera": photon_transfer.PLANES,
        "analyzers": mosaic.PLANES,
    }
    header = CaptureHeader(title="t", simulated=True, mode="stokes", wavelength_nm=662)
    paths = []
    for kind, planes in kinds.items():
        paths.append(folder / f"{kind}.h5")
        with ProductWriter(paths[-1], kind, header, SHAPE, planes=planes, steps=()) as writer:
            writer.array("curve", np.ones(3), "count", "a curve")
            writer.seal({})
    return paths


def table(path: Path) -> Path:
    bins = ScatteringTable(("xi0", "m00"), 662, simulated=True, has_noise=True, inputs=("analyzer.azimuth_deg",))
    bins.add(Angles(*np.random.default_rng(5).uniform(0, 0.5, (3, 400))), np.ones((6, 400)))
    bins.save(path)
    return path


def test_every_kind_of_file_is_valid(complaints, synthetic_capture, configs, tmp_path):
    files = captures(synthetic_capture, configs)
    files += [*made_of(files[0]), *laid_out(tmp_path), table(tmp_path / "table.h5")]
    assert len(files) == 12
    unexpected = [f"{path.name}: {line}" for path in files for line in complaints(path) if not line.startswith(OURS)]
    assert unexpected == []


def test_the_validator_sees_what_is_missing(complaints, tmp_path):
    """That the test above can fail."""
    path = table(tmp_path / "table.h5")
    with h5py.File(path, "r+") as h5:
        del h5["entry/experiment_type"]
    with pytest.raises(AssertionError, match="experiment_type"):
        complaints(path)
