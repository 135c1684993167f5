"""Descriptions of the simulated cameras, read by the reference implementation of GenApi (EMVA, package genicam)."""

import os
from pathlib import Path

import pytest

from simulators.camera.gige_features import description
from simulators.camera.node_map import node_map, node_maps

if not os.environ.get("CI"):
    pytest.importorskip("genicam", reason="EMVA's reference implementation is not installed")

DESCRIPTIONS = Path(__file__).parents[1] / "conformance" / "descriptions"
TEXTS = {name: description(node_map(name), 64, 48) for name in node_maps()}
TEXTS |= {path.name: path.read_text() for path in DESCRIPTIONS.glob("*.xml")}


@pytest.mark.third_party
@pytest.mark.parametrize("name", TEXTS)
def test_the_reference_implementation_reads_it(name: str) -> None:
    from genicam.genapi import NodeMap

    nodes = NodeMap()
    nodes.load_xml_from_string(TEXTS[name])
    features = {feature.node.name for feature in nodes.Root.features}
    assert {"Width", "PixelFormat", "TriggerMode", "PayloadSize"} <= features
