"""The conformance kit: requirements of every axis, camera, source, effect and reflectance model, as tests to inherit.

A package that brings one inherits the class in a test file of its own and names its kind; pytest does the rest:

    from simulators.conformance import AxisConformance

    class TestStage(AxisConformance):
        emulator = "sample_stage"

umov's own devices, effects and models pass the same classes. Needs pytest (`pip install umov[conformance]`).
"""

import pkgutil

import pytest

# Before they are imported: otherwise a failing `assert` shows no values.
pytest.register_assert_rewrite(*(f"{__name__}.{module.name}" for module in pkgutil.iter_modules(__path__)))

from simulators.conformance.axis import AxisConformance  # noqa: E402
from simulators.conformance.axis_lines import SerialPortConformance, SharedLineConformance  # noqa: E402
from simulators.conformance.camera import CameraConformance  # noqa: E402
from simulators.conformance.effect import EffectConformance, ReflectanceEffectConformance  # noqa: E402
from simulators.conformance.reflectance import ReflectanceConformance  # noqa: E402
from simulators.conformance.source import SourceConformance  # noqa: E402

__all__ = [
    "AxisConformance",
    "CameraConformance",
    "EffectConformance",
    "ReflectanceConformance",
    "ReflectanceEffectConformance",
    "SerialPortConformance",
    "SharedLineConformance",
    "SourceConformance",
]
