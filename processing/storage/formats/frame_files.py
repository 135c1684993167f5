"""The doors for frames from elsewhere: pictures, and stacks in one file."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.doors import MOST_PIXELS, one_line, require_file, require_picture
from processing.errors import ProcessError
from processing.extras import needed
from processing.storage.formats.axostep import read_rmmd
from processing.storage.formats.foreign_arrays import ImportFailed, open_array, states_first
from processing.storage.integrity.h5_door import damage_as, read_npy

#: Kinds of pictures that may have several pages.
PAGED = (".tif", ".tiff")
LOSSY = (".jpg", ".jpeg")


def read_frame(file: Path, page: int | None = None) -> NDArray[Any]:
    """Raw grey values (rows, columns) of a PNG, TIFF or .npy file, or of one page of a TIFF. Raises ImportFailed."""
    if file.suffix.lower() != ".npy":
        return _read_picture(file, page)
    values = read_npy(file, ImportFailed)
    if values.ndim != 2 or not 0 < values.size <= MOST_PIXELS:
        raise ImportFailed(f"{file}: shape {values.shape}; a frame has rows and columns. Frames of all states: --stack")
    return values


def _read_picture(file: Path, page: int | None) -> NDArray[Any]:
    if file.suffix.lower() in LOSSY:
        raise ImportFailed(
            f"{file}: JPEG changes the grey values, and a gamma curve is usual in it: no polarization can be computed "
            "from them. Give the raw frames of the camera as PNG, TIFF or .npy"
        )
    pages = require_picture(file, ImportFailed)
    if page is None and pages > 1:
        raise ImportFailed(
            f"{file}: has {pages} pages, and one frame a state is needed. If each page is a state, add --stack '{file}'"
        )
    try:
        image = _pixels(file, page or 0)
    except ProcessError as error:
        raise ImportFailed(f"{file}: is neither grey of 8 or 16 bits nor of 32-bit floats, and {error}") from error
    except Exception as error:
        # Readers of thirty formats raise whatever they like.
        raise ImportFailed(f"{file}: is damaged ({one_line(error)})") from error
    if image.ndim == 3:
        grey = image[..., 0]
        colours = image[..., :3]
        if not np.array_equal(colours, np.broadcast_to(grey[..., None], colours.shape)):
            raise ImportFailed(f"{file}: is a colour image; frames are raw grey values of one channel")
        image = np.ascontiguousarray(grey)
    return image


def _pixels(file: Path, page: int) -> NDArray[Any]:
    """Values (rows, columns) or (rows, columns, colours) as they stand in the file."""
    from PIL import Image

    with Image.open(file) as picture:
        picture.seek(page)
        if picture.mode in ("L", "F") or picture.mode.startswith("I;16"):
            return np.asarray(picture)
        if picture.mode != "I" and ";16" not in str(picture.tile) and picture.format in ("PNG", "TIFF", "BMP"):
            return np.asarray(picture.convert("L" if picture.mode == "1" else "RGB"))
    # Pillow makes 8 bits of 16 of a colour, and forgets whether an integer had a sign.
    cv2 = needed("cv2", "fast")
    return np.asarray(cv2.imreadmulti(str(file), page, 1, flags=cv2.IMREAD_UNCHANGED)[1][0])


def open_stack(text: str, states: int | None, frame: tuple[int, int] | None = None) -> Any:
    """Frames of all states as something with shape, type and slices. Raises ImportFailed.

    Parameters
    ----------
    text : FILE.npy, FILE.rmmd, FILE.mat::NAME, or HDF5 as FILE::/path/to/dataset.
    frame : rows and columns of a frame, where they are known.
    """
    if text.lower().endswith(".rmmd"):
        with damage_as(ImportFailed, f"{text}: cannot be read"):
            require_file(Path(text), ImportFailed)
            frames = read_rmmd(Path(text))
            return frames.frames if states is None else frames.states(states)
    return states_first(open_array(text), states, frame)


def check_stack(text: str, stack: Any, states: int, channels: int) -> None:
    """Raise ImportFailed unless the stack has a frame for each state and channel, of a size that can be read."""
    shape = tuple(stack.shape)
    expected = f"({states}, rows, columns)" if channels == 1 else f"({states}, {channels}, rows, columns)"
    if len(shape) not in (3, 4) or shape[0] != states or (shape[1] if len(shape) == 4 else 1) != channels:
        raise ImportFailed(f"{text}: shape {shape}; the states file and the instrument ask for {expected}.")
    if stack.dtype.kind not in "uif":
        raise ImportFailed(f"{text}: holds {stack.dtype}; frames are integers or floating numbers.")
    if not 0 < shape[-2] * shape[-1] <= MOST_PIXELS:
        raise ImportFailed(f"{text}: frames of {shape[-2]} x {shape[-1]} pixels; 1 to {MOST_PIXELS:,} pixels are read")
