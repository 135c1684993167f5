"""The GenICam driver passes the conformance kit; what is its own is in the other files of this folder.

Once more on the features, steps, arming and formats of one camera of each maker; ``UMOV_EVERY_TABLE=1`` in the
environment takes every table.
"""

import os
from pathlib import Path

import pytest

from drivers.pixel_formats import pixel_format
from simulators.camera.gige_features import description
from simulators.camera.node_map import node_map, node_maps
from simulators.camera.played.played_camera import PlayedCamera
from simulators.conformance import CameraConformance
from simulators.conformance.camera import CameraTwin, GigeTwin, Show, pixel_source

ONE_OF_EACH = ["lucid_tri050s_p", "flir_bfs_pge_51s5p", "basler_aca2440_20gm"]
TABLES = [name for name in node_maps() if name != "loopback"] if os.environ.get("UMOV_EVERY_TABLE") else ONE_OF_EACH
# The simulated camera begins an exposure up to 10 ms after its trigger, and later on a busy machine: the exposure of a
# camera that does not tell when it exposes is taken to have ended before.
NEED_THE_END = ("test_every_frame_of_a_40_state_run_belongs_to_its_angle", "test_an_average_keeps_saturated")


def _skip_without_the_end(request: pytest.FixtureRequest) -> None:
    tells_the_end = "ExposureActive" in node_map(request.param).status
    if request.node.name.startswith(NEED_THE_END) and not tells_the_end:
        pytest.skip("this camera does not tell when an exposure has ended")


class TestAravis(CameraConformance):
    kind = "aravis"


class TestAravisOnTablesOfMakers(CameraConformance):
    kind = "aravis"

    @pytest.fixture(autouse=True, params=TABLES)
    def _of_a_maker(self, request: pytest.FixtureRequest) -> None:
        self._table = request.param
        _skip_without_the_end(request)

    def make_twin(self, show: Show) -> CameraTwin:
        return GigeTwin(show, self._table)


STYLE = Path(__file__).parent / "descriptions" / "in_the_style_of_makers.xml"


class PlayedTwin(GigeTwin):
    """A GigE Vision camera that plays a description, set to that pixel format."""

    def __init__(self, show: Show, path: Path, pixel_format: str) -> None:
        super().__init__(show)
        # It sends lost packets again, as a real camera does, and what the kit loses is to stay lost.
        self.entry |= {"settings": {"pixel_format": pixel_format}, "resend": False}
        self._camera = PlayedCamera("TWIN-1", *self.size, pixel_source(show), path=path, bits=self.bits)


class TestAravisOnPlayedDescriptions(CameraConformance):
    """On a description in the style of makers, and with `UMOV_EVERY_TABLE` on those of the tables."""

    kind = "aravis"

    @pytest.fixture(autouse=True, params=["style", *(TABLES if os.environ.get("UMOV_EVERY_TABLE") else ())])
    def _described(self, request: pytest.FixtureRequest, tmp_path: Path) -> None:
        self._path, self._pixel_format = STYLE, "Mono12p"
        if request.param != "style":
            _skip_without_the_end(request)
            table = node_map(request.param)
            self._pixel_format = next(name for name in table.pixel_formats if pixel_format(name).bits >= 12)
            self._path = tmp_path / "maker.xml"
            self._path.write_text(description(table, 128, 64))

    def make_twin(self, show: Show) -> CameraTwin:
        return PlayedTwin(show, self._path, self._pixel_format)
