"""A camera as another program left it: each setting is brought to where it does nothing, or the capture is refused."""

import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.camera import CameraSettings
from drivers.errors import SettingRefused
from simulators.camera.exposure import ExposureInfo
from tests.conformance.described_camera import DescribedCamera

STYLE = Path(__file__).parent / "descriptions" / "in_the_style_of_makers.xml"
SIZE = (64, 48)
LIGHT = CameraSettings(exposure_s=5e-3, pixel_format="Mono12p")
SEEN = ((np.arange(SIZE[0] * SIZE[1]) * 7) % 2000 + 100).astype(np.uint16).reshape(SIZE[::-1])


class Left(DescribedCamera):
    """Plays the description in the style of makers; `infos` are its exposures."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        super().__init__(folder, stack, STYLE.read_text(), SIZE, self._show)
        self.infos: list[ExposureInfo] = []

    def _show(self, info: ExposureInfo) -> NDArray[np.uint16]:
        self.infos.append(info)
        return SEEN


@pytest.fixture
def bench_camera(tmp_path: Path) -> Iterator[Left]:
    with ExitStack() as stack:
        yield Left(tmp_path, stack)


@pytest.mark.parametrize("access", ["RW", "RO", "only while TriggerMode is On"])
def test_the_bench_rests_until_a_delayed_exposure_has_ended(bench_camera: Left, access: str) -> None:
    old = "<Min>16</Min><Max>1000</Max></Float>"
    assert old in bench_camera.text
    bench_camera.text = bench_camera.text.replace(old, "<Min>16</Min><Max>1000000</Max></Float>")
    where, named = bench_camera.text.split('<FloatReg Name="TriggerDelayReg">')
    if access.startswith("only"):
        where = where.replace('e="TriggerDelay">', 'e="TriggerDelay"><pIsAvailable>TriggerModeReg</pIsAvailable>')
        access = "RW"
    bench_camera.text = where + '<FloatReg Name="TriggerDelayReg">' + named.replace("RW", access, 1)
    simulated = bench_camera.play()
    with simulated.nodes.assuming("TriggerSelector", "FrameStart"):
        simulated.leave("TriggerDelay", 150_000.0)
    camera = bench_camera.open()
    if access == "RO":
        with pytest.raises(SettingRefused, match="TriggerDelay is 150000"):
            camera.configure(LIGHT)
        return
    camera.configure(LIGHT)
    exposure = camera.trigger()
    exposure.wait_exposed()
    assert time.monotonic() >= simulated.triggered_s + 5e-3
    np.testing.assert_array_equal(exposure.frame().pixels, SEEN)
    assert float(camera.node_map()["TriggerDelay"]) == 16.0


def test_a_delay_that_is_wanted_is_waited_for(bench_camera: Left) -> None:
    bench_camera.text = bench_camera.text.replace(
        "<Min>16</Min><Max>1000</Max></Float>", "<Min>16</Min><Max>1000000</Max></Float>"
    )
    simulated = bench_camera.play()
    camera = bench_camera.open(features={"TriggerSelector": "FrameStart", "TriggerDelay": 150_000})
    camera.configure(LIGHT)
    exposure = camera.trigger()
    exposure.wait_exposed()
    assert time.monotonic() >= simulated.triggered_s + 0.155
    np.testing.assert_array_equal(exposure.frame().pixels, SEEN)


@pytest.mark.parametrize("raw", ["", "Raw"])
def test_a_delay_under_a_name_of_the_maker_is_waited_for_or_refused(bench_camera: Left, raw: str) -> None:
    name = f"FrameStartTriggerDelay{raw}"
    bench_camera.text = bench_camera.text.replace('"AcquisitionStatus"', '"OtherStatus"')
    bench_camera.add(name, f'<Integer Name="{name}">VALUE<Min>0</Min><Max>1000000</Max></Integer>')
    simulated = bench_camera.play()
    camera = bench_camera.open(features={name: 150_000})
    if raw:
        with pytest.raises(SettingRefused, match="a time by FrameStartTriggerDelayRaw: it counts in steps"):
            camera.configure(LIGHT)
        return
    camera.configure(LIGHT)
    exposure = camera.trigger()
    exposure.wait_exposed()
    assert time.monotonic() >= simulated.triggered_s + 0.155
    np.testing.assert_array_equal(exposure.frame().pixels, SEEN)


@pytest.mark.parametrize(
    ("name", "entries"),
    [
        ("BalanceWhiteAuto", ("Continuous", "Once", "Off")),
        ("TestPattern", ("Increment", "Off")),
        ("TestImageSelector", ("TestImage1", "Off")),
        ("SequencerMode", ("On", "Off")),
        ("EdgeFilter", ("Sharpen1", "Off")),
        ("BSL_contrast_mode", ("SCurve", "linear")),
        ("SequencerMode", ("SequencerOn", "SequencerOff")),
        ("AutoExposure", ("On", "Off")),
        ("LUTMode", ("Table", "Off")),
        ("ExposureAuto", ("Auto", "Manual")),
    ],
)
def test_a_mode_that_spoils_frames_is_off_or_the_capture_is_refused(
    bench_camera: Left, name: str, entries: tuple[str, ...]
) -> None:
    bench_camera.choice(name, *entries)
    bench_camera.play(**{name: entries[0]})
    camera = bench_camera.open()
    camera.configure(LIGHT)
    for frame in camera.capture(3):
        np.testing.assert_array_equal(frame.pixels, SEEN)
    assert {info.exposure_s for info in bench_camera.infos} == {5e-3}
    assert camera.node_map()[name] == entries[-1]


@pytest.mark.parametrize("off", ["Off", "Sensor"])
@pytest.mark.parametrize("name", ["BalanceWhiteAuto", "TestPattern", "SequencerMode"])
def test_one_that_cannot_be_set_is_named(bench_camera: Left, name: str, off: str) -> None:
    bench_camera.choice(name, "Other", off, access="RO" if off == "Off" else "RW")
    bench_camera.play(**{name: "Other"})
    reason = "could not be set to Off" if off == "Off" else "which of its values does nothing is not known"
    with pytest.raises(SettingRefused, match=f"{name} is Other,? and {reason}"):
        bench_camera.open().configure(LIGHT)


@pytest.mark.parametrize(("kind", "register", "low"), [("Integer", "IntReg", 0), ("Float", "FloatReg", 10)])
def test_a_gamma_in_percent_is_refused(bench_camera: Left, kind: str, register: str, low: int) -> None:
    node = f'<{kind} Name="Gamma">VALUE<Min>{low}</Min><Max>500</Max></{kind}>'
    bench_camera.add("Gamma", node, kind=register, length=4 if kind == "Integer" else 8)
    bench_camera.play(Gamma=45)
    with pytest.raises(SettingRefused, match="Gamma is 45, and which of its values does nothing"):
        bench_camera.open().configure(LIGHT)


@pytest.mark.parametrize(("unit", "taken"), [("ticks", False), ("lines", False), ("microseconds", True)])
def test_an_exposure_in_no_unit_of_time_is_refused(bench_camera: Left, unit: str, taken: bool) -> None:
    old = "<pMax>ExposureMost</pMax><Unit>us</Unit>"
    assert old in bench_camera.text
    bench_camera.text = bench_camera.text.replace(old, f"<pMax>ExposureMost</pMax><Unit>{unit}</Unit>")
    bench_camera.play()
    if taken:
        assert bench_camera.open().configure(LIGHT).exposure_s == 5e-3
        return
    with pytest.raises(SettingRefused, match=f"a time by ExposureTime: it counts in {unit}"):
        bench_camera.open().configure(LIGHT)


def test_the_first_region_is_the_image_and_the_others_are_off(bench_camera: Left) -> None:
    bench_camera.choice("RegionSelector", "Region0", "Region1")
    bench_camera.choice("RegionMode", "Off", "On", index='<pIndex Offset="8">RegionSelectorAt</pIndex>')
    simulated = bench_camera.play(RegionMode="On", RegionSelector="Region1")
    simulated.leave("RegionMode", "On")
    camera = bench_camera.open()
    camera.configure(LIGHT)
    assert camera.node_map()["RegionSelector"] == "Region0"
    assert camera.node_map()["RegionMode"] == "On"
    simulated.leave("RegionSelector", "Region1")
    assert camera.node_map()["RegionMode"] == "Off"


def test_a_binning_by_words_is_undone(bench_camera: Left) -> None:
    for axis in ("Horizontal", "Vertical"):
        bench_camera.text = bench_camera.text.replace(f'Name="Binning{axis}"', f'Name="Other{axis}"')
        bench_camera.text = bench_camera.text.replace(f"<pFeature>Binning{axis}</pFeature>", "")
        bench_camera.choice(f"Binning{axis}", "X1", "X2", "X4")
    bench_camera.play(BinningVertical="X4")
    camera = bench_camera.open()
    assert camera.configure(LIGHT).binning == 1
    assert camera.node_map()["BinningVertical"] == "X1"


def test_a_digital_shift_is_undone(bench_camera: Left) -> None:
    bench_camera.add("DigitalShift", '<Integer Name="DigitalShift">VALUE<Min>0</Min><Max>4</Max></Integer>')
    bench_camera.play(DigitalShift=2)
    camera = bench_camera.open()
    camera.configure(LIGHT)
    np.testing.assert_array_equal(camera.capture()[0].pixels, SEEN)


@pytest.mark.parametrize(("unit", "rig_unit"), [("x", None), ("", "factor"), ("dB", None), ("", "dB")])
def test_six_decibels_are_six_decibels_in_any_unit(bench_camera: Left, unit: str, rig_unit: str | None) -> None:
    low, high = ("0", "24") if "dB" in (unit, rig_unit) else ("1", "16")
    new = f"<Min>{low}</Min><Max>{high}</Max>" + (f"<Unit>{unit}</Unit>" if unit else "")
    bench_camera.text = bench_camera.text.replace("<Min>0</Min><Max>24</Max><Unit>dB</Unit>", new)
    simulated = bench_camera.play()
    back = bench_camera.open(gain_unit=rig_unit).configure(LIGHT.model_copy(update={"gain_db": 6.0}))
    assert back.gain_db == pytest.approx(6.0, abs=1e-3)
    assert simulated.value("Gain") == pytest.approx(6.0 if "dB" in (unit, rig_unit) else 1.9953, abs=1e-3)


def test_a_gain_without_a_unit_is_refused(bench_camera: Left) -> None:
    bench_camera.text = bench_camera.text.replace("<Unit>dB</Unit>", "")
    bench_camera.play()
    with pytest.raises(SettingRefused, match="gain_unit: factor"):
        bench_camera.open().configure(LIGHT.model_copy(update={"gain_db": 6.0}))


def test_the_frame_rate_is_lowered_for_an_exposure_that_it_limits(bench_camera: Left) -> None:
    # Lucid: 44.6 ms by default, 199.8 ms at 5 frames a second.
    bench_camera.flag("AcquisitionFrameRateEnable")
    bench_camera.add(
        "AcquisitionFrameRate",
        '<Float Name="AcquisitionFrameRate">VALUE<Min>0.5</Min><Max>22</Max><Unit>Hz</Unit></Float>',
        kind="FloatReg",
        length=8,
    )
    bench_camera.text = bench_camera.text.replace(
        "<pMax>ExposureMost</pMax><Unit>us</Unit></Float>",
        '<pMax>ExposureByRate</pMax><Unit>us</Unit></Float><SwissKnife Name="ExposureByRate"><pVariable Name="ON">'
        'AcquisitionFrameRateEnableAt</pVariable><pVariable Name="RATE">AcquisitionFrameRateAt</pVariable>'
        "<Formula>(ON=1)?(1000000/RATE-200):44600</Formula></SwissKnife>",
    )
    bench_camera.play(AcquisitionFrameRate=22.0)
    camera = bench_camera.open()
    assert camera.configure(LIGHT).exposure_s == 5e-3
    # In the midst of a capture, as a bracket does.
    for exposure_s in (0.2, 0.01, 0.25):
        back = camera.configure(LIGHT.model_copy(update={"exposure_s": exposure_s}))
        assert back.exposure_s == pytest.approx(exposure_s, rel=1e-3)
        camera.capture()
        assert bench_camera.infos[-1].exposure_s == pytest.approx(exposure_s, rel=1e-3)
    with pytest.raises(SettingRefused, match="its limits are"):
        camera.configure(LIGHT.model_copy(update={"exposure_s": 3.0}))


@pytest.mark.parametrize("choosable", [True, False])
def test_the_converter_has_the_bits_of_the_format_or_counts_end_where_it_ends(
    bench_camera: Left, choosable: bool
) -> None:
    bench_camera.choice("AdcBitDepth", "Bit8", "Bit10", "Bit12", access="RW" if choosable else "RO")
    bench_camera.play(AdcBitDepth="Bit10")
    camera = bench_camera.open()
    camera.configure(LIGHT)
    (frame,) = camera.capture()
    assert (camera.top_of_counts.step, camera.full_scale) == ((1, 4095) if choosable else (4, 4092))
    np.testing.assert_array_equal(frame.pixels, SEEN if choosable else SEEN // 4 * 4)


@pytest.mark.parametrize("loads", ["UserSetLoad", "UserSetSave"])
def test_a_feature_of_unknown_meaning_is_at_its_default_or_named(bench_camera: Left, loads: str) -> None:
    bench_camera.choice("UserSetSelector", "Default", "UserSet1")
    bench_camera.add(loads, f'<Command Name="{loads}">VALUE<CommandValue>1</CommandValue></Command>')
    bench_camera.choice("ShotMixing", "Plain", "Mixed")
    bench_camera.play(ShotMixing="Mixed", UserSetSelector="UserSet1")
    camera = bench_camera.open()
    camera.configure(LIGHT)
    if loads == "UserSetLoad":
        assert (camera.node_map()["ShotMixing"], camera.warnings()) == ("Plain", [])
    else:
        (text,) = camera.warnings()
        assert "no default settings" in text
        assert "ShotMixing" in text


def test_a_load_that_takes_its_time_is_waited_for(bench_camera: Left, monkeypatch: pytest.MonkeyPatch) -> None:
    bench_camera.choice("UserSetSelector", "Default")
    bench_camera.add("UserSetLoad", '<Command Name="UserSetLoad">VALUE<CommandValue>1</CommandValue></Command>')
    simulated = bench_camera.play()
    memory = simulated.memory
    monkeypatch.setattr(memory, "restore", lambda *args, **kept: load.append((args, kept)) or timer.start())
    load: list[tuple[tuple[object, ...], dict[str, object]]] = []
    restore = type(memory).restore
    timer = threading.Timer(0.5, lambda: restore(memory, *load[0][0], **load[0][1]))  # type: ignore[arg-type]
    camera = bench_camera.open()
    camera.configure(LIGHT)
    timer.join()
    settings = camera.node_map()
    assert (settings["PixelFormat"], settings["TriggerMode"], settings["ExposureTime"]) == ("Mono12p", "On", "5000")
    assert camera.warnings() == []


def test_a_load_that_changes_nothing_is_seen(bench_camera: Left) -> None:
    bench_camera.choice("UserSetSelector", "Default")
    bench_camera.add("UserSetLoad", '<Command Name="UserSetLoad">VALUE<CommandValue>1</CommandValue></Command>')
    bench_camera.choice("ShotMixing", "Plain", "Mixed")
    simulated = bench_camera.play(ShotMixing="Mixed")
    simulated.features.heard = lambda *_: []  # type: ignore[method-assign]
    camera = bench_camera.open()
    camera.configure(LIGHT)
    (text,) = camera.warnings()
    assert "changed nothing" in text
    assert "ShotMixing" in text


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("TriggerMode", "ExposureControl", "it has no TriggerMode"),
        ("FrameStart", "LineStart", "its TriggerSelector offers only AcquisitionStart, LineStart"),
    ],
)
def test_a_camera_that_no_trigger_makes_expose_is_named_so(bench_camera: Left, old: str, new: str, reason: str) -> None:
    bench_camera.text = bench_camera.text.replace(old, new)
    bench_camera.play()
    with pytest.raises(SettingRefused, match=f"one frame at each trigger: {reason}.*Use a camera") as caught:
        bench_camera.open().configure(LIGHT)
    assert "arv-tool" not in str(caught.value)
