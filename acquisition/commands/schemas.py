"""JSON Schemas of every kind of YAML file, for editors that complete and check them.

`python -m acquisition.commands.schemas` writes them; a test fails while the committed ones are stale.
"""

import json
from functools import reduce
from operator import or_
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from acquisition.campaign.plan import Campaign
from acquisition.capture.plan import MeasurementPlan
from acquisition.commands.defaults import CONFIGS
from acquisition.rig.config import RigConfig
from processing.geometry.viewing import ViewingGeometry
from processing.instrument.model import InstrumentModel
from processing.maps.white_reference import Certificate
from processing.reflectance.base import kinds
from simulators.bench.scene import AnyScene

FOLDER = CONFIGS / "schemas"
MODELS: dict[str, Any] = {
    "rig": RigConfig,
    "plan": MeasurementPlan,
    "campaign": Campaign,
    "instrument": InstrumentModel,
    "geometry": ViewingGeometry,
    "scene": AnyScene,
    "certificate": Certificate,
    "material": reduce(or_, kinds().values()),
}


def text_of(name: str) -> str:
    """The schema as it is committed; models describe their keys, and `kind` means the same in all of them."""
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema"} | TypeAdapter(MODELS[name]).json_schema()
    for section in (schema, *schema.get("$defs", {}).values()):
        if "kind" in section.get("properties", {}):
            section["properties"]["kind"].setdefault("description", "which of the kinds this is")
    return json.dumps(schema, indent=1, sort_keys=True) + "\n"


def path_of(name: str) -> Path:
    """Where the schema is committed."""
    return FOLDER / f"{name}.schema.json"


def main() -> None:
    """Write all schemas."""
    FOLDER.mkdir(exist_ok=True)
    for name in MODELS:
        path_of(name).write_text(text_of(name), encoding="utf-8")


if __name__ == "__main__":
    main()
