"""Absolute scale: counts of a white plaque with a certificate turn a table into a BRDF in 1/sr."""

import os
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pytest

from processing.errors import ProcessError
from processing.geometry.frames import dot
from processing.geometry.viewing import ViewingGeometry
from processing.instrument.model import InstrumentModel
from processing.instrument.states import rotating_retarders
from processing.maps.white_reference import Certificate
from processing.reduction.mueller import reduce_mueller
from processing.reflectance import pbsdf
from processing.reflectance.tables import ScatteringTable
from processing.steps.table import Tabulation
from processing.storage.captures.capture import Capture
from processing.storage.formats.tensor_file import read_tensor_file
from processing.storage.products.product import Step

ANGLES = dict(rotating_retarders(1.0, 40, 9.0, 4.91).angles_deg)
#: Of the sphere, everywhere; of the plaque; relative standard uncertainty of the certificate.
BRDF, REFLECTANCE, U = 0.21, 0.98, 0.01
OMEGA = 45.0
#: Counts a second of a BRDF of 1/sr under light along the normal.
RESPONSE = 3e5
DETECTOR = {"gain_e_per_count": 1.0, "read_noise_e": 1.0, "black_level_counts": 0.0}


@dataclass
class Bench:
    """Sphere and plaque under one source; each capture has an exposure of its own."""

    capture: object
    folder: Path
    model: InstrumentModel
    sphere: Path

    def product(self, name: str, geometry: Path, brdf: float, exposure_s: float = 0.01, **header: object) -> Path:
        """Product of a diffuse surface that depolarizes all light."""
        header = {"omega_deg": OMEGA, "detector": DETECTOR} | header
        image = ViewingGeometry.load(geometry).at(OMEGA, 48, 48)
        cosine = image.fill(dot(image.points.normal, image.points.to_source))
        m00 = np.nan_to_num(brdf * RESPONSE * (0.01 if np.isnan(exposure_s) else exposure_s) * cosine)
        frames = self.model.rows(ANGLES)[:, :, 0][..., None, None] * m00
        path = self.capture(frames.astype(np.float32), ANGLES, name=f"{name}.h5", exposure_s=exposure_s, **header)
        with Capture(path) as capture:
            reduce_mueller(capture, self.model, self.folder / f"{name}.mueller.h5", (Step("test", {}),))
        return self.folder / f"{name}.mueller.h5"

    def plaque(self, normal_deg: float = OMEGA) -> Path:
        """Geometry of the plaque: light along its normal, seen at 45 degrees."""
        path = self.folder / f"plaque_{normal_deg:g}.yaml"
        text = self.sphere.read_text()
        start = text.index("shape:")
        shape = f"shape: {{kind: flat, width_mm: 12, height_mm: 12, normal_deg: {normal_deg}}}\n"
        path.write_text(text[:start] + shape)
        return path

    def certificate(self, nm: float = 662, ending: str = "yaml") -> Path:
        path = self.folder / f"certificate_{nm:g}.{ending}"
        u = REFLECTANCE * U
        text = f"incidence_deg: 0\nviewing_deg: 45\nreflectance: {{{nm:g}: {{value: {REFLECTANCE}, u: {u}}}}}\n"
        if ending == "csv":
            head = "wavelength_nm,reflectance,u,incidence_deg,viewing_deg"
            text = f"{head}\n{nm:g},{REFLECTANCE},{u},0,45\n"
        path.write_text(text)
        return path

    def table(self, sample: Path, white: Path, plaque: Path, certificate: Path, name: str = "t.h5") -> ScatteringTable:
        out = self.folder / name
        Tabulation((sample,), self.sphere, out, "renderer", (white, plaque, certificate)).make(overwrite=True)
        return ScatteringTable.load(out)


@pytest.fixture
def bench(synthetic_capture, tmp_path, configs, rgb950):
    return Bench(synthetic_capture, tmp_path, rgb950, configs / "geometries/one_inch_sphere.yaml")


