"""The work of a campaign on one capture, as a function that can run in another process or on another machine."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from processing.computing.blas import one_blas_thread
from processing.geometry.errors import OutlineNotFound
from processing.geometry.frames import GeometryImage
from processing.geometry.outline import find_sphere, register_sphere
from processing.geometry.viewing import ViewingGeometry
from processing.maps.coherency_noise import coherency_noise, largest_deviation_by_noise
from processing.maps.tables import xi0_samples
from processing.maps.xi0 import estimate_from_stokes, moved_xi0, refit
from processing.polarization.cloude import coherency_eigenvalues, xi0_and_dominant
from processing.polarization.eigenvalue_noise import corrected
from processing.polarization.gradients import dominant
from processing.polarization.image_difference import linear_diattenuation, magnitude, orientation_difference, rmsd
from processing.polarization.quantities import deviation_from_td
from processing.reduction.systematic import Systematic
from processing.reflectance.base import load_reflectance
from processing.reflectance.tables import ScatteringTable
from processing.steps.maps import geometry_identities
from processing.steps.reduction import Reduction
from processing.storage.products.images import MuellerImage, StokesImage, neighbour_correlation, require_all_elements
from processing.storage.products.product import Product
from processing.storage.products.provenance import Step, file_identity

#: Standard error of the Mueller image's xi0 above which a pixel does not count: beyond it the largest eigenvalue is
#: noise's choice, and biased upwards.
MAX_STDERR = 0.1
#: Pixels whose noise in psi and |D| is worked out: gradients of m0 take 2 kB a pixel.
NOISE_PIXELS = 4000
#: Standard deviation of an orientation that may be anything from 0 to 180 degrees.
RANDOM_PSI_DEG = 180 / np.sqrt(12)


@dataclass(frozen=True)
class CaptureTask:
    """One capture and what belongs to it; plain text, so that it travels."""

    capture: str
    kind: str
    out: str
    geometry: str
    material: str
    border_px: int
    #: Geometry found in the images; empty: the one of the file.
    view_json: str = ""
    #: Capture of the flat field; empty: none.
    flat: str = ""
    #: Instrument file instead of the model in the capture; empty: that model.
    instrument: str = ""


@dataclass(frozen=True)
class CaptureMeasure:
    """Results of one capture. psi, |D| and the eigenvalues only from a Mueller capture."""

    kind: str
    wavelength_nm: float
    omega_deg: float
    shape: tuple[int, int]
    table: str
    pixels: int
    psi_deg: float = np.nan
    magnitude_percent: float = np.nan
    eigenvalue_deviation: float = np.nan
    #: What the noise alone makes of psi_deg and magnitude_percent.
    psi_noise_deg: float = np.nan
    magnitude_noise_percent: float = np.nan
    #: What the noise alone makes of the eigenvalues' deviation; taken off it.
    eigenvalue_noise: float = np.nan


@one_blas_thread()
def measure(task: CaptureTask) -> CaptureMeasure:
    """Reduce a capture, unless its product is there, and measure it."""
    product = reduced_product(task)
    view = task_view(task)
    return (_measure_mueller if task.kind == "mueller" else _measure_stokes)(task, product, view)


@one_blas_thread()
def locate(task: CaptureTask) -> tuple[float, str] | None:
    """Find the sphere in a capture's image: relative error of its radius and geometry as text; None if not found."""
    product = reduced_product(task)
    if task.kind == "mueller":
        intensity: NDArray[np.floating] = MuellerImage.load(product).values[0, 0]
    else:
        intensity = StokesImage.load(product).values[0]
    try:
        circle = find_sphere(intensity)
    except OutlineNotFound:
        return None
    view = register_sphere(task_view(task), circle, *intensity.shape)
    return circle.radius_stderr / circle.radius, view.model_dump_json()


def task_view(task: CaptureTask) -> ViewingGeometry:
    """The geometry that a task is to use."""
    if task.view_json:
        return ViewingGeometry.model_validate_json(task.view_json)
    return ViewingGeometry.load(task.geometry)


def reduced_product(task: CaptureTask) -> Path:
    """The product of a capture in the task's folder, found or made."""
    path = Path(task.capture)
    instrument = Path(task.instrument) if task.instrument else None
    reduction = Reduction(path, instrument, flat=(Path(task.flat),) if task.flat else ())
    return reduction.found_or_made(Path(task.out) / f"{path.stem}.{task.kind}.h5").path


