"""An unmodified RunEngine drives the emulated rig: scans, and a whole capture that it pauses and resumes.

Tiled reads back what it was told, through its own server.
"""

import threading
import time
import warnings

import h5py
import numpy as np
import pytest
from bluesky import RunEngine
from bluesky import plan_stubs as bps
from bluesky.plans import count, grid_scan, list_scan, scan
from bluesky.protocols import Configurable, Movable, Pausable, Readable, Subscribable, Triggerable
from bluesky.suspenders import SuspendBoolHigh
from bluesky.utils import FailedStatus, RunEngineInterrupted
from event_model import DocumentNames, schema_validators

from acquisition.bluesky_devices import open_bench
from acquisition.bluesky_devices.capture_device import COLUMNS
from acquisition.capture.plan import MeasurementPlan
from processing.storage.captures.capture import Capture

PLAN = MeasurementPlan(omega_deg=35.0)
BLACK_LEVEL = 64
#: Few states, for plans that take several captures.
SHORT = MeasurementPlan(omega_deg=35.0, darks=1, states={"kind": "rotating_retarders", "states": 20, "step_deg": 9.0})


@pytest.fixture
def bench(small_rig):
    with open_bench(small_rig(rows=24, columns=32), home=True) as bench:
        yield bench


@pytest.fixture
def engine():
    """A RunEngine as it comes, and the documents that it has sent."""
    documents = []
    engine = RunEngine(context_managers=[])
    engine.subscribe(lambda name, document: documents.append((name, document)))
    return engine, documents


def _events(documents):
    return [document["data"] for name, document in documents if name == "event"]


def test_a_scan_of_an_axis_reads_where_it_is(bench, engine):
    run, documents = engine
    psg = bench.axes["psg"]
    assert isinstance(psg, Movable)
    assert isinstance(psg, Readable)
    assert isinstance(bench.camera, Triggerable)
    run(scan([bench.camera], psg, 10, 40, 4))
    angles = [event["psg"] for event in _events(documents)]
    np.testing.assert_allclose(angles, [10, 20, 30, 40], atol=0.01)
    frames = [event["camera_frame"] for event in _events(documents)]
    assert all(np.shape(frame) == (24, 32) for frame in frames)
    assert not np.array_equal(frames[0], frames[2])


def test_a_camera_may_keep_its_frames_to_itself(bench, engine):
    run, documents = engine
    bench.camera.tells_frames = False
    run(count([bench.camera]))
    (event,) = _events(documents)
    assert list(event) == ["camera_mean"]
    assert event["camera_mean"] > BLACK_LEVEL


def test_a_camera_puts_its_frames_into_files(bench, engine, tmp_path):
    run, documents = engine
    bench.camera.folder = tmp_path / "frames"
    (uid,) = run(count([bench.camera], num=2))
    assert [list(event) for event in _events(documents)] == [["camera_mean"]] * 2
    resources = [document for name, document in documents if name == "stream_resource"]
    assert [document["run_start"] for document in resources] == [uid, uid]
    for resource, event in zip(resources, _events(documents), strict=True):
        with h5py.File(resource["uri"].removeprefix("file://localhost")) as file:
            frame = file[resource["parameters"]["dataset"]]
            assert frame.shape == (1, 24, 32)
            assert frame[...].mean() == event["camera_mean"]
            assert file["entry/data/exposure_s"][()] == bench.camera.exposure_s
    assert len(list((tmp_path / "frames").iterdir())) == 2


def test_a_frame_that_a_pause_has_lost_is_not_counted(bench, engine, tmp_path):
    run, documents = engine
    bench.camera.folder = tmp_path / "frames"

    def paused_between_reading_and_saving():
        yield from bps.stage(bench.camera)
        yield from bps.open_run()
        yield from bps.checkpoint()
        yield from bps.trigger(bench.camera, wait=True)
        yield from bps.create()
        yield from bps.read(bench.camera)
        if not (tmp_path / "was").exists():
            (tmp_path / "was").touch()
            yield from bps.pause()
        yield from bps.save()
        yield from bps.close_run()
        yield from bps.unstage(bench.camera)

    with pytest.raises(RunEngineInterrupted):
        run(paused_between_reading_and_saving())
    run.resume()
    assert len(list((tmp_path / "frames").iterdir())) == 2
    datums = [document for name, document in documents if name == "stream_datum"]
    assert len(_events(documents)) == len(datums) == 1


def test_what_the_rig_forbids_fails_the_plan(bench, engine):
    run, _ = engine
    with pytest.raises(FailedStatus):
        run(scan([], bench.axes["arm"], 0, 720, 2))


