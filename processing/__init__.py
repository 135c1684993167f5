"""Everything that needs no hardware: Mueller algebra, instrument models, reduction, diagnosis, reports.

The names below are the public interface; each is imported when it is first used.

    from glob import glob
    from processing import reduce_to_dataset

    image = reduce_to_dataset(max(glob("captures/*omega35.h5")))
    m = image.mueller / image.mueller.sel(row=0, column=0)
    print(m.median(["y", "x"]).values, image.mueller_errors.median(["y", "x"]).values)
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from processing.calibration.free_angles import free_design as free_design
    from processing.diagnosis.instrument.diagnose import diagnose_captures as diagnose_captures
    from processing.diagnosis.instrument_file import write_instrument as write_instrument
    from processing.errors import ProcessError as ProcessError
    from processing.geometry.viewing import ViewingGeometry as ViewingGeometry
    from processing.instrument.model import InstrumentModel as InstrumentModel
    from processing.instrument.states import StateTable as StateTable
    from processing.instrument.states import rotating_retarders as rotating_retarders
    from processing.labelled import follow_region as follow_region
    from processing.labelled import open_campaign as open_campaign
    from processing.labelled import open_dataset as open_dataset
    from processing.labelled import reduce_to_dataset as reduce_to_dataset
    from processing.labelled_file import write_dataset as write_dataset
    from processing.polarization.cloude import cloude as cloude
    from processing.polarization.cloude import xi0_and_dominant as xi0_and_dominant
    from processing.polarization.decompositions.lu_chipman import lu_chipman as lu_chipman
    from processing.reflectance.base import load_reflectance as load_reflectance
    from processing.steps.maps import Extrapolation as Extrapolation
    from processing.steps.maps import Quantities as Quantities
    from processing.steps.maps import Xi0 as Xi0
    from processing.steps.material import MaterialFitting as MaterialFitting
    from processing.steps.reduction import Reduction as Reduction
    from processing.steps.table import Tabulation as Tabulation
    from processing.storage.captures.capture import Capture as Capture
    from processing.storage.products.images import MuellerImage as MuellerImage
    from processing.storage.products.images import StokesImage as StokesImage
    from processing.storage.products.product import Product as Product

_PUBLIC = {
    "Capture": "processing.storage.captures.capture",
    "Product": "processing.storage.products.product",
    "MuellerImage": "processing.storage.products.images",
    "StokesImage": "processing.storage.products.images",
    "follow_region": "processing.labelled",
    "open_campaign": "processing.labelled",
    "open_dataset": "processing.labelled",
    "reduce_to_dataset": "processing.labelled",
    "write_dataset": "processing.labelled_file",
    "InstrumentModel": "processing.instrument.model",
    "StateTable": "processing.instrument.states",
    "rotating_retarders": "processing.instrument.states",
    "Reduction": "processing.steps.reduction",
    "Quantities": "processing.steps.maps",
    "Xi0": "processing.steps.maps",
    "Extrapolation": "processing.steps.maps",
    "Tabulation": "processing.steps.table",
    "MaterialFitting": "processing.steps.material",
    "diagnose_captures": "processing.diagnosis.instrument.diagnose",
    "write_instrument": "processing.diagnosis.instrument_file",
    "ViewingGeometry": "processing.geometry.viewing",
    "load_reflectance": "processing.reflectance.base",
    "free_design": "processing.calibration.free_angles",
    "cloude": "processing.polarization.cloude",
    "xi0_and_dominant": "processing.polarization.cloude",
    "lu_chipman": "processing.polarization.decompositions.lu_chipman",
    "ProcessError": "processing.errors",
}

__all__ = sorted(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'processing' has no public name {name!r}; it has: {', '.join(sorted(_PUBLIC))}")
    return getattr(import_module(_PUBLIC[name]), name)


def __dir__() -> list[str]:
    return __all__
