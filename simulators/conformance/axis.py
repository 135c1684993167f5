"""All requirements of an axis, in one class to inherit."""

from simulators.conformance.axis_faults import AxisFaults
from simulators.conformance.axis_noise import EmulatorNoise
from simulators.conformance.axis_promises import AxisPromises


class AxisConformance(AxisPromises, AxisFaults, EmulatorNoise):
    """Tests of any motion axis on its emulator; set `emulator` to the name under which it is served."""
