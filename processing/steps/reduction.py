"""A capture to its Mueller or Stokes image."""

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from processing.calibration.photon_transfer import read_camera
from processing.errors import ProcessError
from processing.instrument.determined_basis import has_one_light
from processing.reduction.counts_to_signal import CountCorrection
from processing.reduction.exclusions import Exclusions
from processing.reduction.flat import flat_captures, nearest_flat
from processing.reduction.instrument_of_capture import choose_model
from processing.reduction.mueller import reduce_mueller
from processing.reduction.mueller_reduction import Choice
from processing.steps.file_step import FileStep, Progress, StepProduct
from processing.storage.captures.capture import Capture
from processing.storage.products.product import is_product
from processing.storage.products.provenance import Step, file_identity, made_of


@dataclass(frozen=True)
class Reduction(FileStep):
    """`process reduce`.

    Attributes
    ----------
    capture
        To be reduced.
    instrument
        File to use instead of the model in the capture.
    weighted, covariance, physical
        See `processing.reduction.mueller_reduction.Choice`; for a Mueller capture.
    camera
        Noise and bad pixels, a product of `process camera`.
    dark
        Other capture whose dark states are subtracted.
    flat
        Captures of the flat field, or folders of which the one that belongs to the capture is taken.
    leave_out
        Result of `diagnose --json`: states, struck intensities and bad pixels that it names are left out.
    demosaic, analyzers
        Method (None: the default) and analysis vectors of the pixels; for a mosaic capture.

    Examples
    --------
    >>> print(Reduction("sphere.h5", weighted=True).make("weighted.h5"))
    weighted.h5
    """

    capture: Path
    instrument: Path | None = None
    weighted: bool = False
    covariance: bool = False
    physical: str | None = None
    camera: Path | None = None
    dark: Path | None = None
    flat: tuple[Path, ...] = ()
    leave_out: Path | None = None
    demosaic: str | None = None
    analyzers: Path | None = None

    @property
    def kind(self) -> str:
        """Of the product: "mueller" or "stokes"."""
        with Capture(self.capture) as capture:
            return capture.reduces_to

    @property
    def usual_path(self) -> Path:
        """Beside the capture; an earlier version called the product of a turning plate `NAME.mueller.h5`."""
        with Capture(self.capture) as capture:
            kind = capture.reduces_to
            is_stokes = kind == "mueller" and has_one_light(choose_model(capture, self.instrument))
        path = self.capture.with_suffix(f".{kind}.h5")
        if not is_stokes or (path.is_file() and made_of(path) == self.record().made_of):
            return path
        return self.capture.with_suffix(".stokes.h5")

    def record(self) -> Step:
        """Options and contents; the capture's name is among the options, for effects of single captures go by it."""
        with Capture(self.capture) as capture:
            flats = [_flat_file(path, capture) for path in self.flat]
            kind, mosaic = capture.reduces_to, capture.header.mosaic is not None
        if kind == "stokes":
            self._refuse(
                ("weighted", "covariance", "physical"), "a mosaic capture; its product holds the covariance of S always"
            )
            from processing.reduction.stokes import DEFAULT_METHOD

            options: dict[str, Any] = {"demosaic": self.demosaic or DEFAULT_METHOD}
        else:
            self._refuse(
                ("demosaic", "analyzers"),
                "reduced super-pixel by super-pixel, for something turns before its mosaic"
                if mosaic
                else "not a mosaic capture",
            )
            options = {name: getattr(self, name) for name in ("weighted", "covariance", "physical")}
        named = ("capture", "instrument", "camera", "dark", "leave_out", "analyzers")
        files = [(role, getattr(self, role)) for role in named] + [("flat", path) for path in flats]
        inputs = tuple(file_identity(path, role) for role, path in files if path is not None)
        return Step("reduce", {"capture": self.capture.name} | options, inputs)

    def _refuse(self, options: tuple[str, ...], why: str) -> None:
        options_given = [f"--{name.replace('_', '-')}" for name in options if getattr(self, name)]
        if options_given:
            raise ProcessError(f"{' '.join(options_given)}: {self.capture} is {why}.")

    def _write(self, out: Path, record: Step, overwrite: bool, progress: Progress | None) -> None:
        flats = [Path(i["path"]) for i in record.inputs if i["role"] == "flat"]
        mueller = self.kind == "mueller"
        with ExitStack() as stack:

            def opened(path: Path) -> Capture:
                return stack.enter_context(Capture(path, by_super_pixel=mueller))

            capture = opened(self.capture)
            dark = opened(self.dark) if self.dark else None
            noise, bad = read_camera(self.camera) if self.camera else (None, None)
            left_out = Exclusions.read(self.leave_out, capture) if self.leave_out else Exclusions()
            # Images of a mosaic are averaged before they are solved: what was struck once is bad in the mean.
            lost = left_out.bad if mueller else left_out.bad_or_struck(capture.frame_shape)
            if lost is not None:
                bad = lost if bad is None else bad | lost
            correction = CountCorrection.of(capture, bad, dark, [opened(path) for path in flats])
            model = choose_model(capture, self.instrument)
            if mueller:
                choice = Choice(self.weighted, self.covariance, self.physical, noise)
                reduce_mueller(
                    capture,
                    model,
                    out,
                    (record,),
                    correction=correction,
                    choice=choice,
                    left_out=left_out,
                    overwrite=overwrite,
                    progress=progress,
                )
                return
            # Imported here: a Mueller capture needs none of it.
            from processing.reduction.mosaic.pixel_response import read_response
            from processing.reduction.stokes import reduce_stokes

            response = read_response(self.analyzers, capture.frame_shape) if self.analyzers else None
            method = record.arguments["demosaic"]
            reduce_stokes(
                capture,
                model,
                out,
                (record,),
                method=method,
                correction=correction,
                noise=noise,
                response=response,
                left_out=left_out,
                overwrite=overwrite,
                progress=progress,
            )


def reduce_or_open(source: Path, instrument: Path | None = None, progress: Progress | None = None) -> StepProduct:
    """A product as it is; for a capture its plain product, found or made.

    Raises ProcessError: an instrument file was given for a product.
    """
    if not is_product(source):
        return Reduction(source, instrument).found_or_made(progress=progress)
    if instrument is not None:
        raise ProcessError(f"{source} is reduced already; --instrument is for a capture. Leave it away.")
    return StepProduct(source, True)


def _flat_file(path: Path, capture: Capture) -> Path:
    """The flat capture itself, or the one of a folder that belongs to the capture."""
    if not path.is_dir():
        return path
    flat = nearest_flat(flat_captures(path), capture)
    if flat is None:
        raise ProcessError(
            f"{path} holds no flat field of the camera and wavelength of {capture.path.name}. "
            "Take one (plan key `role: flat`), or leave --flat away."
        )
    return flat
