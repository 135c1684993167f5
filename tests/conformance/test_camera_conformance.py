"""The GenICam driver passes the conformance kit; what is its own is in the other files of this folder."""

from simulators.conformance import CameraConformance


class TestAravis(CameraConformance):
    kind = "aravis"
