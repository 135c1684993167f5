"""What the package brings owes what umov's own owe: each class inherits the tests."""

from acquisition import CONFIGS
from simulators.conformance import (
    AxisConformance,
    CameraConformance,
    EffectConformance,
    ReflectanceConformance,
    SerialPortConformance,
    SharedLineConformance,
    SourceConformance,
)


class TestStage(AxisConformance, SharedLineConformance, SerialPortConformance):
    emulator = "sample_stage"


class TestCamera(CameraConformance):
    kind = "sample_camera"


class TestLamp(SourceConformance):
    emulator = "sample_lamp"


class TestHum(EffectConformance):
    effect = "sample_hum"
    instrument = CONFIGS / "instruments/rgb950.yaml"


class TestMirror(ReflectanceConformance):
    material = "{kind: sample_mirror, name: silver}"