@pytest.mark.long
def test_a_capture_of_40_states_is_paused_and_resumed(bench, engine, tmp_path):
    run, documents = engine
    device = bench.capture(PLAN, tmp_path / "captures")
    assert isinstance(device, Pausable)

    _paused(run, device, tmp_path / "captures")
    run.resume()
    (event,) = _events(documents)
    with Capture(event["capture_file"]) as capture:
        assert capture.status == "complete"
        assert len(capture.done) == 44
        assert [len(segment.states) > 0 for segment in capture.segments] == [True, True]
        np.testing.assert_array_equal(event["capture_psg_deg"], capture.angles_deg["psg"])
        assert [name for name, _ in documents if name.startswith("stream")] == ["stream_resource", "stream_datum"]
        resource = next(document for name, document in documents if name == "stream_resource")
        assert resource["uri"].endswith(capture.path.name)
        descriptor = next(document for name, document in documents if name == "descriptor")
        key = descriptor["data_keys"]["capture_frames"]
        assert key["shape"] == [44, 1, 24, 32]
    # The next one is a capture of its own.
    run(count([device]))
    assert len(list((tmp_path / "captures").glob("*.h5"))) == 2


@pytest.fixture
def tiled(engine, tmp_path):
    """A client of a Tiled server that may read this test's folder and is told what the engine does."""
    pytest.importorskip("tiled", reason="Tiled is not installed: .ci/tiled brings it and runs this")
    # Here, for they take seconds; what they import warns of what is deprecated elsewhere.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from bluesky.callbacks.tiled_writer import TiledWriter
        from tiled.client import Context, from_context
        from tiled.server.simple import SimpleTiledServer
    with (
        SimpleTiledServer(tmp_path / "tiled", readable_storage=[tmp_path]) as served,
        Context.from_any_uri(served.uri)[0] as context,
    ):
        client = from_context(context)
        engine[0].subscribe(TiledWriter(client))
        yield client


@pytest.mark.third_party
@pytest.mark.filterwarnings("ignore")
def test_tiled_reads_back_what_it_was_told(bench, engine, tiled, tmp_path):
    run, documents = engine
    captures = tmp_path / "captures"
    device = bench.capture(PLAN, captures)
    _paused(run, device, captures)
    (uid,) = run.resume()
    stream = tiled[uid]["primary"]
    (event,) = _events(documents)
    assert list(stream["capture_file"].read()) == [event["capture_file"]]
    with h5py.File(event["capture_file"]) as file:
        frames = file["entry/instrument/detector/data"][...]
    assert frames.shape == (44, 1, 24, 32)
    _assert_same(stream["capture_frames"].read(), frames)
    with Capture(event["capture_file"]) as capture:
        written = {f"{axis}_deg": angles for axis, angles in capture.angles_deg.items()}
        written |= {name: capture.column(name) for name in COLUMNS}
    for name, values in written.items():
        _assert_same(stream[f"capture_{name}"].read()[0], values)

    # The same server, for it takes seconds to start: a scan of the camera alone.
    camera, pictures = bench.camera, []
    camera.folder = tmp_path / "frames"
    run.subscribe(lambda *_: pictures.append(camera.frame.copy()), "event")
    (uid,) = run(scan([camera], bench.axes["psg"], 10, 40, 4))
    stream = tiled[uid]["primary"]
    _assert_same(stream["camera_frame"].read(), np.stack(pictures))
    _assert_same(stream["camera_mean"].read(), np.array([frame.mean() for frame in pictures]))
    assert not np.array_equal(pictures[0], pictures[2])


def _assert_same(read, written) -> None:
    """Type, shape and every value."""
    assert read.dtype == written.dtype
    np.testing.assert_array_equal(read, written)


def _paused(run, device, folder) -> None:
    """Begin a capture, and interrupt it while it moves to its seventh state."""
    wait, moves = device.rig.wait, 0

    def wait_and_pause(motions):
        nonlocal moves
        moves += 1
        if moves == 7:
            # The RunEngine answers once the state has ended, so not in the thread that takes it.
            threading.Thread(target=run.request_pause).start()
            while not device.stop_request.requested:
                time.sleep(0.001)
        return wait(motions)

    device.rig.wait = wait_and_pause
    with pytest.raises(RunEngineInterrupted):
        run(count([device]))
    (half,) = folder.glob("*.h5*")
    with Capture(half) as capture:
        assert capture.status == "aborted"
        assert 5 <= len(capture.done) < capture.planned_states


def test_an_interlock_that_opens_in_a_capture_suspends_it(bench, engine, monkeypatch, tmp_path):
    run, documents = engine
    moves, open_until_s = [], [0.0]
    wait = bench.rig.wait

    def wait_and_open(motions):
        moves.append(motions)
        if len(moves) == 7:
            open_until_s[0] = time.monotonic() + 1.0
        return wait(motions)

    monkeypatch.setattr(bench.rig, "wait", wait_and_open)
    monkeypatch.setattr(bench.rig.source, "interlock_open", lambda: time.monotonic() < open_until_s[0])
    run.install_suspender(SuspendBoolHigh(bench.interlock))
    run(count([bench.capture(SHORT, tmp_path / "captures")]))
    (event,) = _events(documents)
    with Capture(event["capture_file"]) as capture:
        assert (capture.status, len(capture.segments), len(capture.done)) == ("complete", 2, capture.planned_states)


