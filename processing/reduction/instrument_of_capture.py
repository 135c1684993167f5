"""The instrument model that a capture is reduced with, and whether its frames can be that instrument's."""

from pathlib import Path

from processing.instrument.model import InstrumentModel
from processing.storage.captures.capture import Capture, CaptureError


def choose_model(capture: Capture, instrument: Path | None) -> InstrumentModel:
    """The instrument model at the capture's wavelength: from a file, else the one in the capture.

    Raises CaptureError: there is none, or the capture is not of that instrument.
    """
    if instrument is None:
        if capture.instrument is None:
            raise CaptureError(f"{capture.path} holds no instrument model. Give one with --instrument FILE.")
        return capture.instrument
    model = InstrumentModel.load(instrument).at(capture.header.wavelength_nm)
    require_belongs(capture, model)
    return model


def require_belongs(capture: Capture, model: InstrumentModel) -> None:
    """Raise CaptureError where the capture's frames or axes are not those of the instrument."""
    mosaics = {True: "a polarization mosaic", False: "no polarization mosaic"}
    has, needs = capture.header.mosaic is not None, model.mosaic is not None
    if has != needs:
        difference = f"its camera has {mosaics[has]}, that of the instrument {model.name!r} {mosaics[needs]}"
    elif not has and capture.channels != len(model.channels):
        difference = (
            f"its frames have {_count_text(capture.channels)}, the instrument {model.name!r} has {len(model.channels)}"
        )
    elif missing := [axis for axis in model.axes if axis not in capture.angles_deg]:
        have = ", ".join(sorted(capture.angles_deg)) or "none"
        difference = f"instrument {model.name!r} turns {', '.join(missing)}, but the capture has angles of: {have}"
    elif fixed := [
        f"{axis} ({span:g} degrees)" for axis, span in capture.turned_deg().items() if axis not in model.axes
    ]:
        difference = f"its states turn {', '.join(fixed)}, but instrument {model.name!r} has no element on that axis"
    else:
        return
    raise CaptureError(f"{capture.path}: {difference}. Use the instrument file that belongs to the capture.")


def require_one_colour(capture: Capture) -> None:
    """Raise CaptureError for a mosaic below a colour filter: the mosaics of its colours lie side by side."""
    if capture.header.mosaic is not None and capture.header.colours is not None:
        raise CaptureError(
            f"{capture.path} is of a colour sensor: each colour is a mosaic of its own. "
            "Split it with `process colours`."
        )


def _count_text(channels: int) -> str:
    return "1 channel" if channels == 1 else f"{channels} channels"
