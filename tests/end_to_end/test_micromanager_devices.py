"""A Micro-Manager core and its own acquisition engine, unmodified, drive the emulated rig."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("pymmcore_plus")
from pymmcore_plus.core import _mmcore_plus
from pymmcore_plus.experimental.unicore import UniMMCore
from useq import MDASequence

from acquisition.micromanager_devices import rig_in_core

ANGLES, BLACK_LEVEL = [0.0, 20.0, 45.0], 64


@pytest.fixture
def core(monkeypatch):
    monkeypatch.setattr(_mmcore_plus, "_instance", None)
    core = UniMMCore()
    yield core
    core.unloadAllDevices()


@pytest.fixture
def rig(core, small_rig):
    with rig_in_core(core, small_rig(top={"settle_s": 0.0}, rows=24, columns=32), home=True) as rig:
        yield rig


def test_an_axis_goes_where_the_core_sends_it_and_no_further_than_the_rig_lets_it(core, rig):
    core.setPosition("psg", 33.0)
    core.waitForDevice("psg")
    assert core.getPosition("psg") == pytest.approx(33.0, abs=0.01)
    with pytest.raises(Exception, match="arm"):
        core.setPosition("arm", 720.0)
    assert rig.axes["arm"].read_position().deg < 181


def test_the_light_is_on_for_a_frame_and_shut_afterwards(core, rig):
    core.setExposure(10.0)
    core.snapImage()
    lit = core.getImage().astype(float)
    assert lit.shape == (24, 32)
    assert lit.mean() > BLACK_LEVEL + 10
    assert rig.simulation.emulators["shutter"].light_at(662) == 0
    assert core.getExposure() == pytest.approx(10.0, rel=0.01)


def test_after_an_exposure_that_the_camera_refuses_it_takes_frames_with_the_one_before(core, rig):
    core.setExposure(10.0)
    with pytest.raises(Exception, match="ExposureTime"):
        core.setExposure(1e6)
    assert core.snap().shape == (24, 32)
    assert core.getExposure() == pytest.approx(10.0, rel=0.01)


def test_its_own_acquisition_engine_steps_a_rotator_and_takes_frames(core, rig):
    core.setFocusDevice("psg")
    taken = []
    core.mda.events.frameReady.connect(lambda frame, event: taken.append((event.z_pos, frame.copy())))
    sequence = MDASequence(z_plan={"absolute": ANGLES}, channels=[])
    core.mda.run(sequence)
    assert [angle for angle, _ in taken] == ANGLES
    frames = np.stack([frame for _, frame in taken]).astype(float)
    assert frames.shape == (3, 24, 32)
    # A plate that turns between polarizers modulates the light.
    assert np.ptp(frames.mean(axis=(1, 2))) > 0.02 * frames.mean()