@pytest.fixture
def white(bench):
    return bench.product("white", bench.plaque(), REFLECTANCE / np.pi, 0.004)


@pytest.mark.parametrize("ending", ["yaml", pytest.param("csv", marks=pytest.mark.long)])
def test_counts_of_other_exposures_become_a_brdf_with_the_error_of_the_certificate(bench, white, ending, tmp_path):
    sample = bench.product("sphere", bench.sphere, BRDF, 0.02)
    table = bench.table(sample, white, bench.plaque(), bench.certificate(ending=ending))
    assert table.units == "1/sr"
    assert table.mean[0] == pytest.approx(np.full(table.bins.size, BRDF), rel=1e-3)
    assert table.scale_u == pytest.approx(U, rel=0.02)
    assert table.uncertainties["u_systematic"][0] == pytest.approx(U * BRDF, rel=0.02)
    Tabulation((sample,), bench.sphere, tmp_path / "counts.h5", "renderer").make()
    counts = ScatteringTable.load(tmp_path / "counts.h5")
    relative = [t.uncertainties["u_noise"][0] / t.mean[0] for t in (table, counts)]
    assert relative[0] == pytest.approx(relative[1], rel=0.1)
    pbsdf.export([table], tmp_path / "m.pbsdf", pad_wavelengths=False)
    fields = read_tensor_file(tmp_path / "m.pbsdf")
    assert np.nanmedian(fields["M"][..., 0, 0, 0]) == pytest.approx(BRDF, rel=1e-3)
    assert fields["scale_u"] == pytest.approx([table.scale_u])
    with pytest.raises(ProcessError, match="has its scale already"):
        pbsdf.export([table], tmp_path / "n.pbsdf", white_m00=2.0)


def test_light_that_is_not_uniform_over_the_plaque_is_in_the_error_of_the_scale(bench, white):
    sample = bench.product("sphere", bench.sphere, BRDF)
    with h5py.File(white, "r+") as h5:
        h5["entry/data/mueller"][...] *= np.linspace(0.7, 1.3, 48).astype(np.float32)
    table = bench.table(sample, white, bench.plaque(), bench.certificate())
    assert table.scale_u > 1.3 * U


def test_what_has_no_scale_is_refused(bench, white):
    sample, plaque, certificate = bench.product("sphere", bench.sphere, BRDF), bench.plaque(), bench.certificate()
    gain = bench.product("gain", bench.sphere, BRDF, detector=DETECTOR | {"gain_e_per_count": 2.0})
    for message, arguments in {
        "is for 451 nm": (sample, white, plaque, bench.certificate(451)),
        "has incidence_deg 15.0": (sample, white, bench.plaque(30.0), certificate),
        "does not say its exposure": (bench.product("none", bench.sphere, BRDF, np.nan), white, plaque, certificate),
        "differ in: detector": (gain, white, plaque, certificate),
        "differ in: wavelength": (
            bench.product("nm", bench.sphere, BRDF, wavelength_nm=700),
            white,
            plaque,
            certificate,
        ),
    }.items():
        with pytest.raises(ProcessError, match=message):
            bench.table(*arguments)
    bench.table(sample, white, plaque, certificate)
    another = bench.product("another", bench.sphere, BRDF / 2)
    with pytest.raises(ProcessError, match="another absolute scale"):
        Tabulation((another,), bench.sphere, bench.folder / "t.h5", "renderer").append()


@pytest.mark.parametrize("reflectance", ["inf", "nan", "white"])
def test_a_certificate_has_finite_numbers(tmp_path, reflectance):
    path = tmp_path / "certificate.csv"
    path.write_text(f"wavelength_nm,reflectance,u,incidence_deg,viewing_deg\n662,{reflectance},0.01,0,45\n")
    with pytest.raises(ProcessError, match="cannot be read as a certificate"):
        Certificate.load(path)


def test_a_pipe_is_no_certificate(tmp_path):
    os.mkfifo(tmp_path / "certificate.csv")
    with pytest.raises(ProcessError, match="certificate"):
        Certificate.load(tmp_path / "certificate.csv")
