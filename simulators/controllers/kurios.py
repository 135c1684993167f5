"""Thorlabs KURIOS-VB1 before a white lamp: a wavelength and a band, answers without an echo, a prompt."""

import re

from drivers.sources.kurios import BLACK, READY, Config
from simulators.clock import FastClock
from simulators.serial.emulator import Emulator
from simulators.serial.line_collector import LineCollector
from simulators.serial.reply_faults import FaultSchedule
from simulators.serial.serve_options import ServeOptions

RANGE_NM = (420.0, 730.0)
# Half of the width that passes, by band.
HALF_BAND_NM = {2: 17.0, 4: 10.0, 8: 5.0}
_SETTING = re.compile(r"(OM|WL|BW)=(\d+(?:\.\d+)?)")


class KuriosEmulator(Emulator):
    """A filter that is black when it is switched on.

    Attributes
    ----------
    values : mode of output, wavelength in nm, band, status, temperature and features, by keyword.
    """

    foreign = b"SS=0\r>"

    def __init__(self, clock: FastClock, faults: FaultSchedule | None = None) -> None:
        super().__init__([], clock, faults)
        self.values: dict[str, float] = {"OM": 1, "WL": 550.0, "BW": BLACK, "ST": READY, "TP": 31.2, "OH": 271}
        self._lines = LineCollector(b"\r")

    def light_at(self, wavelength_nm: float) -> float:
        """1 inside the band around its wavelength, 0 outside and while it is black."""
        with self._lock:
            half_nm = HALF_BAND_NM.get(int(self.values["BW"]), -1.0)
            return float(abs(self.values["WL"] - wavelength_nm) <= half_nm)

    def _do_receive(self, data: bytes) -> None:
        for line in self._lines.lines(data):
            self._apply_faults()
            answer = self._answer(line.strip())
            self._reply((f"{answer}\r" if answer else "").encode() + b">")

    def _answer(self, text: str) -> str:
        if text.lower() == "*idn?":
            return "THORLABS KURIOS-VB1 SN-00001234 HW1.0 FW2.1 CN-00005678"
        if text == "SP?":
            return f"WLmax={RANGE_NM[1]:.3f}\rWLmin={RANGE_NM[0]:.3f}"
        if text.endswith("?") and text[:-1] in self.values:
            value = self.values[text[:-1]]
            return f"{text[:-1]}={value:.3f}" if text in ("WL?", "TP?") else f"{text[:-1]}={value:g}"
        setting = _SETTING.fullmatch(text)
        if setting is None:
            return "CMD_NOT_DEFINED"
        name, value = setting[1], float(setting[2])
        allowed = (
            RANGE_NM[0] <= value <= RANGE_NM[1]
            if name == "WL"
            else value in {"OM": (1, 2, 3, 4, 5, 6)}.get(name, (BLACK, *HALF_BAND_NM))
        )
        if not allowed:
            return "CMD_ARG_INVALID"
        self.values[name] = value
        return ""


def make(options: ServeOptions) -> KuriosEmulator:
    """One filter, black."""
    return KuriosEmulator(options.clock, options.faults)


def source_configs(emulator: KuriosEmulator, port: str) -> list[Config]:
    """Rig entry for the filter."""
    return [Config(port=port, settle_s=0.0)]


SERVES = {"kurios": make}
