"""umov: a Mueller polarimetry lab in one application.

The names of `processing` under the name of the program::

    import umov

    image = umov.reduce_to_dataset("capture.h5")
    stack = umov.open_campaign("captures")
"""

from typing import Any

import processing
from processing import __all__ as __all__


def __getattr__(name: str) -> Any:
    return getattr(processing, name)


def __dir__() -> list[str]:
    return __all__
