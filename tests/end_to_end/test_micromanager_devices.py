"""A Micro-Manager core and its own acquisition engine, unmodified, drive the emulated rig; its adapters make a rig."""

import os

import numpy as np
import pytest

pytest.importorskip("pymmcore_plus")
from pymmcore_plus.core import _mmcore_plus
from pymmcore_plus.experimental.unicore import UniMMCore
from useq import MDASequence

from acquisition import CONFIGS
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
    with rig_in_core(core, small_rig(rows=24, columns=32), home=True) as rig:
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
    events = []
    core.mda.events.frameReady.connect(lambda frame, event: events.append((event.z_pos, frame.copy())))
    sequence = MDASequence(z_plan={"absolute": ANGLES}, channels=[])
    core.mda.run(sequence)
    assert [angle for angle, _ in events] == ANGLES
    frames = np.stack([frame for _, frame in events]).astype(float)
    assert frames.shape == (3, 24, 32)
    # A plate that turns between polarizers modulates the light.
    assert np.ptp(frames.mean(axis=(1, 2))) > 0.02 * frames.mean()


BENCH = """
Property,Core,Initialize,0
Device,Generator,DemoCamera,DStage
Device,Analyzer,DemoCamera,DStage
Device,Camera,DemoCamera,DCam
Property,Core,Initialize,1
Property,Camera,PixelType,16bit
Property,Camera,BitDepth,12
Property,Camera,Mode,Noise
"""
STAGE = "kind: mmcore, configuration: bench.cfg, speed_deg_s: 100, units_per_deg: 0.5, assume_homed: true"
RIG = f"""
kind: rig
name: of Micro-Manager
axes:
  psg: {{device: Generator, {STAGE}}}
  psa: {{device: Analyzer, {STAGE}}}
camera: {{kind: mmcore, device: Camera, configuration: bench.cfg}}
source: {{kind: manual}}
detector: {{black_level_counts: 0, bits: 12}}
wavelengths_nm: [662]
modes: {{drr: {{instrument: {CONFIGS / "instruments" / "rgb950.yaml"}}}}}
"""


def test_adapters_of_micro_manager_are_the_axes_and_the_camera_of_a_rig(acquire, tmp_path, monkeypatch):
    if not os.environ.get("CI"):
        pytest.importorskip("mm_test_adapters")
    from mm_test_adapters import device_adapter_path

    monkeypatch.setattr(_mmcore_plus, "_instance", None)
    monkeypatch.setenv("MICROMANAGER_PATH", device_adapter_path())
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bench.cfg").write_text(BENCH)
    rig = tmp_path / "rig.yaml"
    rig.write_text(RIG)
    code, out, err = acquire("doctor", "--rig", rig, "--frames", 3)
    assert code == 0, out + err
    assert "axis psg  mmcore DemoCamera DStage" in out
    assert "DemoCamera DCam, serial V1.0, 512 x 512 16bit (12 bits)" in out
    assert "0 of 3 frames lost" in out
    code, out, err = acquire("move", "psg", -30, "--rig", rig)
    assert code == 0, out + err
    assert _mmcore_plus._instance.getPosition("Generator") == -15.0
    # The stage of the adapter ends at 300, and says so.
    code, out, err = acquire("move", "psa", 700, "--rig", rig)
    assert code != 0
    assert "psa" in err
