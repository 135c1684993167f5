"""Calibrate the camera with images of a ChArUco board (OpenCV): `process camera-pose`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.doors import require_picture
from processing.extras import needed
from processing.geometry.errors import GeometryError, OutlineNotFound
from processing.geometry.pinhole import PinholeCamera

cv2 = needed("cv2", "fast")
DICTIONARIES = ("DICT_4X4_50", "DICT_4X4_100", "DICT_5X5_100", "DICT_6X6_250")


@dataclass(frozen=True)
class Board:
    """A printed ChArUco board: number of squares, and sides of square and marker in mm."""

    columns: int
    rows: int
    square_mm: float
    marker_mm: float
    dictionary: str = "DICT_4X4_50"

    def opencv(self) -> Any:
        """The board as OpenCV knows it. Raises GeometryError for one that cannot be."""
        if self.dictionary not in DICTIONARIES:
            raise GeometryError(f"no marker dictionary {self.dictionary!r}; there are: {', '.join(DICTIONARIES)}")
        if not 0 < self.marker_mm < self.square_mm:
            raise GeometryError(f"markers of {self.marker_mm:g} mm do not fit into squares of {self.square_mm:g} mm")
        if min(self.columns, self.rows) < 3:
            raise GeometryError(
                f"a board of {self.columns} x {self.rows} squares has too few corners; use 3 x 3 or more"
            )
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square_mm, self.marker_mm, markers)


@dataclass(frozen=True)
class CameraCalibration:
    """A calibrated camera, the reprojection error and the images that were of use."""

    camera: PinholeCamera
    residual_px: float
    used: tuple[str, ...]
    skipped: tuple[str, ...]


def calibrate(
    images: Sequence[tuple[str, NDArray[np.uint8]]], board: Board, pixel_mm: float, at_centre: str | None = None
) -> CameraCalibration:
    """Focal length, optical axis and distortion from views of a board; distance from one of them.

    Parameters
    ----------
    images : (name, grey 8-bit image) of each view, all of one size; tilt the board between views.
    board : its squares.
    pixel_mm : pixel pitch of the sensor.
    at_centre : name of the view whose board stands in the centre of rotation; default, the first one used.
        The camera's distance is that of the board's plane along the optical axis.

    Raises
    ------
    OutlineNotFound
        Fewer than 4 views show at least 6 corners.
    GeometryError
        Images of different sizes, or `at_centre` names none that was used.
    """
    detector = cv2.aruco.CharucoDetector(board.opencv())
    sizes = {image.shape for _, image in images}
    if len(sizes) > 1:
        raise GeometryError(f"the images have different sizes: {sorted(sizes)}. Take all with one camera setting.")
    names, world, pixels, skipped = [], [], [], []
    for name, image in images:
        corners, ids, _, _ = detector.detectBoard(image)
        if ids is None or len(ids) < 6:
            skipped.append(name)
            continue
        points, where = board.opencv().matchImagePoints(corners, ids)
        names.append(name)
        world.append(points)
        pixels.append(where)
    if len(names) < 4:
        raise OutlineNotFound(
            f"{len(names)} of {len(images)} images show the board ({board.columns} x {board.rows} squares, "
            f"{board.dictionary}) with 6 corners or more; 4 are needed. Check the board's numbers, focus and light."
        )
    reference = at_centre if at_centre is not None else names[0]
    if reference not in names:
        raise GeometryError(f"{reference}: the board was not found in it, so it cannot give the distance")
    rows, columns = next(iter(sizes))
    # One focal length for both axes: square pixels.
    rms, matrix, distortion, rotations, shifts, errors, _, _ = cv2.calibrateCameraExtended(
        world, pixels, (columns, rows), np.eye(3), np.zeros(5), flags=0
    )
    k = names.index(reference)
    normal = cv2.Rodrigues(rotations[k])[0][:, 2]
    distance = float(normal @ shifts[k].reshape(3) / normal[2])
    focal = float((matrix[0, 0] + matrix[1, 1]) / 2)
    sigma = errors.reshape(-1)
    camera = PinholeCamera(
        rows=rows,
        columns=columns,
        pixel_mm=pixel_mm,
        focal_length_mm=focal * pixel_mm,
        distance_mm=abs(distance),
        centre_px=(float(matrix[1, 2]), float(matrix[0, 2])),
        distortion=tuple(float(d) for d in distortion.reshape(-1)[:5]),
        stderr={
            "focal_length_mm": float(np.hypot(sigma[0], sigma[1]) / 2 * pixel_mm),
            "centre_row_px": float(sigma[3]),
            "centre_column_px": float(sigma[2]),
        },
    )
    return CameraCalibration(camera, float(rms), tuple(names), tuple(skipped))


def read_grey(path: Path) -> NDArray[np.uint8]:
    """An image file as 8-bit grey. Raises GeometryError when it is none."""
    require_picture(path, GeometryError)
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise GeometryError(f"{path}: cannot be read as an image")
    return np.asarray(image, dtype=np.uint8)
