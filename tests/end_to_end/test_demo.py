"""`./lab demo`: the loop as one command; on twenty seeds with UMOV_SLOW=1."""

import hashlib
import os
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from acquisition.demo.truth import draw_faults, drawable
from acquisition.rig.config import load_rig
from processing.yaml_file import ConfigError

#: Of the figure in README.md and docs/demo.md.
PICTURED = 11
SEEDS = range(1, 21) if os.environ.get("UMOV_SLOW") else (PICTURED,)
#: Defects of the diagnosis that the demo has found (docs/studies/demo.md); remove a seed whose run passes.
KNOWN = {3: "two true faults cancel in M: the exact value of one alone makes M worse; the reported chance is 0.09"}
CASES = [
    pytest.param(k, marks=pytest.mark.xfail(reason=KNOWN[k], strict=True, raises=AssertionError) if k in KNOWN else ())
    for k in SEEDS
]


@pytest.mark.long
@pytest.mark.parametrize("seed", CASES)
def test_the_loop_is_closed(acquire, configs, tmp_path, seed):
    out = acquire.made("demo", "--seed", seed, "--out", tmp_path)
    (folder,) = tmp_path.iterdir()
    # What was built in is shown at the end alone, and it is what was sealed at the beginning.
    before, after = out.split("The truth is opened")
    drawn = draw_faults(seed, 2, (), 44)
    assert all(fault.size not in before for fault in drawn)
    assert all(f"built in  {fault.kind}: {fault.size}" in after for fault in drawn)
    sealed = re.search(r"SHA-256 ([0-9a-f]{16})", before)[1]
    assert hashlib.sha256((folder / "rig.yaml").read_bytes()).hexdigest().startswith(sealed)
    assert set(load_rig(folder / "rig.yaml").simulator.effects) >= {fault.effect for fault in drawn}
    # Nothing is sure that is not there, and, last of all, the Mueller matrix is not worse.
    assert not re.search(r"built in  nothing\n.*\(sure\)", after)
    picture = cv2.imread(str(folder / "demo.png")).astype(int)
    if seed == PICTURED:
        shown = cv2.imread(str(configs.parent / "docs/images/demo.png")).astype(int)
        # Fonts differ a little from one version of the drawing library to the next, curves and maps do not.
        assert np.abs(picture - shown).mean() < 1
    assert (folder / "corrected.yaml").exists()
    assert (folder / "report.html").exists()
    first, last = (float(text) for text in re.search(r"error of M/m00 +(\S+) +(\S+)", after).groups())
    assert last <= 1.01 * first


def test_same_seed_same_faults():
    first, repeat, different = (draw_faults(seed, 2, (), 44) for seed in (5, 5, 6))
    assert first == repeat != different


@pytest.mark.parametrize("kind", drawable())
def test_every_kind_can_be_asked_for(kind):
    (fault,) = draw_faults(1, 1, [kind], 44)
    assert fault.kind == kind
    assert re.search(r"\d", fault.size)


def test_what_cannot_be_drawn_is_refused_with_its_reason(acquire, tmp_path):
    err = acquire.refused("demo", "--only", "detector_offset", "--out", tmp_path)
    # Alarms of other runs on this machine may come first.
    assert err.splitlines()[-1] == "error: --only detector_offset: the dark states of the default plan measure it."
    with pytest.raises(ConfigError, match="there is no such fault, only psg_retardance"):
        draw_faults(1, 1, ["lamp"], 44)
    with pytest.raises(ConfigError, match="only 1 different faults"):
        draw_faults(1, 2, ["source_drift"], 44)
    assert not any(Path(tmp_path).iterdir())
