"""The simulated rig's file with other values, written where a benchmark works."""

from collections.abc import Mapping
from pathlib import Path

from ruamel.yaml import YAML

DEFAULT = Path(__file__).resolve().parents[2] / "configs" / "rigs" / "simulated.yaml"


def write_rig(path: Path, simulator: Mapping[str, object], **top: object) -> Path:
    """Write the file with these entries of its `simulator` section, and of its top level; its paths become absolute."""
    yaml = YAML()
    rig = yaml.load(DEFAULT)
    rig.update(top)
    for mode in rig["modes"].values():
        mode["instrument"] = str((DEFAULT.parent / mode["instrument"]).resolve())
    samples = {name: str((DEFAULT.parent / file).resolve()) for name, file in rig["simulator"]["samples"].items()}
    rig["simulator"].update({"samples": samples, **simulator})
    with path.open("w") as file:
        yaml.dump(rig, file)
    return path
