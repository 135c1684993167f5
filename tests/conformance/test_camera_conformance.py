"""The GenICam driver passes the conformance kit; what is its own is in the other files of this folder.

Once more on the features, steps, arming and formats of one camera of each maker; ``UMOV_EVERY_TABLE=1`` in the
environment takes every table.
"""

import os

import pytest

from simulators.camera.node_map import node_map, node_maps
from simulators.conformance import CameraConformance
from simulators.conformance.camera import CameraTwin, GigeTwin, Show

ONE_OF_EACH = ["lucid_tri050s_p", "flir_bfs_pge_51s5p", "basler_aca2440_20gm"]
TABLES = [name for name in node_maps() if name != "loopback"] if os.environ.get("UMOV_EVERY_TABLE") else ONE_OF_EACH
# The simulated camera begins an exposure late on a busy machine: the exposure of a camera that does not tell when it
# exposes is taken to have ended before.
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
