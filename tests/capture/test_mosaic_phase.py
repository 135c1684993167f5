"""Which filter stands before a pixel of a colour camera, without a polarization mosaic."""

from types import SimpleNamespace

import pytest

from acquisition.capture.mosaic_phase import colours_of, match_mosaic
from acquisition.errors import AcquisitionError
from drivers.camera import CameraSettings
from processing.instrument.model import InstrumentModel
from tests.conftest import ROOT


def colour_camera(order: str = "RG", **settings: object) -> SimpleNamespace:
    camera_settings = CameraSettings(offset_x=0, offset_y=0, width=20, height=16).model_copy(update=settings)
    return SimpleNamespace(
        settings=camera_settings,
        bins_like_with_like=False,
        describe=lambda: SimpleNamespace(colours=order, polarized=False),
    )


@pytest.fixture(scope="module")
def instrument() -> InstrumentModel:
    return InstrumentModel.load(ROOT / "configs/instruments/rgb950.yaml")


@pytest.mark.parametrize("offset", [(0, 0), (1, 0), (0, 1), (3, 5)])
def test_colours_follow_the_place_of_the_region(instrument, offset):
    x, y = offset
    camera = colour_camera(offset_x=x, offset_y=y)
    assert match_mosaic(instrument, camera) is instrument
    first = {(0, 0): "red", (1, 0): "green", (0, 1): "green", (1, 1): "blue"}[x % 2, y % 2]
    assert colours_of(instrument, camera)[0][0] == first


@pytest.mark.parametrize("order", ["RG", "GR", "GB", "BG"])
def test_the_format_says_in_which_order_the_colours_lie(instrument, order):
    # PFNC: the two letters are the first row; red and blue lie on one diagonal, green on the other.
    (a, b), (c, d) = (
        tuple(colour[0].upper() for colour in row) for row in colours_of(instrument, colour_camera(order))
    )
    assert a + b == order
    assert {a + d, b + c} in ({"RB", "GG"}, {"BR", "GG"})


@pytest.mark.parametrize("setting", [{"reverse_x": True}, {"decimation": 2}, {"binning": 2}, {"offset_x": None}])
def test_what_hides_the_colour_of_a_pixel_is_refused(instrument, setting):
    with pytest.raises(AcquisitionError, match=r"filter|mirrors"):
        match_mosaic(instrument, colour_camera(**setting))


@pytest.mark.parametrize(
    ("analyzers", "declared", "wrong"),
    [
        ((("90", "45"), ("135", "0")), (("90", "45"), ("135", "0")), False),
        (None, (("0", "45"), ("135", "90")), False),
        ((("90", "45"), ("135", "0")), (("0", "45"), ("135", "90")), True),
        ((("90", "45"), ("135", "0")), (("90", "135"), ("45", "0")), True),
    ],
)
def test_analyzers_that_the_camera_names_are_those_of_the_instrument(analyzers, declared, wrong):
    camera = colour_camera()
    camera.describe = lambda: SimpleNamespace(colours="", analyzers=analyzers, pixel_format="by angle")
    stokes = InstrumentModel.load(ROOT / "configs/instruments/linear_stokes.yaml").model_copy(
        update={"mosaic": declared}
    )
    if wrong:
        with pytest.raises(AcquisitionError, match="identifies the analyzer of each count"):
            match_mosaic(stokes, camera)
    else:
        assert match_mosaic(stokes, camera).mosaic == declared


def test_a_polarization_sensor_is_no_plain_camera(instrument):
    camera = colour_camera()
    camera.describe = lambda: SimpleNamespace(colour=False, polarized=True, pixel_format="PolarizeMono8")
    with pytest.raises(AcquisitionError, match="PolarizeMono8 is that of a polarization sensor"):
        match_mosaic(instrument, camera)
