"""Any rig made of the kinds that there are takes a capture: rigs are generated from the kinds found by folder."""

from pathlib import Path

import numpy as np
import pytest

from processing.storage.captures.capture import Capture
from simulators.camera.pixel_stamp import read_stamp
from simulators.rig.controller_kinds import axis_configs, served_kinds
from simulators.serial.serve_options import ServeOptions
from tests.rig_files import write_rig

#: Rotators turn freely, where the controller can be without limits; the second pair is for those that always have some.
FREE = ((None, None), (-400.0, 2000.0))
ARM = ((-10.0, 200.0),)

AXES = ("psg", "psa", "arm")
PLAN = "kind: plan\nstates: {kind: rotating_retarders, states: 16, step_deg: 9, ratio: 4.91}\ndarks: 1\n"


def _kinds() -> list[str]:
    """Kinds of motion controllers, as `simulate serve` finds them."""
    entries = {kind: axis_configs(make(ServeOptions()), "none") for kind, make in served_kinds().items()}
    return [kind for kind, configs in entries.items() if configs and configs[0].unit == "deg"]


class RigMaker:
    """Puts a rig file together: emulated ports, and entries that open what stands at them."""

    def __init__(self, configs: Path, folder: Path) -> None:
        self.configs, self.folder = configs, folder
        self.axes: dict = {}
        self.simulator: dict = {"ports": {}, "axes": {}}

    def add(self, kind: str, names: tuple[str, ...]) -> None:
        """Axes on one line where the controller takes so many, else a port for each."""
        for limits in FREE if names != ("arm",) else ARM:
            try:
                emulator = served_kinds()[kind](ServeOptions(axes=len(names), limits_deg=limits))
            except ValueError:
                continue
            entries = axis_configs(emulator, "none")
            break
        else:
            entries = []
        if len(entries) < len(names):
            assert len(names) > 1
            for name in names:
                self.add(kind, (name,))
            return
        port = "_".join(names)
        self.simulator["ports"][port] = {
            "kind": kind,
            "axes": len(names),
            "speed_deg_s": 720,
            "acceleration_deg_s2": 20000,
            "limits_deg": list(limits),
        }
        for index, (name, entry) in enumerate(zip(names, entries, strict=True)):
            settings = entry.model_dump(exclude_defaults=True) | {"kind": entry.kind, "port": f"sim:{port}"}
            quick = {"poll_s": 0.005, "pause_before_move_s": 0.01}
            self.axes[name] = settings | {key: value for key, value in quick.items() if key in type(entry).model_fields}
            self.simulator["axes"][name] = {"port": port, "index": index}

    def write(self, source: dict | None) -> Path:
        """The rig file; without a source the plan must have no darks."""
        if source is not None and "port" in source:
            self.simulator["ports"]["source"] = {"kind": source["kind"]}
        top = {"axes": self.axes, "source": source, "settle_s": 0.001, "backlash_deg": {}, "interlocks": []}
        bench = {"rows": 32, "columns": 40, "flux_e_per_s": 8e5, "stamp": True}
        path = self.folder / "rig.yaml"
        return write_rig(self.configs, path, top | {"forbidden": []}, **bench, **self.simulator)


SHUTTER = {"kind": "sc10", "port": "sim:source"}
LEDS = {"kind": "dc4100", "port": "sim:source", "percent": {662: 80}}
MIXED = [
    ("LED driver", {"zaber": AXES}, LEDS),
    ("operator", {"apt-k10cr1": ("psg", "psa"), "esp301": ("arm",)}, {"kind": "manual", "wavelengths_nm": [662]}),
]


def _rigs_of_three() -> list[dict[str, tuple[str, ...]]]:
    """Rigs in which each kind moves an axis: three kinds a rig, the last with some of the first."""
    kinds = _kinds()
    return [
        {kind: (axis,) for kind, axis in zip((kinds + kinds)[first : first + 3], AXES, strict=True)}
        for first in range(0, len(kinds), 3)
    ]


RIGS = [pytest.param(parts, SHUTTER, id=" ".join(parts)) for parts in _rigs_of_three()]
# What shares a line is tested below, and that its axes move at once by the conformance kit.
RIGS += [
    pytest.param({kind: AXES}, SHUTTER, id=f"all {kind}", marks=pytest.mark.long)
    for kind in ("elliptec", "esp301", "smc100")
]
RIGS += [pytest.param(parts, source, id=name) for name, parts, source in MIXED]


@pytest.mark.parametrize(("parts", "source"), RIGS)
def test_any_rig_takes_a_capture(acquire, configs, tmp_path, parts, source):
    maker = RigMaker(configs, tmp_path)
    for kind, names in parts.items():
        maker.add(kind, names)
    plan = tmp_path / "plan.yaml"
    plan.write_text(PLAN)
    acquire.made("--omega", 35, "--plan", plan, "--rig", maker.write(source), "--out", tmp_path)
    with Capture(next(tmp_path.glob("*.h5"))) as capture:
        assert capture.status == "complete"
        for state in range(17):
            frame = capture.frames(state)[0]
            true = dict(zip(sorted(AXES), read_stamp(frame), strict=True))
            for axis in AXES:
                assert true[axis] == pytest.approx(capture.angles_deg[axis][state], abs=0.01)
        np.testing.assert_allclose(capture.angles_deg["psg"][1:], 9 * np.arange(16), atol=0.05)
        np.testing.assert_allclose(capture.angles_deg["arm"], 35, atol=0.05)
        # The first pixels are the stamp; the dark state shows the black level, the others the sample.
        assert abs(capture.frames(0)[0][8:].mean() - 64) < 1
        assert capture.frames(5)[0][8:].mean() > 80


def test_a_line_is_shared_by_all_three_axes(configs, tmp_path):
    shared = []
    for kind in _kinds():
        maker = RigMaker(configs, tmp_path)
        maker.add(kind, AXES)
        shared += [kind] * (len(maker.simulator["ports"]) == 1)
    assert {"zaber", "elliptec", "smc100", "esp301"} <= set(shared)
