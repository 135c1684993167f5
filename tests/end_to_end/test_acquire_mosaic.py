"""`acquire --mode stokes` on the tables of Lucid's polarization cameras, wherever the region begins.

The light is oblique and elliptical, so that no two analyzers see the same: exchanged ones, or a mosaic that begins one
pixel beside where it is taken to begin, turn the angle by tens of degrees. CI takes two formats, the nightly run one in
each phase; ``UMOV_EVERY_TABLE=1`` in the environment takes all formats of both tables in all phases.
"""

import os
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.pixel_formats import pixel_format
from processing.commands.application import main as process
from processing.storage.captures.capture import Capture
from processing.storage.products.images import StokesImage
from simulators.camera.node_map import node_map
from tests.commands import exit_code

Acquire = Callable[..., tuple[int, str, str]]
Offset = tuple[int, int]

EVERY = bool(os.environ.get("UMOV_EVERY_TABLE"))
MONO, COLOUR = "lucid_tri050s_p", "lucid_tri050s_q"
ANGLES = "PolarizedAngles_0d_45d_90d_135d_"
PHASES: list[Offset] = [(0, 0), (1, 0), (0, 1), (1, 1)]

SENSOR = (("90", "45"), ("135", "0"))
COLOURS = np.array([["red", "green"], ["green", "blue"]]).repeat(2, 0).repeat(2, 1)

# A polarizer at 20 degrees, then a plate of 60 degrees at 50: on the sphere 60 degrees before the plate's axis, so
# that cos 60 stays along it and sin 60 cos 60 across it.
GENERATOR = """\
  - {kind: polarizer, name: psg_polarizer, azimuth_deg: 20}
  - {kind: retarder, name: plate, azimuth_deg: 50, retardance_deg: 60}
"""
ALONG, ACROSS = 0.5, -np.sqrt(3) / 4
DOLP = np.hypot(ALONG, ACROSS)
AOLP_DEG = 50 + np.rad2deg(np.arctan2(ACROSS, ALONG)) / 2


@pytest.fixture
def stokes(
    acquire: Acquire, small_rig: Callable[..., Path], short_plan: Callable[[str], Path], configs: Path, tmp_path: Path
) -> Callable[..., tuple[int, str, Path]]:
    """Takes a capture on a table with a region; gives exit code, message and the folder of captures."""

    def take(
        table: str, settings: dict[str, object], *more: object, steps_of_one: bool = True, mosaic: str = ""
    ) -> tuple[int, str, Path]:
        if steps_of_one:
            fine = node_map(table).model_copy(update={"step": {}})
            table = "fine.yaml"
            (tmp_path / table).write_text(fine.model_dump_json())
        text = (configs / "instruments/linear_stokes.yaml").read_text(encoding="utf-8")
        oblique = text.replace("  - {kind: polarizer, name: psg_polarizer, azimuth_deg: 0}\n", GENERATOR)
        assert GENERATOR in oblique
        (tmp_path / "oblique.yaml").write_text(
            oblique.replace('[["90", "45"], ["135", "0"]]', mosaic) if mosaic else oblique
        )
        camera = {"kind": "aravis", "packet_size": 9000, "settings": settings}
        fmt = pixel_format(str(settings["pixel_format"]))
        if fmt.bits > 12:
            camera["bits"] = 12
        mode = {"stokes": {"instrument": str(tmp_path / "oblique.yaml")}}
        rig = small_rig(top={"camera": camera, "modes": mode}, camera=table)
        light = ("--sample", "air", "--omega", 180)
        out = tmp_path / "captures"
        code, _, err = acquire("--rig", rig, "--plan", short_plan("stokes"), *light, "--out", out, *more)
        return code, " ".join(err.split()), out

    return take


def assert_light(path: Path) -> None:
    """Reduce a capture and compare what comes out with the light that went in."""
    out = path.with_suffix(".stokes.h5")
    assert exit_code(process, "reduce", path, "--out", out, "--no-figure") == 0
    s0, s1, s2 = StokesImage.load(out).values[:, 2:-2, 2:-2]
    aolp_deg = np.rad2deg(np.arctan2(s2, s1)) / 2
    # Noise of a pixel: 0.8 degrees, 0.02 in DoLP; a count of 8 bits is 2 % of the light.
    assert np.median(aolp_deg) == pytest.approx(AOLP_DEG, abs=0.5)
    assert np.median(np.hypot(s1, s2) / s0) == pytest.approx(DOLP, abs=0.02)
    assert np.max(np.abs(aolp_deg - AOLP_DEG)) < 6.0


def formats_of(table: str, *, angles: bool) -> list[str]:
    return [name for name in node_map(table).pixel_formats if pixel_format(name).angles == angles]


def taken(stokes, table: str, region: dict[str, object]) -> Path:
    """The capture of a region, which is taken without a mistake."""
    code, err, out = stokes(table, region)
    assert code == 0, err
    (path,) = out.glob("*.h5")
    return Path(path)


def raw_cases() -> list[Any]:
    if EVERY:
        return list(product(formats_of(MONO, angles=False), PHASES))
    # Every format and every phase have a cheaper test: `test_camera_node_maps.py`, `test_mosaic_phase.py`.
    others = [("PolarizeMono12p", (0, 0)), ("PolarizeMono8", (1, 0)), ("PolarizeMono12", (3, 5))]
    short = [("PolarizeMono12Packed", (0, 1)), ("PolarizeMono16", (1, 1))]
    return [*short, *(pytest.param(*case, marks=pytest.mark.long) for case in others)]


