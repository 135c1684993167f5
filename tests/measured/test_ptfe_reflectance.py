"""How well first surface + polarized diffuse describes the dominant process of measured PTFE, a strong depolarizer.

Axes of the file, found here and in public documents: S1 is positive for s (Germer's SCATMECH), S3 for left circular
light, and the axes of the reflected beam are not its s and p but turned from them by its azimuth, so that nothing is
singular at the normal. The first test shows the turn; without it no model fits.
"""

import numpy as np
import pytest

from processing.polarization.cloude import xi0_and_dominant
from processing.reflectance import first_surface
from processing.reflectance.material_fit import fit_values
from tests.measured.ptfe import in_facet_axes

pytestmark = pytest.mark.measured

WAVELENGTHS_UM = (0.351, 0.532, 0.633, 1.064)


@pytest.fixture(scope="module")
def rows(public_files) -> np.ndarray:
    table = np.genfromtxt(public_files("ptfe-mueller-brdf")["PTFE.data.csv"], delimiter=",", skip_header=1)
    assert table.shape == (7296, 21)
    return table


def coupling(m: np.ndarray) -> float:
    """Root mean square of the elements that a mirror-symmetric surface lacks in the plane of scattering, on average."""
    return float(np.sqrt(np.mean(m[:, [0, 1, 2, 2], [2, 2, 0, 1]] ** 2)))


@pytest.mark.parametrize("wavelength_um", WAVELENGTHS_UM)
def test_axes_of_the_reflected_beam_are_turned_by_its_azimuth(rows, wavelength_um):
    as_found, other_way, not_at_all = (coupling(in_facet_axes(rows, wavelength_um, t)[1]) for t in (-1.0, 1.0, 0.0))
    assert as_found < 0.6 * not_at_all
    assert as_found < 0.5 * other_way


def explained(m: np.ndarray, model: np.ndarray) -> float:
    """Part of the squared polarized elements of M/m00 that the best multiple of the model's takes, all geometries."""
    polarized, shape = (x.reshape(-1, 16)[:, 1:] for x in (m, model))
    share = np.sum(polarized * shape, axis=1, keepdims=True) / np.sum(shape**2, axis=1, keepdims=True)
    residual = polarized - np.maximum(share, 0) * shape
    return float(1 - np.sum(residual**2) / np.sum(polarized**2))


#: On these data (docs/studies/reflectance.md): the dominant process of the pixel, the fitted model, and Fresnel
#: reflection at the refractive index of PTFE, 1.35.
FOUND = {
    0.351: (0.825, 0.616, 0.457),
    0.532: (0.932, 0.742, 0.510),
    0.633: (0.924, 0.718, 0.486),
    1.064: (0.880, 0.621, 0.408),
}


@pytest.mark.parametrize("wavelength_um", WAVELENGTHS_UM)
def test_how_much_of_the_polarized_light_the_model_takes(rows, wavelength_um):
    geometry, m = in_facet_axes(rows, wavelength_um)
    unit = np.tile(np.eye(16), (len(m), 1, 1))
    fit = fit_values(geometry, m.reshape(-1, 16).T, np.eye(16), unit, max_pixels=len(m), correlation=True)
    best = explained(m, fit.model("PTFE", 1000 * wavelength_um).mueller_jones(geometry, 1000 * wavelength_um))
    fraction = explained(m, xi0_and_dominant(m)[1])
    plain = first_surface.Model(name="PTFE", constants={633: first_surface.Constants(n=1.35)})
    fresnel = explained(m, plain.mueller_jones(geometry, 633))
    assert (fraction, best, fresnel) == pytest.approx(FOUND[wavelength_um], abs=0.01)
    assert best == pytest.approx(1 - fit.residual**2, abs=1e-6)
    # Towards n = 1 the ratio r_p/r_s becomes that of a dipole, cos(2 theta_d): volume scattering, no surface.
    assert fit.constants[0] == pytest.approx(1.01, abs=1e-3)
    assert not fit.identified["n"]
    assert not fit.identified["b"]
