"""What many tests of the physics start from."""

from pathlib import Path

import pytest

from processing.instrument.model import InstrumentModel


@pytest.fixture(scope="session")
def rgb950(configs: Path) -> InstrumentModel:
    """The RGB950 at 662 nm."""
    return InstrumentModel.load(configs / "instruments/rgb950.yaml").at(662)