@pytest.mark.parametrize(("name", "offset"), raw_cases())
def test_light_reads_as_it_is_wherever_the_region_begins(stokes, name: str, offset: Offset) -> None:
    x, y = offset
    region = {"width": 40, "height": 24, "offset_x": x, "offset_y": y, "pixel_format": name}
    path = taken(stokes, MONO, region)
    with Capture(path) as capture:
        assert capture.header.mosaic == tuple(map(tuple, np.roll(SENSOR, (-y, -x), axis=(0, 1))))
        assert capture.instrument is not None
        assert capture.instrument.mosaic == capture.header.mosaic
    assert_light(path)


def colour_cases() -> list[tuple[str, Offset]]:
    if not EVERY:
        return [("BayerRG12p", (3, 1))]
    every_phase = list(product(range(4), range(4)))
    raw = [(name, phase) for name in formats_of(COLOUR, angles=False) for phase in PHASES]
    raw += [("BayerRG12p", phase) for phase in every_phase if phase not in PHASES]
    return raw + [(name, (2 * x, 2 * y)) for name in formats_of(COLOUR, angles=True) for x, y in PHASES]


@pytest.mark.parametrize(("name", "offset"), colour_cases())
def test_each_colour_reads_the_light_as_it_is_wherever_the_region_begins(stokes, name: str, offset: Offset) -> None:
    x, y = offset
    region = {"width": 64, "height": 56, "offset_x": x, "offset_y": y, "pixel_format": name}
    path = taken(stokes, COLOUR, region)
    out = path.parent
    with Capture(path) as capture:
        assert capture.header.mosaic == tuple(map(tuple, np.roll(SENSOR, (-y, -x), axis=(0, 1))))
        assert capture.header.colours == tuple(map(tuple, np.roll(COLOURS, (-y, -x), axis=(0, 1))))
    assert exit_code(process, "colours", path, "--out", out / "colours") == 0
    for part in ("red", "green_a", "green_b", "blue") if EVERY else ("red",):
        assert_light(out / "colours" / f"{path.stem}.{part}.h5")


@pytest.mark.parametrize("name", formats_of(MONO, angles=True) if EVERY else [f"{ANGLES}Mono12p"])
@pytest.mark.parametrize("offset", PHASES if EVERY else [(1, 1)])
def test_counts_that_are_sent_by_angle_begin_with_a_whole_super_pixel(stokes, name: str, offset: Offset) -> None:
    x, y = offset
    region = {"width": 40, "height": 24, "offset_x": 2 * x, "offset_y": 2 * y, "pixel_format": name}
    path = taken(stokes, MONO, region)
    with Capture(path) as capture:
        assert capture.header.mosaic == SENSOR
        assert (capture.camera_nodes["OffsetX"], capture.camera_nodes["OffsetY"]) == (str(x), str(y))
    assert_light(path)


@pytest.mark.parametrize("name", formats_of(MONO, angles=True) if EVERY else [f"{ANGLES}Mono12p"])
@pytest.mark.parametrize("offset", PHASES[1:] if EVERY else PHASES[1:2])
def test_half_a_super_pixel_of_counts_that_are_sent_by_angle_is_refused(stokes, name: str, offset: Offset) -> None:
    region = {"width": 40, "height": 24, "offset_x": offset[0], "offset_y": offset[1], "pixel_format": name}
    code, err, _ = stokes(MONO, region)
    assert code != 0
    assert f"set Offset{'X' if offset[0] else 'Y'} to 1" in err
    assert "this format has 2 x 2 of them together" in err


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"offset_x": 1}, "steps of 4: 0 or 4"),
        ({"offset_y": 6}, "steps of 4: 4 or 8"),
        ({"reverse_x": True}, "mirrors its frames"),
        ({"reverse_y": True, "offset_x": 4}, "mirrors its frames"),
    ],
)
def test_the_maker_s_own_table_allows_one_phase(stokes, settings: dict[str, object], says: str) -> None:
    region = {"width": 40, "height": 24, "pixel_format": "PolarizeMono12p"} | settings
    code, err, _ = stokes(MONO, region, "--dry-run", steps_of_one=False)
    assert code != 0
    assert says in err


def test_an_instrument_that_names_the_analyzers_otherwise_than_the_camera_is_refused(stokes) -> None:
    region = {"width": 40, "height": 24, "pixel_format": f"{ANGLES}Mono8"}
    swapped = '[["0", "45"], ["135", "90"]]'
    code, err, _ = stokes(MONO, region, "--dry-run", mosaic=swapped)
    assert code != 0
    assert "makes super-pixels of 90 45 / 135 0; the instrument file has 0 45 / 135 90" in err
    assert "Write `mosaic: [['90', '45'], ['135', '0']]`" in err
    # A raw mosaic is whatever the instrument file says.
    code, err, _ = stokes(MONO, region | {"pixel_format": "PolarizeMono8"}, "--dry-run", mosaic=swapped)
    assert code == 0, err


def test_an_instrument_without_a_mosaic_is_refused_before_anything_moves(
    acquire: Acquire, small_rig: Callable[..., Path], short_plan: Callable[[str], Path], tmp_path: Path
) -> None:
    camera = {"kind": "aravis", "packet_size": 9000, "settings": {"pixel_format": "PolarizeMono12p"}}
    rig = small_rig(top={"camera": camera}, camera=MONO)
    code, _, err = acquire("--rig", rig, "--plan", short_plan("drr"), "--sample", "air", "--omega", 180, "--dry-run")
    assert code != 0
    assert "mosaic: pixel format PolarizeMono12p is that of a polarization sensor" in " ".join(err.split())