def test_the_interlock_is_still_watched_after_a_watcher_has_failed(bench, monkeypatch, caplog):
    door, heard = {"open": False}, []
    monkeypatch.setattr(bench.rig.source, "interlock_open", lambda: door["open"])

    def fails(value, **_):
        heard.append(value)
        raise ValueError("no plan runs")

    bench.interlock.subscribe(fails, run=False)
    for state in (True, False):
        door["open"] = state
        deadline_s = time.monotonic() + 5
        while (not heard or heard[-1] != state) and time.monotonic() < deadline_s:
            time.sleep(0.01)
    assert heard == [1, 0]
    assert "no plan runs" in caplog.text


def _omegas(documents):
    for event in _events(documents):
        with Capture(event["capture_file"]) as capture:
            angles = {float(deg) for deg in np.round(capture.angles_deg["arm"], 2)}
            yield round(event["arm"], 2), capture.header.omega_deg, angles


@pytest.mark.long
def test_a_scan_of_omega_takes_each_capture_where_the_arm_stands(bench, engine, tmp_path):
    run, documents = engine
    device = bench.capture(SHORT, tmp_path / "captures")
    arm, psg = bench.axes["arm"], bench.axes["psg"]
    for plan, angles in (
        (scan([device], arm, 60, 120, 2), [60, 120]),
        (list_scan([device], arm, [70.0, 50.0]), [70, 50]),
        (grid_scan([device], arm, 40, 80, 2, psg, 0, 10, 2), [40, 40, 80, 80]),
    ):
        documents.clear()
        run(plan)
        assert list(_omegas(documents)) == [(angle, angle, {angle}) for angle in angles]


def test_without_a_move_of_the_arm_omega_is_that_of_the_plan(bench, engine, tmp_path):
    run, documents = engine
    run(count([bench.capture(SHORT, tmp_path / "captures"), bench.axes["arm"]]))
    assert [omega for _, omega, _ in _omegas(documents)] == [SHORT.omega_deg]


def test_documents_hold_the_configuration_and_pass_the_schemas_of_event_model(bench, engine, tmp_path):
    run, documents = engine
    device = bench.capture(SHORT, tmp_path / "captures")
    run(scan([bench.camera, device], device.setting("exposure_s"), 0.01, 0.02, 2))
    for name, document in documents:
        schema_validators[DocumentNames[name]].validate(document)
    descriptor = next(document for name, document in documents if name == "descriptor")
    camera = descriptor["configuration"]["camera"]["data"]
    assert camera["camera_exposure_s"] == 0.02
    assert camera["camera_serial_number"] == bench.rig.camera.describe().serial_number
    assert descriptor["configuration"]["capture"]["data"]["capture_wavelength_nm"] == 662
    exposures = []
    for event in _events(documents):
        with Capture(event["capture_file"]) as capture:
            exposures.append((event["capture_exposure_s"][0], capture.column("exposure_s")[0]))
    assert exposures == [pytest.approx((0.01, 0.01)), pytest.approx((0.02, 0.02))]


def test_a_plan_sets_exposure_and_wavelength(bench, engine, tmp_path):
    run, documents = engine
    bench.camera.tells_frames = False
    run(scan([bench.camera], bench.exposure, 0.01, 0.04, 2))
    first, second = (event["camera_mean"] - BLACK_LEVEL for event in _events(documents))
    assert second == pytest.approx(4 * first, rel=0.1)
    device = bench.capture(SHORT, tmp_path / "captures")
    assert isinstance(device, Configurable)

    def at_the_other_wavelength():
        yield from bps.configure(device, {"wavelength_nm": 451})
        yield from count([device])

    run(at_the_other_wavelength())
    with Capture(_events(documents)[-1]["capture_file"]) as capture:
        assert capture.header.wavelength_nm == 451


def test_an_open_interlock_suspends_a_plan_until_it_is_closed(bench, engine, monkeypatch):
    run, documents = engine
    assert isinstance(bench.interlock, Subscribable)
    door = {"open": False}
    monkeypatch.setattr(bench.rig.source, "interlock_open", lambda: door["open"])
    run.install_suspender(SuspendBoolHigh(bench.interlock))
    bench.camera.tells_frames = False
    opened, closed = [], []

    def opens_and_closes(name, document):
        # What comes again after a suspension must not open it again.
        if name == "event" and document["seq_num"] == 2 and not opened:
            door["open"] = True
            opened.append(time.monotonic())

            def close():
                closed.append(time.monotonic())
                door["open"] = False

            threading.Timer(2.0, close).start()

    times = []
    run.subscribe(opens_and_closes)
    run.subscribe(lambda *_: times.append(time.monotonic()), "event")
    run(count([bench.camera], num=5, delay=0.5))
    # What was under way is taken again.
    assert {document["seq_num"] for name, document in documents if name == "event"} == {1, 2, 3, 4, 5}
    # Nothing is taken from the moment at which it is seen until the door is shut.
    assert not [moment for moment in times if opened[0] + 1.0 < moment < closed[0]]
    run.clear_suspenders()
