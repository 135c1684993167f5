"""First contact with a real rig: `./lab test -n 0 tests/hardware --rig my_rig.yaml`.

Home everything first, away from forbidden poses and with free way. Each axis moves one degree up and back. Nothing
homes; an axis without reference is skipped and says so.
"""

from collections.abc import Iterator
from pathlib import Path

import pytest

from acquisition.rig.config import load_rig
from acquisition.rig.open_rig import open_rig
from acquisition.rig.rig import Rig
from drivers.camera import CameraSettings

pytestmark = pytest.mark.hardware

STEP_DEG = 1.0


@pytest.fixture(scope="module")
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    path = request.config.getoption("--rig")
    if path is None:
        pytest.skip("no rig was named with --rig")
    with open_rig(load_rig(Path(path))) as live:
        yield live


def test_every_device_tells_who_it_is(rig: Rig) -> None:
    identities = [axis.describe() for axis in rig.axes.values()]
    assert len({(identity.port, identity.address) for identity in identities}) == len(identities)
    assert rig.camera is not None
    assert rig.camera.describe().model


def test_opening_moved_nothing(rig: Rig) -> None:
    assert not any(axis.is_moving() for axis in rig.axes.values())
    assert not any(axis.may_move_on_connect for axis in rig.axes.values())


def test_each_axis_goes_up_and_back(rig: Rig) -> None:
    unhomed = rig.unhomed()
    if unhomed:
        pytest.skip(f"without reference: {', '.join(unhomed)}. Home first: ./lab acquire home --rig FILE")
    for name, axis in rig.axes.items():
        start_deg = axis.read_position().deg
        top = axis.limits.max_deg
        step_deg = -STEP_DEG if top is not None and start_deg + STEP_DEG > top else STEP_DEG
        for target_deg in (start_deg + step_deg, start_deg):
            read_deg = rig.move({name: target_deg})[name].deg
            assert read_deg == pytest.approx(target_deg, abs=axis.config.tolerance_deg)


def test_the_camera_gives_whole_frames(rig: Rig) -> None:
    assert rig.camera is not None
    rig.camera.configure(CameraSettings(exposure_s=0.01))
    frames = rig.camera.capture(5)
    assert all(frame.complete for frame in frames)
    assert len({frame.frame_id for frame in frames}) == 5
    assert len({frame.pixels.shape for frame in frames}) == 1
