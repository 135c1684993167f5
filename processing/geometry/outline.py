"""Find a sphere in an image by its outline: centre and radius in pixels, with standard errors."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import binary_erosion, binary_fill_holes, label, map_coordinates, maximum_filter
from scipy.optimize import least_squares

from processing.arrays import Array
from processing.computing.filters import gaussian
from processing.geometry.errors import OutlineNotFound
from processing.geometry.sphere import Sphere
from processing.geometry.viewing import ViewingGeometry

#: Half length of the radial profile across the edge, in pixels.
REACH_PX = 6.0
#: Steepest slope across an edge, per pixel and relative to its height, that counts as the object's outline.
SHARPNESS = 0.3
#: Systematic part of the standard errors: shading towards the limb moves the steepest point inwards. On simulated
#: spheres it came to 0.4 pixels at omega 20 and to 0.2 or less from 35 on (docs/geometry.md).
LIMB_BIAS_PX = 0.35


@dataclass(frozen=True)
class Circle:
    """The outline of a sphere in an image; pixels, (row, column) of pixel centres, standard errors with systematics.

    `arc` is the fraction of the circle on which an edge was found: the lit part.
    """

    row: float
    column: float
    radius: float
    row_stderr: float
    column_stderr: float
    radius_stderr: float
    arc: float
    residual_px: float


def find_sphere(image: ArrayLike) -> Circle:
    """Outline of the one bright sphere before a darker background.

    The edge is where the intensity falls most steeply along a radius; only sharp edges count, so that the
    shadow's soft border plays no part.

    Parameters
    ----------
    image : (rows, columns), intensity; NaN counts as dark.

    Raises
    ------
    OutlineNotFound
        No bright object, an object cut by the frame, or no circle in its outline.
    """
    img = np.nan_to_num(np.asarray(image, dtype=np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    contour, inside = _bright_contour(img)
    smooth = gaussian(img, 1.0)
    start = _consensus(_sharp(contour, smooth), inside, np.random.default_rng(0))
    circle = start
    for _ in range(3):
        _check_frame(circle, img.shape)
        points = _edge_points(smooth, circle)
        if len(points) < 20:
            raise OutlineNotFound(
                f"only {len(points)} sharp edge points lie on the circle found at row {circle[0]:.1f}, "
                f"column {circle[1]:.1f}: this is no lit sphere before a dark background"
            )
        fit = least_squares(_distances, circle, args=(points,), loss="huber", f_scale=0.3)
        circle = fit.x
    residual = _distances(circle, points)
    inliers = np.abs(residual) < 5 * max(1.4826 * float(np.median(np.abs(residual))), 0.02)
    rms = float(np.sqrt(np.mean(residual[inliers] ** 2)))
    # Neighbouring edge points share pixels through the blur, about three of them each.
    jacobian = np.asarray(fit.jac)
    covariance = np.linalg.inv(jacobian.T @ jacobian) * rms**2 * 3
    errors = np.sqrt(np.diag(covariance) + LIMB_BIAS_PX**2)
    row, column, radius = (float(v) for v in circle)
    _check_frame(circle, img.shape)
    return Circle(
        row=row,
        column=column,
        radius=radius,
        row_stderr=float(errors[0]),
        column_stderr=float(errors[1]),
        radius_stderr=float(errors[2]),
        arc=len(points) / (2 * np.pi * radius),
        residual_px=rms,
    )


def register_sphere(view: ViewingGeometry, circle: Circle, rows: int, columns: int) -> ViewingGeometry:
    """The viewing geometry with centre and scale taken from the outline of its sphere, for images of that size.

    The sphere's radius and the camera's distance are trusted; the focal length follows from the outline.
    Raises OutlineNotFound when the shape is not a sphere.
    """
    if not isinstance(view.shape, Sphere):
        raise OutlineNotFound("only a sphere can be registered by a circle; refine the pose of a mesh instead")
    radius, distance = view.shape.radius_mm, view.camera.distance_mm
    camera = view.camera.resized(rows, columns)
    # Tangent cone of a sphere: its image has radius f R / sqrt(D^2 - R^2).
    focal_px = circle.radius * np.sqrt(distance**2 - radius**2) / radius
    camera = camera.model_copy(
        update={
            "focal_length_mm": focal_px * camera.pixel_mm,
            "centre_px": (circle.row, circle.column),
            "stderr": {
                "focal_length_mm": focal_px * camera.pixel_mm * circle.radius_stderr / circle.radius,
                "centre_row_px": circle.row_stderr,
                "centre_column_px": circle.column_stderr,
            },
        }
    )
    centred = view.shape.model_copy(update={"centre_mm": (0.0, 0.0, 0.0)})
    return view.model_copy(update={"camera": camera, "shape": centred})


def _check_frame(circle: Array, shape: tuple[int, ...]) -> None:
    row, column, radius = (float(v) for v in circle)
    reach = min(row - radius, column - radius, shape[0] - 1 - row - radius, shape[1] - 1 - column - radius)
    if reach < 0:
        raise OutlineNotFound(
            f"the sphere (centre row {row:.1f}, column {column:.1f}, radius {radius:.1f} pixels) reaches "
            f"{-reach:.1f} pixels out of the frame of {shape[0]} x {shape[1]}. Centre it or move back."
        )


def _bright_contour(img: Array) -> tuple[Array, NDArray[np.bool_]]:
    top = float(np.percentile(img, 99.5))
    if top <= 0 or not np.isfinite(top):
        raise OutlineNotFound("the image is dark everywhere: there is no sphere to find")
    grey = np.rint(gaussian(np.clip(img / top * 255, 0, 255), 1.5)).astype(np.uint8)
    labels, count = label(grey > _otsu(grey), np.ones((3, 3)))
    if not count:
        raise OutlineNotFound("the image has no bright object before a darker background")
    mask = labels == 1 + np.argmax(np.bincount(labels.reshape(-1))[1:])
    if mask.sum() < 100:
        raise OutlineNotFound(f"the largest bright object covers {int(mask.sum())} pixels, too few for an outline")
    filled = binary_fill_holes(mask)
    return np.argwhere(filled & ~binary_erosion(filled)).astype(float), mask


def _otsu(grey: NDArray[np.uint8]) -> int:
    """The grey value up to which pixels are dark: the two classes then differ most."""
    share = np.bincount(grey.reshape(-1), minlength=256) / grey.size
    dark, level = np.cumsum(share), np.cumsum(share * np.arange(256))
    with np.errstate(divide="ignore", invalid="ignore"):
        between = (level[-1] * dark - level) ** 2 / (dark * (1 - dark))
    return int(np.argmax(np.nan_to_num(between, nan=0.0, posinf=0.0)))


def _sharp(contour: Array, smooth: Array) -> Array:
    # The border of the shadow falls off over the whole radius, the limb within two pixels.
    slope = maximum_filter(np.hypot(*np.gradient(smooth)), 7)
    steepness = slope[contour[:, 0].astype(int), contour[:, 1].astype(int)]
    return np.asarray(contour[steepness > 0.3 * np.percentile(steepness, 95)])


def _consensus(contour: Array, mask: NDArray[np.bool_], rng: np.random.Generator) -> Array:
    # A circle through three points of the contour, best supported, that holds nearly all of the object.
    best, support = None, 0
    area = np.argwhere(mask)[:: max(1, int(mask.sum()) // 2000)]
    for _ in range(400):
        a, b, c = contour[rng.choice(len(contour), 3, replace=False)]
        m = 2 * np.array([b - a, c - a])
        if abs(np.linalg.det(m)) < 1e-6:
            continue
        centre = np.linalg.solve(m, [b @ b - a @ a, c @ c - a @ a])
        radius = float(np.linalg.norm(a - centre))
        if radius > max(mask.shape):
            continue
        votes = int(np.sum(np.abs(np.linalg.norm(contour - centre, axis=1) - radius) < 1.5))
        if votes > support and np.mean(np.linalg.norm(area - centre, axis=1) < radius + 2) > 0.98:
            best, support = np.array([*centre, radius]), votes
    if best is None or support < max(20, 0.2 * len(contour)):
        raise OutlineNotFound(
            "the outline of the bright object holds no circle: it is no sphere, or is cut by the frame"
        )
    return best


def _edge_points(img: Array, circle: Array) -> Array:
    row, column, radius = circle
    angle = np.linspace(0, 2 * np.pi, max(60, int(2 * np.pi * radius)), endpoint=False)
    offset = np.arange(-REACH_PX, REACH_PX + 0.125, 0.25)
    away = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    where = np.array([row, column]) + away[:, None, :] * (radius + offset)[None, :, None]
    profile = map_coordinates(img, np.moveaxis(where, -1, 0), order=1, mode="nearest")
    step = profile[:, offset <= -3].mean(axis=1) - profile[:, offset >= 3].mean(axis=1)
    noise = profile[:, offset >= 3].std(axis=1)
    slope = -np.gradient(profile, 0.25, axis=1)
    peak = np.clip(np.argmax(slope, axis=1), 1, offset.size - 2)
    n = np.arange(len(angle))
    before, at, after = slope[n, peak - 1], slope[n, peak], slope[n, peak + 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = offset[peak] + 0.25 * 0.5 * (before - after) / (before - 2 * at + after)
    # A step blurred by one pixel falls with 0.38 of its height a pixel; the border of the shadow is softer.
    sharp = (at > SHARPNESS * step) & (np.abs(crossing) < REACH_PX - 1)
    good = sharp & (step > 0.3 * np.percentile(step, 95)) & (step > 5 * noise)
    points: Array = np.array([row, column]) + away[good] * (radius + crossing[good])[:, None]
    inside = (points >= 0).all(axis=1) & (points <= np.array(img.shape) - 1).all(axis=1)
    return points[inside]


def _distances(circle: Array, points: Array) -> Array:
    return np.asarray(np.hypot(points[:, 0] - circle[0], points[:, 1] - circle[1]) - circle[2])
