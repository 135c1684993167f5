"""A capture of a test, reduced."""

from pathlib import Path

from processing.instrument.model import InstrumentModel
from processing.reduction.mueller import reduce_mueller
from processing.storage.captures.capture import Capture
from processing.storage.products.images import MuellerImage
from processing.storage.products.product import Step

STEP = Step("reduce", {"capture": "capture.h5"})


def reduced(path: Path, model: InstrumentModel, **options: object) -> MuellerImage:
    """The Mueller image of a capture, made beside it."""
    out = path.with_suffix(".product.h5")
    with Capture(path) as capture:
        reduce_mueller(capture, model, out, (STEP,), overwrite=True, **options)
    return MuellerImage.load(out)
