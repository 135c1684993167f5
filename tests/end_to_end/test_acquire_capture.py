"""`acquire` takes whole captures on emulated devices through the real drivers."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from processing.storage.captures.capture import Capture
from simulators.camera.pixel_stamp import read_stamp
from tests.commands import exit_code

pytestmark = pytest.mark.usefixtures("figures")


def _path(out: str) -> Path:
    lines = [line.split() for line in out.splitlines()]
    return next(Path(words[1]) for words in lines if words and words[0] == "capture")


def test_every_frame_shows_the_angles_that_its_metadata_claims(acquire, small_rig, tmp_path):
    rig = small_rig(stamp=True)
    out = acquire.made("--omega", 35, "--rig", rig, "--out", tmp_path)
    with Capture(_path(out)) as capture:
        assert capture.role == ("dark",) * 4 + ("sample",) * 40
        axes = sorted(capture.angles_deg)
        assert axes == ["arm", "psa", "psg"]
        for state in range(44):
            true = dict(zip(axes, read_stamp(capture.frames(state)[0]), strict=True))
            for axis in axes:
                # Half a microstep of the Zaber stages, the resolution of the SMC100's reply.
                assert true[axis] == pytest.approx(capture.angles_deg[axis][state], abs=3e-4)
        n = np.arange(40)
        np.testing.assert_allclose(capture.angles_deg["psg"][4:], 9 * n, atol=3e-4)
        np.testing.assert_allclose(capture.angles_deg["psa"][4:], 4.91 * 9 * n, atol=3e-4)
        np.testing.assert_allclose(capture.angles_deg["arm"], 35, atol=3e-4)


def test_the_capture_says_what_it_is(acquire, small_rig, tmp_path):
    code, out, err = acquire("--omega", 35, "--rig", small_rig(), "--out", tmp_path)
    assert code == 0, err
    assert "SIMULATED" in out
    assert "SIMULATED" in err
    path = _path(out)
    assert path.with_suffix(".png").stat().st_size > 10_000
    assert not path.with_name(path.name + ".partial").exists()
    with Capture(path) as capture:
        assert capture.simulated
        assert capture.header.simulated
        assert capture.status == "complete"
        assert capture.instrument is not None
        assert capture.instrument.name == "RGB950"
        assert capture.header.seed == 1
        ledger = capture.closing["ledger"]
        parts = [
            v
            for k, v in ledger.items()
            if k.endswith("_s") and k not in ("total_s", "unavoidable_s", "of_it_readout_s")
        ]
        assert sum(parts) == pytest.approx(ledger["total_s"], abs=0.01)
        assert 0 < ledger["of_it_readout_s"] < ledger["unavoidable_s"]
        assert ledger["excess_with_readout"] > ledger["excess"] > 0
        assert "beyond the unavoidable" in out
        assert capture.closing["stream"]["completed"] >= 44
        dark = capture.frames(0)
        light = capture.frames(20)
        assert abs(dark.mean() - 64) < 0.2
        assert light.mean() > 100
        assert np.all(np.diff(capture.column("host_time_s")) > 0)


@pytest.mark.long
def test_same_plan_and_seed_give_the_same_bytes(acquire, small_rig, tmp_path):
    plan = tmp_path / "plan.yaml"
    plan.write_text("kind: plan\ndarks: 2\nstates: {kind: rotating_retarders, states: 20, step_deg: 18}\n")

    def frames(folder, seed):
        out = acquire.made("--plan", plan, "--rig", small_rig(), "--seed", seed, "--out", tmp_path / folder)
        with h5py.File(_path(out)) as file:
            return file["entry/instrument/detector/data"][...]

    first = frames("a", 7)
    assert np.array_equal(first, frames("b", 7))
    assert not np.array_equal(first, frames("c", 8))


def test_stokes_capture_is_a_mosaic_under_horizontal_light(acquire, small_rig, tmp_path):
    code, out, err = acquire(
        "--mode", "stokes", "--omega", 180, "--sample", "air", "--rig", small_rig(), "--out", tmp_path
    )
    assert code == 0, err
    with Capture(_path(out)) as capture:
        assert capture.header.mosaic == (("90", "45"), ("135", "0"))
        assert capture.header.illumination == "horizontal"
        assert capture.role == ("dark",) * 4 + ("air",) * 8
        np.testing.assert_allclose(capture.angles_deg["psg"], 17.02, atol=3e-4)
        frame = capture.frames(5)[0].astype(float) - 64
        horizontal, vertical = frame[1::2, 1::2].mean(), frame[0::2, 0::2].mean()
        assert abs(vertical) < 1
        assert frame[0::2, 1::2].mean() == pytest.approx(horizontal / 2, rel=0.01)


def test_dry_run_moves_nothing_and_writes_nothing(acquire, small_rig, tmp_path):
    out_folder = tmp_path / "captures"
    out = acquire.made("--omega", 35, "--rig", small_rig(), "--out", out_folder, "--dry-run")
    assert "nothing was moved" in out
    assert "limits of psa" in out
    assert not out_folder.exists()


def test_averaged_frames_say_so(acquire, small_rig, tmp_path):
    plan = tmp_path / "plan.yaml"
    plan.write_text("kind: plan\nmode: stokes\nstates: {kind: fixed, states: 2}\nrepeats: 5\ndarks: 1\n")
    out = acquire.made("--plan", plan, "--rig", small_rig(), "--out", tmp_path)
    with Capture(_path(out)) as capture:
        assert capture.column("repeats").tolist() == [5, 5, 5]


def test_exposure_is_recorded_as_the_camera_reads_it_back(acquire, small_rig, tmp_path):
    """The simulated camera sets whole microseconds; over a bracket, half of one would be 2 % of the short exposure."""
    plan = tmp_path / "plan.yaml"
    text = "kind: plan\nmode: stokes\nexposure_s: 0.0000254\nbracket: [1, 100]\ndarks: 1\n"
    plan.write_text(text + "states: {kind: fixed, states: 2}\n")
    out = acquire.made("--plan", plan, "--rig", small_rig(), "--out", tmp_path)
    with Capture(_path(out)) as capture:
        np.testing.assert_allclose(capture.column("exposure_s"), np.tile([25e-6, 2540e-6], 3), rtol=1e-9)


@pytest.mark.long
def test_bracketed_capture_sees_dark_and_bright_pixels(acquire, small_rig, tmp_path):
    """Eight times the exposure saturates the bright pixels; the reduction takes those from the short one.

    The interlock on saturation looks at the short one alone.
    """
    plan = tmp_path / "plan.yaml"
    plan.write_text("kind: plan\nexposure_s: 0.005\nbracket: [1, 8]\ndarks: 2\n")
    rig = small_rig(flux_e_per_s=3.2e6, top={"interlocks": [{"kind": "saturation", "limit": 0.001}]})
    out = acquire.made("--plan", plan, "--rig", rig, "--out", tmp_path)
    path = _path(out)
    with Capture(path) as capture:
        assert capture.role == ("dark",) * 4 + ("sample",) * 80
        np.testing.assert_allclose(capture.column("exposure_s"), np.tile([0.005, 0.04], 42))
        saturated = capture.column("saturated_fraction")[4:]
        assert saturated[0::2].max() == 0
        assert saturated[1::2].min() > 0.02
        short = capture.frames(4)[0].astype(float) - 64
        long = capture.frames(5)[0].astype(float) - 64
        unsaturated = (long < 3900) & (long > 500)
        assert (long[unsaturated] / short[unsaturated]).mean() == pytest.approx(8, rel=0.02)
    merged = _m00(path, "--weighted")
    out = acquire.made("--omega", 35, "--exposure", 0.005, "--rig", rig, "--out", tmp_path / "single")
    single = _m00(_path(out))
    # m00 is in counts of the longest exposure.
    bright = single > 0.3 * single.max()
    ratio = merged[bright] / single[bright]
    assert np.median(ratio) == pytest.approx(8, rel=0.01)
    assert np.std(ratio) < 0.3


def _m00(capture, *options):
    from processing.commands import application as cli

    assert exit_code(cli.main, "reduce", capture, "--no-figure", *options) == 0
    with h5py.File(capture.with_suffix(".mueller.h5")) as product:
        return product["entry/data/mueller"][0, 0]
