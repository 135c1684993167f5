"""JSON Schemas of rig, plan, campaign and instrument files, for editors that complete and check YAML.

`python -m acquisition.commands.schemas` writes them; a test fails while the committed ones are stale.
"""

from __future__ import annotations

import json
from pathlib import Path

from pydantic import BaseModel

from acquisition.campaign.plan import Campaign
from acquisition.capture.plan import MeasurementPlan
from acquisition.commands.defaults import CONFIGS
from acquisition.rig.config import RigConfig
from processing.instrument.model import InstrumentModel

FOLDER = CONFIGS / "schemas"
MODELS: dict[str, type[BaseModel]] = {
    "rig": RigConfig,
    "plan": MeasurementPlan,
    "campaign": Campaign,
    "instrument": InstrumentModel,
}


def text_of(name: str) -> str:
    """The schema as it is committed."""
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema"} | MODELS[name].model_json_schema()
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