def _measure_mueller(task: CaptureTask, product: Path, view: ViewingGeometry) -> CaptureMeasure:
    with Product(product) as opened:
        require_all_elements(opened)
        full, systematic = MuellerImage.of(opened), Systematic.of_product(opened)
    geometry = view.at(float(full.header.omega_deg or 0.0), *full.mask.shape)
    # The object alone, as rows of one pixel: what lies beside it costs as much.
    image = full.at(np.flatnonzero(geometry.mask))
    m = image.matrices[:, 0].astype(float)
    model = load_reflectance(task.material).mueller_jones(geometry.points, image.header.wavelength_nm)
    m0 = xi0_and_dominant(m)[1]
    noise, eigenvalues = coherency_noise(image), coherency_eigenvalues(m)
    result = corrected(np.asarray(eigenvalues[:, None], dtype=float), noise, image.covariance_of_depolarizer())
    xi0, stderr = result.xi0[:, 0], result.stderr[:, 0]
    # A limit on the noise: one on the outcome would keep upward fluctuations only.
    good = np.isfinite(xi0) & ~(noise.overall[:, 0] > MAX_STDERR) & _inner(geometry, task.border_px)
    measured, modelled = linear_diattenuation(m0), linear_diattenuation(model)
    psi = orientation_difference(modelled, measured)[good]
    chosen = np.flatnonzero(good)
    psi_noise, magnitude_noise = _noise_of_dominant(image, chosen)
    deviation = np.abs(deviation_from_td(eigenvalues)).max(axis=-1)[good]
    most = _most(deviation)
    moves = None if systematic is None else moved_xi0(systematic, image)[..., 0]
    by_noise = _most(largest_deviation_by_noise(image.at(chosen))) if chosen.size else float("nan")
    return CaptureMeasure(
        kind="mueller",
        wavelength_nm=image.header.wavelength_nm,
        omega_deg=float(image.header.omega_deg or 0.0),
        shape=(full.mask.shape[0], full.mask.shape[1]),
        table=_table(task, product, geometry, (xi0, stderr, good), systematic=systematic, moves=moves),
        psi_deg=float(np.rad2deg(rmsd(psi))),
        magnitude_percent=100 * rmsd((magnitude(modelled) - magnitude(measured))[good]),
        eigenvalue_deviation=float(np.sqrt(max(most**2 - by_noise**2, 0.0))),
        eigenvalue_noise=by_noise,
        pixels=int(good.sum()),
        psi_noise_deg=psi_noise,
        magnitude_noise_percent=100 * magnitude_noise,
    )


def _most(values: NDArray[np.floating]) -> float:
    finite = values[np.isfinite(values)]
    return float(np.percentile(finite, 99)) if finite.size else float("nan")


def _noise_of_dominant(image: MuellerImage, pixels: NDArray[np.int64]) -> tuple[float, float]:
    """Root mean square of the standard errors of psi (degrees) and |D| of the dominant process, over some pixels.

    First order; an orientation that is not known at all is off by RANDOM_PSI_DEG and not by more.
    """
    if not pixels.size:
        return float("nan"), float("nan")
    some = image.at(pixels[:: -(-pixels.size // NOISE_PIXELS)])
    derived = dominant(some.matrices.astype(float))
    stderr = []
    for name in ("dominant_diattenuation_orientation_deg", "dominant_diattenuation_linear"):
        stderr.append(np.sqrt(some.variance_of(derived[name].gradient)))
    return rmsd(np.minimum(stderr[0], RANDOM_PSI_DEG)), rmsd(stderr[1])


def _measure_stokes(task: CaptureTask, product: Path, view: ViewingGeometry) -> CaptureMeasure:
    image = StokesImage.load(product)
    with Product(product) as opened:
        systematic = Systematic.of_product(opened)
    header = image.header
    geometry = view.at(float(header.omega_deg or 0.0), *image.mask.shape)
    model = load_reflectance(task.material).mueller_jones(geometry.points, header.wavelength_nm)
    m0 = np.asarray(geometry.fill(model), dtype=float)
    result = estimate_from_stokes(image, m0)
    inside, moves = geometry.mask, None
    if systematic is not None:
        fitted = np.tensordot(image.analyzers, image.values.astype(float), axes=1)
        moves = refit(systematic, fitted, result.xi0, m0)[:, inside]
    xi0, stderr = result.xi0[inside], result.xi0_stderr[inside]
    good = result.valid[inside] & _inner(geometry, task.border_px)
    return CaptureMeasure(
        kind="stokes",
        wavelength_nm=header.wavelength_nm,
        omega_deg=float(header.omega_deg or 0.0),
        shape=(image.mask.shape[0], image.mask.shape[1]),
        table=_table(task, product, geometry, (xi0, stderr, good), systematic=systematic, moves=moves),
        pixels=int(good.sum()),
    )


def _inner(geometry: GeometryImage, border_px: int) -> NDArray[np.bool_]:
    # Pixels (N,) at least so far from the outline: nearer ones mix object and background, in a mosaic most of all.
    mask = geometry.mask
    if border_px > 0:
        mask = binary_erosion(mask, iterations=border_px)
    return np.asarray(mask[geometry.mask])


def _table(
    task: CaptureTask,
    product: Path,
    geometry: GeometryImage,
    samples: tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.bool_]],
    *,
    systematic: Systematic | None,
    moves: NDArray[np.floating] | None,
) -> str:
    # samples: xi0, its standard error, and which pixels count, all (N,); moves (D, N) by each direction.
    xi0, stderr, good = samples
    inputs = () if systematic is None else systematic.labels
    with Product(product) as opened:
        correlation, nm, simulated = neighbour_correlation(opened), opened.header.wavelength_nm, opened.simulated
    table = ScatteringTable(("xi0",), nm, simulated=simulated, has_noise=True, inputs=inputs)
    values = xi0_samples(table, geometry, xi0, np.where(good, stderr, np.nan), correlation=correlation)
    values = values if moves is None else np.concatenate([values, moves])
    values[:, ~good] = np.nan
    table.add(geometry.points.angles, values)
    material = file_identity(Path(task.material), "material")
    sources = (file_identity(product, "source"), *geometry_identities(Path(task.geometry)), material)
    # Named after the product, whose name is its own even where two folders hold captures of one name.
    path = product.with_name(f"{product.stem}.xi0.table.h5")
    table.save(path, (Step("campaign-xi0", {"border_px": task.border_px, "view": task.view_json}, sources),))
    return str(path)
