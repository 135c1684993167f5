"""A simulated rig for other programs: emulators at ports that any client can open, and a rig file that names them."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict
from ruamel.yaml import YAML

from processing.instrument.model import InstrumentModel
from processing.yaml_file import ConfigError, load_yaml
from simulators.rig.model import SCHEME, SimulatorConfig
from simulators.rig.rig import SimulatedRig

#: Longest wait for a reply where the rig file says nothing: on a busy machine the emulators, which are in another
#: program than the drivers, may be kept from running for seconds.
REPLY_S = 10.0


class _RigFile(BaseModel):
    # Only the section that concerns the simulator; the rest belongs to acquisition, which checks it.
    model_config = ConfigDict(frozen=True, extra="ignore")
    simulator: SimulatorConfig


@contextmanager
def serve(
    rig_file: Path, target: Path, sample: str, mode: str = "drr", *, wavelength_nm: float = 662, omega_deg: float = 35
) -> Iterator[SimulatedRig]:
    """Start the emulators of a rig file and write `target`, the same rig with device paths in place of `sim:` ports.

    Raises ConfigError: the file has no usable `simulator` section, or there is no such sample or mode.
    """
    config = load_yaml(rig_file, _RigFile).simulator.below(rig_file.resolve().parent)
    yaml = YAML()
    tree = yaml.load(rig_file)
    folder = rig_file.resolve().parent
    if mode not in tree["modes"]:
        raise ConfigError(f"{rig_file}: there is no mode {mode!r}")
    simulation = SimulatedRig(config)
    simulation.start()
    try:
        _fill_in(tree, simulation, folder)
        instrument = config.truth.get(mode) or Path(tree["modes"][mode]["instrument"])
        simulation.prepare(sample, InstrumentModel.load(instrument), wavelength_nm, omega_deg)
        with target.open("w") as file:
            yaml.dump(tree, file)
        yield simulation
    finally:
        simulation.stop()


def _fill_in(tree: Any, simulation: SimulatedRig, folder: Path) -> None:
    for name, entry in tree["axes"].items():
        simulation.connect(name, int(entry.get("direction", 1)), float(entry.get("zero_deg", 0.0)))
    for entry in (*tree["axes"].values(), tree.get("source")):
        if entry is not None and str(entry.get("port", "")).startswith(SCHEME):
            entry["port"] = simulation.port(str(entry["port"]).removeprefix(SCHEME))
            entry.setdefault("reply_s", REPLY_S)
    for mode in tree["modes"].values():
        mode["instrument"] = str(folder / mode["instrument"])
    tree["camera"]["device"] = simulation.camera_device()
    del tree["simulator"]
    tree["simulated"] = True
