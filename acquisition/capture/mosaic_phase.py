"""Which analyzer stands before the first pixel of a frame: the region's place on a polarization sensor decides."""

from acquisition.errors import AcquisitionError
from drivers.camera import Camera, CameraIdentity, CameraSettings
from processing.instrument.model import InstrumentModel

_COLOURS = {"R": "red", "G": "green", "B": "blue"}


def match_mosaic(instrument: InstrumentModel, camera: Camera) -> InstrumentModel:
    """The instrument with its mosaic as the camera's frames have it; the instrument file has that of the sensor.

    Raises AcquisitionError: the camera mirrors, bins or leaves out pixels, so which analyzer or colour filter a pixel
    has cannot be known, the frames hold parts of super-pixels, the camera names the analyzers otherwise than the
    instrument, or sends a mosaic that the instrument has not.
    """
    settings, identity = camera.settings, camera.describe()
    if instrument.mosaic is None and identity.polarized:
        raise AcquisitionError(
            f"pixel format {identity.pixel_format} is that of a polarization sensor, and the instrument file has no "
            "mosaic, as if its pixels saw through no polarizer. Lay the analyzers out as `mosaic` there (see "
            "mosaic_polarimeter.yaml), or use another camera for this mode"
        )
    if instrument.mosaic is None and not identity.colours:
        return instrument
    problem = _phase_problem(settings, camera.bins_like_with_like)
    if instrument.mosaic is not None:
        problem = problem or _size_problem(instrument.mosaic, settings) or _name_problem(instrument.mosaic, identity)
    if problem is not None:
        raise AcquisitionError(problem)
    if instrument.mosaic is None:
        return instrument
    rows, columns = len(instrument.mosaic), len(instrument.mosaic[0])
    top, left = settings.offset_y or 0, settings.offset_x or 0
    mosaic = tuple(
        tuple(instrument.mosaic[(top + r) % rows][(left + c) % columns] for c in range(columns)) for r in range(rows)
    )
    return instrument.model_copy(update={"mosaic": mosaic})


def colours_of(instrument: InstrumentModel, camera: Camera) -> tuple[tuple[str, ...], ...] | None:
    """Colour before each pixel of the camera's frames; None without a colour filter.

    On a polarization sensor each colour covers a whole super-pixel.
    """
    identity, settings = camera.describe(), camera.settings
    if not identity.colours:
        return None
    size = 1 if instrument.mosaic is None else 2
    rows, columns = 2 * size, 2 * size
    top, left = settings.offset_y or 0, settings.offset_x or 0
    # The second row holds green on the other diagonal, and the colour that is not in the first.
    second_row = {"RG": "GB", "GR": "BG", "GB": "RG", "BG": "GR"}[identity.colours]
    sensor = [[_COLOURS[letter] for letter in line] for line in (identity.colours, second_row)]
    return tuple(
        tuple(sensor[(top + r) % rows // size][(left + c) % columns // size] for c in range(columns))
        for r in range(rows)
    )


def _phase_problem(settings: CameraSettings, bins_like_with_like: bool) -> str | None:
    if settings.offset_x is None or settings.offset_y is None:
        return "the camera does not report the offset of its region, so the filter of each pixel is unknown"
    if settings.reverse_x or settings.reverse_y:
        return (
            "the camera mirrors its frames (ReverseX or ReverseY), and makers differ in where the mosaic then begins. "
            "Leave reverse_x and reverse_y off"
        )
    if (settings.decimation or 1) != 1:
        return f"decimation {settings.decimation} leaves out pixels of every kind of filter. Set it to 1"
    if (settings.binning or 1) != 1 and not bins_like_with_like:
        return (
            f"binning {settings.binning} adds up pixels behind different filters. Set it to 1; if the manual says "
            "that this camera bins only pixels of one kind, write `mosaic_binning: like_with_like` at the camera"
        )
    return None


def _size_problem(mosaic: tuple[tuple[str, ...], ...], settings: CameraSettings) -> str | None:
    rows, columns = len(mosaic), len(mosaic[0])
    if (settings.height or 0) % rows or (settings.width or 0) % columns:
        return (
            f"a region of {settings.width} x {settings.height} pixels holds no whole number of super-pixels of "
            f"{columns} x {rows}. Change width and height"
        )
    return None


def _name_problem(mosaic: tuple[tuple[str, ...], ...], who: CameraIdentity) -> str | None:
    # Such a format begins with a whole super-pixel wherever its region is.
    if who.analyzers is None or mosaic == who.analyzers:
        return None
    actual, declared = (" / ".join(" ".join(line) for line in layout) for layout in (who.analyzers, mosaic))
    return (
        f"pixel format {who.pixel_format} identifies the analyzer of each count, which makes super-pixels of {actual}; "
        f"the instrument file has {declared}. Write `mosaic: {[list(line) for line in who.analyzers]}` there and name "
        "the channels as the camera does, each with the azimuth that it has on your bench; or choose a raw format"
    )
