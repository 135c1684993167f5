"""Every loop that numba compiles has a form in numpy for an installation without it: both give the same numbers."""

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from random_matrices import random_mueller

from processing.geometry.mesh import Mesh
from processing.geometry.rusinkiewicz import Angles
from processing.polarization import magnitude, sorted_eigenvalues, vector_noise
from processing.polarization.cloude import cloude, coherency_eigenvalues, xi0_and_dominant
from processing.polarization.decompositions.lu_chipman import lu_chipman
from processing.polarization.mueller import IDEAL_DEPOLARIZER
from processing.polarization.xi0 import xi0_and_m00
from processing.reduction.mosaic.demosaic import demosaic
from processing.reduction.mosaic.fused import bilinear_stokes
from processing.reduction.mosaic.layout import MosaicLayout
from processing.reduction.solvers import weighted
from processing.reflectance.table_axes import TableAxes
from processing.reflectance.tables import ScatteringTable

N = 5000
RNG = np.random.default_rng(1)
MATRICES = random_mueller(N, seed=2, spread=3.0)
# Dark, ideal depolarizer, not finite, diattenuation above 1.
MATRICES[:3] = np.zeros((4, 4)), IDEAL_DEPOLARIZER, np.full((4, 4), np.nan)
MATRICES[3, 0, 1] = 2 * MATRICES[3, 0, 0]
FACTORS = RNG.normal(scale=0.02, size=(N, 16, 16))
COVARIANCE = FACTORS @ np.swapaxes(FACTORS, 1, 2)
SLOPES = RNG.normal(size=(3, N, 16))
VECTORS = RNG.normal(scale=0.3, size=(3, N))
NAMES, ANALYZERS = ("90", "45", "135", "0"), np.array([[1, -1, 0], [1, 0, 1], [1, 0, -1], [1, 1, 0]]) / 2
LAYOUT = MosaicLayout.of((("90", "45"), ("135", "0")), NAMES, ANALYZERS)
FRAME = (1000 + 900 * np.sin(np.hypot(*np.mgrid[1:150:162j, 7:177:170j]) / 4)).astype(np.float32)
ANGLES = Angles(*(RNG.uniform(*ends, N) for ends in ((0, 1.57), (0, 1.57), (-3.14, 3.14))))
ANGLES.phi_d[:5] = np.nan
FIRST, MODEL = np.array([0.5, 0.45, 0.5, 0.4]), RNG.uniform(0.2, 1, size=(4, N)).astype(np.float32)
FOUR = (RNG.uniform(0.2, 1, N) * MODEL + RNG.uniform(0.2, 1, N) * FIRST[:, None]).astype(np.float32)
SEEN, ALONG = RNG.permuted(np.linspace(0, 40, N)), np.geomspace(0.01, 100, N)


def intervals() -> magnitude.Interval:
    plane = 0.3 * ALONG**2, 0.7 * ALONG, 0.1 * ALONG**2
    return magnitude.interval(SEEN, ALONG, 3 * ALONG, 4 * ALONG**2, plane=plane, far=np.where(SEEN > 5, 1.1, 1.0))


def table() -> Any:
    entries = ScatteringTable(("a", "b", "c", "d", "e"), 600.0)
    values = np.random.default_rng(3).normal(size=(5, N))
    values[2, 5:9] = np.nan
    # Many samples a bin.
    entries.add(Angles(*(angle / 10 for angle in ANGLES)), values)
    entries.add(ANGLES, values)
    return entries.bins, entries.count, entries.mean, entries.variance


def solutions() -> Any:
    rows = np.random.default_rng(4).normal(size=(40, 16, N)).astype(np.float32)
    # Not determined.
    rows[:, 1, 0] = rows[:, 0, 0]
    normal = np.einsum("nkp,nkp->kp", rows[:, weighted.PACKED_ROW], rows[:, weighted.PACKED_COLUMN])
    solution, covariance = np.empty((16, N), np.float32), np.empty((weighted.PACKED, N), np.float32)
    weighted.solve_range(normal, rows[0], solution, covariance, 0, N)
    return solution, covariance


def hits() -> Any:
    mesh = Mesh(file=str(Path(__file__).parents[2] / "configs/scenes/bumpy_body.stl"), scale_mm=1.0)
    rays = np.moveaxis(np.mgrid[-0.1:0.1:60j, -0.1:0.1:60j, -1:0:1j], 0, -1).reshape(-1, 3)
    return mesh.intersect(np.array([0.0, 0.0, 200.0]), rays, 0.0)


CASES: dict[str, Callable[[], Any]] = {
    "polarization.coherency_kernels:dominant": lambda: xi0_and_dominant(MATRICES),
    "polarization.coherency_kernels:eigenvalues": lambda: coherency_eigenvalues(MATRICES),
    "polarization.coherency_kernels:eigensystem": lambda: cloude(MATRICES),
    "polarization.decompositions.lu_chipman:lu_chipman_range": lambda: lu_chipman(MATRICES),
    "polarization.vector_kernels:elements": lambda: vector_noise.of_elements(COVARIANCE[4:], MATRICES[4:], (1, 2, 3)),
    "polarization.vector_kernels:slopes": lambda: vector_noise.of_slopes(COVARIANCE, VECTORS, SLOPES),
    "polarization.magnitude:lengths": intervals,
    "polarization.sorted_eigenvalues:interpolate": lambda: sorted_eigenvalues.of_gaps(
        SEEN / 2, ALONG, np.ones((3, N)), 4.0
    ),
    "polarization.xi0:_four": lambda: xi0_and_m00(FOUR, MODEL, FIRST),
    "reflectance.table_axes:_bins": lambda: (TableAxes("degree").bins(ANGLES), TableAxes("renderer").bins(ANGLES)),
    "reflectance.tables:claim_rows": table,
    "reflectance.table_kernels:_accumulate": table,
    "reduction.solvers.weighted:solve_range": solutions,
    "reduction.mosaic.methods.oriented:_everywhere": lambda: demosaic(FRAME, LAYOUT, "oriented"),
    "reduction.mosaic.methods.oriented:_along_edges": lambda: demosaic(FRAME, LAYOUT, "oriented"),
    "reduction.mosaic.fused:_rows": lambda: bilinear_stokes(FRAME, LAYOUT, np.linalg.pinv(ANALYZERS)),
    "geometry.mesh_kernels:meet": hits,
}


@pytest.mark.parametrize("loop", CASES)
def test_numpy_gives_the_same(loop: str, monkeypatch: pytest.MonkeyPatch) -> None:
    module, name = import_module(f"processing.{loop.split(':')[0]}"), loop.split(":")[1]
    fast = CASES[loop]()
    monkeypatch.setattr(module, name, getattr(module, name).plain)
    slow = CASES[loop]()
    for a, b in zip(*((r if isinstance(r, tuple) else (r,)) for r in (fast, slow)), strict=True):
        assert a.dtype == b.dtype
        # Some loops count in single precision, in which the end of an interval can lose digits.
        largest = np.abs(a[np.isfinite(a)]).max()
        np.testing.assert_allclose(b, a, rtol=2e-4, atol=1e-6 * largest, err_msg=loop)
