"""The order in which the runner asks for things, and what it does when one of them is wrong."""

import re
from typing import Any

import numpy as np
import pytest

from acquisition.capture.runner import Messages, TooBright
from acquisition.errors import InterlockOpened, RunFailed
from acquisition.screen.observer import Observer

MOVE_S, LATE_S, SETTLE_S, EXPOSURE_S = 0.75, 0.125, 0.25, 0.5


class Heard(Observer):
    """Keeps what observers are told."""

    def __init__(self) -> None:
        self.exposed: list[tuple[int, int]] = []
        self.reports: list[Any] = []
        self.warnings: list[str] = []
        self.activities: list[str] = []

    def exposing(self, state: int, retake: int) -> None:
        self.exposed.append((state, retake))

    def state_done(self, report: Any) -> None:
        self.reports.append(report)

    def warning(self, text: str) -> None:
        self.warnings.append(text)

    def activity(self, text: str) -> None:
        self.activities.append(text)


def test_a_state_settles_after_its_move_and_is_collected_while_the_next_move_runs(rig, runner_of):
    runner = runner_of()
    assert runner.run(range(3)) is True
    arrived, triggered, exposed = rig.times("arrived"), rig.times("trigger"), rig.times("exposed")
    assert [after - before for before, after in zip(arrived, triggered, strict=True)] == [SETTLE_S] * 3
    names = [event[1] for event in rig.events if event[1] in ("start", "trigger", "frame", "arrived")]
    state = ["trigger", "start", "frame", "arrived"]
    assert names == ["start", "arrived", *state, *state, "trigger", "frame"]
    # The frame is fetched at once: waiting for the axes comes after it.
    assert rig.times("frame") == exposed
    assert runner.writer.states() == [0, 1, 2]


def test_axes_that_stay_are_neither_moved_nor_waited_for_and_read_during_the_exposure(rig, runner_of):
    runner = runner_of(psg=(5.0, 5.0), psa=(1.0, 2.0))
    runner.run(range(2))
    assert [event[3] for event in rig.events if event[1] == "start"] == [["psg", "psa"], ["psa"]]
    between = [event[1:3] for event in rig.events if event[1] in ("trigger", "read", "exposed")]
    assert between == [("trigger", 1), ("exposed", 1), ("trigger", 2), ("read", "psg"), ("exposed", 2)]
    assert runner.writer.records[1].positions["psg"].deg == 5.0
    assert list(runner.writer.records[1].positions) == ["psg", "psa"]


def test_nothing_settles_where_nothing_moved(rig, runner_of):
    runner_of(psg=(5.0, 5.0)).run(range(2))
    assert rig.times("trigger")[1] == rig.times("arrived")[1]


def test_the_longest_move_starts_first(rig, runner_of):
    runner_of(psg=(0.0, 10.0), psa=(0.0, 90.0)).run(range(2))
    assert [event[3] for event in rig.events if event[1] == "start"][1] == ["psa", "psg"]


def test_the_length_of_a_move_is_from_where_the_axis_stands(rig, runner_of):
    runner_of(psg=(20.0, 21.0), psa=(0.0, 5.0)).run(range(2))
    assert [event[3] for event in rig.events if event[1] == "start"][1] == ["psa", "psg"]


def test_an_axis_that_something_moved_ends_the_run(rig, runner_of):
    runner = runner_of(psg=(5.0, 5.0, 5.0))
    rig.during_exposure = lambda number: setattr(rig.axes["psg"], "off_deg", 0.02)
    with pytest.raises(RunFailed, match=r"state 1: axis psg should stand at 5.0000 deg and reads 5.0200 deg"):
        runner.run(range(3))
    assert rig.events[-1][1] == "stop"
    assert runner.writer.states() == [0]


@pytest.mark.parametrize("off_deg", [-0.011, -0.009, 0.009])
def test_an_axis_within_its_tolerance_is_on_its_target(rig, runner_of, off_deg):
    runner = runner_of(psg=(5.0, 5.0))
    rig.axes["psg"].off_deg = off_deg
    if off_deg < -0.01:
        with pytest.raises(RunFailed, match="Something moved it"):
            runner.run(range(2))
        return
    assert runner.run(range(2))
    assert runner.writer.records[1].positions["psg"].deg == pytest.approx(5.0 + off_deg)


def test_a_lost_frame_is_taken_again_next_and_counted(rig, runner_of):
    observer = Heard()
    rig.lost = {2, 4}
    runner = runner_of(observers=(observer,))
    assert runner.run(range(3))
    # State 2 was under way when the loss of state 1 was known; the second loss costs one more round.
    assert observer.exposed == [(0, 0), (1, 0), (2, 0), (1, 1), (1, 2)]
    assert runner.writer.states() == [0, 2, 1]
    assert [record.columns["retakes"] for record in runner.writer.records] == [0, 0, 2]
    assert "state 1: frame lost (no frame within 1 s), taken again, try 1 of 2" in observer.warnings[0]
    assert "try 2 of 2" in observer.warnings[1]
    assert all(any(warning in text for text in runner.messages.texts) for warning in observer.warnings)


def test_a_state_that_is_lost_in_every_try_ends_the_run(rig, runner_of):
    rig.lost = set(range(3, 30))
    runner = runner_of(psg=(0.0, 10.0, 20.0))
    lost = "state 2: 3 frames in a row were lost, the last: no frame within 1 s. Capture the state again. Then continue"
    with pytest.raises(RunFailed, match=re.escape(lost)):
        runner.run(range(3))
    assert runner.writer.states() == [0, 1]
    assert rig.events[-1][1] == "stop"


def test_an_exposure_that_does_not_end_is_taken_again(rig, runner_of):
    observer = Heard()
    rig.never_exposed = {2}
    runner = runner_of(observers=(observer,))
    assert runner.run(range(3))
    assert observer.exposed == [(0, 0), (1, 0), (1, 1), (2, 0)]
    assert runner.writer.states() == [0, 1, 2]
    assert "state 1: frame lost (it still exposes), taken again" in observer.warnings[0]


def test_tries_are_counted_anew_in_the_next_run(rig, runner_of):
    runner = runner_of(psg=(0.0,))
    rig.lost = {1, 2}
    assert runner.run([0])
    rig.lost = {4, 5}
    assert runner.run([0])


def test_what_is_noted_of_a_state(rig, runner_of):
    pixels = np.full((4, 5), 1100, np.uint16)
    pixels[0, :2] = 4095
    pixels[1, 0] = 139
    rig.picture = lambda number: pixels
    observer = Heard()
    runner = runner_of(psg=(3.0,), observers=(observer,))
    runner.run([0])
    (record,), (report,) = runner.writer.records, observer.reports
    # Near black: below 1 % of the range above the black level, which is 139.95 here.
    monitor = (pixels.mean() - 100.0) / EXPOSURE_S
    assert record.columns == {
        "exposure_s": EXPOSURE_S,
        # The clock is compared with a second one, which two readings some nanoseconds apart do.
        "host_time_s": pytest.approx(1001.0, abs=0.01),
        "camera_time_ns": 10,
        "frame_id": 1,
        "retakes": 0,
        "saturated_fraction": 0.1,
        "near_black_fraction": 0.05,
        "monitor": pytest.approx(monitor),
        "camera_temperature_c": 31.5,
        "full_scale_counts": 4095,
    }
    assert record.pixels is pixels
    assert (report.state, report.role, report.exposure_s) == (0, "sample", EXPOSURE_S)
    assert (report.saturated_fraction, report.near_black_fraction) == (0.1, 0.05)


def test_a_camera_without_a_thermometer_leaves_a_gap(rig, runner_of):
    rig.temperature_c = None
    runner = runner_of(psg=(3.0,))
    runner.run([0])
    assert np.isnan(runner.writer.records[0].columns["camera_temperature_c"])


def test_the_exposure_that_the_camera_set_is_the_one_that_counts(rig, runner_of):
    set_exposure = rig.set_exposure
    rig.set_exposure = lambda exposure_s, repeats: set_exposure(exposure_s + 0.001, repeats)
    runner = runner_of(psg=(3.0,), repeats=4)
    runner.run([0])
    assert runner.writer.records[0].columns["exposure_s"] == 0.501
    assert rig.settings.frame_average == 4


def test_the_ledger_adds_up_what_cannot_be_avoided(rig, runner_of):
    rig.time_scale = 3.0
    runner = runner_of(psg=(0.0, 0.0), repeats=2)
    runner.run(range(2))
    light_s = 2 * EXPOSURE_S
    assert runner.ledger.readout_s == pytest.approx(2 * LATE_S)
    assert runner.ledger.unavoidable_s == pytest.approx(MOVE_S / 3 + SETTLE_S + 2 * (light_s + LATE_S))
    assert runner.ledger.states == 2
    spent = runner.ledger.spent_s
    assert spent["moving"] == pytest.approx(MOVE_S / 3)
    assert spent["settling"] == pytest.approx(SETTLE_S)
    assert set(spent) == {"moving", "settling", "setting", "exposure", "transfer", "writing", "shutter"}
    assert spent["exposure"] == pytest.approx(2 * (light_s + LATE_S))
    assert runner.ledger.summary()["excess"] == pytest.approx(0.0, abs=1e-6)


def test_light_is_switched_where_it_changes(rig, runner_of):
    runner_of(psg=(0.0,) * 5, role=("sample", "sample", "dark", "dark", "sample")).run(range(5))
    assert [event[2] for event in rig.events if event[1] == "light"] == [True, False, True]
    # After the light has been switched comes the exposure, never during a move.
    names = [event[1] for event in rig.events if event[1] in ("arrived", "light", "trigger")]
    assert names[:3] == ["arrived", "light", "trigger"]


def test_a_disc_that_takes_nothing_shuts_the_light_until_it_does(rig, runner_of):
    runner = runner_of(psg=(0.0,) * 3)
    runner.writer.blocked = True
    assert runner.run(range(3))
    assert [event[2] for event in rig.events if event[1] == "light"] == [True, False, True, False, True, False]
    assert runner.writer.asked["settle"] == 3
    assert len(runner.writer.records) == 3


def test_a_rig_without_a_source_takes_light_states(rig, runner_of):
    rig.source = None
    assert runner_of().run(range(3))


def test_a_stop_ends_the_run_with_the_state_under_way(rig, runner_of):
    runner = runner_of()
    rig.during_exposure = lambda number: number == 2 and runner.stop.request()
    assert runner.run(range(3)) is False
    assert runner.writer.states() == [0, 1]


@pytest.mark.parametrize("limit", [None, 0.1, 0.05])
def test_a_saturated_state_begins_the_capture_again_where_the_exposure_was_found(rig, runner_of, limit):
    pixels = np.full((4, 5), 1100, np.uint16)
    pixels[0, :2] = 4095
    rig.picture = lambda number: pixels
    runner = runner_of(saturation_limit=limit)
    if limit != 0.05:
        assert runner.run(range(3))
        return
    with pytest.raises(TooBright, match=r"state 0: 10.00 % of the pixels"):
        runner.run(range(3))
    # The axes are on their way to the next state: they arrive, and are not stopped.
    assert rig.events[-1][1] == "rest"
    assert not rig.times("stop")
    assert runner.writer.records == []


def test_the_long_exposures_of_a_bracket_may_saturate(rig, runner_of):
    rig.picture = lambda number: np.full((4, 5), 4095 if number == 2 else 500, np.uint16)
    runner = runner_of(psg=(0.0, 0.0), exposure_s=(0.5, 2.0), saturation_limit=0.05)
    assert runner.run(range(2))
    rig.picture = lambda number: np.full((4, 5), 4095, np.uint16)
    with pytest.raises(TooBright):
        runner.run([0])


def test_a_darker_start_forgets_the_states_and_shortens_every_exposure(rig, runner_of):
    observer = Heard()
    runner = runner_of(exposure_s=(0.5, 0.5, 0.123456), observers=(observer,))
    runner.run(range(3))
    runner.start_darker("state 1 is saturated")
    assert runner.writer.asked["forget"] == 1
    assert runner.ledger.states == 0
    assert runner.writer.exposures == [[0.3, 0.3, 0.0741]]
    assert runner.table.exposure_s.tolist() == [0.3, 0.3, 0.0741]
    assert observer.warnings == ["state 1 is saturated; beginning again at 0.6 of the exposure"]
    # The exposure itself stands in the states; nobody has to be warned of it.
    assert len(runner.messages.texts) == 1


def test_an_open_door_discards_the_state_and_switches_the_light_on_again(rig, runner_of):
    from types import SimpleNamespace

    rig.config.interlocks = (SimpleNamespace(kind="door", limit=0.0),)
    looks = []

    def door() -> bool:
        looks.append(1)
        # Open when the second exposure ends, closed at the third look after that.
        return 2 <= len(looks) <= 4

    rig.source.interlock_open = door
    runner = runner_of(continue_after_interlock=True)
    assert runner.run(range(3))
    assert runner.writer.states() == [0, 1, 2]
    assert [event[2] for event in rig.events if event[1] == "light"] == [True, True]
    (event,) = runner.interlocks.events
    assert (event["state"], event["why"]) == (1.0, "the door is open in state 1")
    assert event["duration_s"] > 0
    assert len(rig.times("stop")) == 1


def test_a_door_that_nobody_waits_for_ends_the_run(rig, runner_of):
    from types import SimpleNamespace

    rig.config.interlocks = (SimpleNamespace(kind="door", limit=0.0),)
    rig.door_open = True
    runner = runner_of()
    with pytest.raises(InterlockOpened, match="the door is open in state 0"):
        runner.run(range(3))
    assert runner.writer.records == []


def test_a_saturated_state_is_discarded_where_the_rig_file_says_so(rig, runner_of):
    from types import SimpleNamespace

    rig.config.interlocks = (SimpleNamespace(kind="saturation", limit=0.05),)
    rig.picture = lambda number: np.full((4, 5), 4095 if number == 2 else 500, np.uint16)
    runner = runner_of(psg=(0.0, 0.0), exposure_s=(0.5, 0.9))
    assert runner.run(range(2))
    # The same exposure as the shortest one is not meant to saturate.
    runner = runner_of(psg=(0.0, 0.0))
    rig.picture = lambda number: np.full((4, 5), 4095 if number == 4 else 500, np.uint16)
    with pytest.raises(InterlockOpened, match=r"100.00 % of the pixels are saturated. State 1 was discarded"):
        runner.run(range(2))
    assert runner.writer.states() == [0]


def test_a_stop_that_fails_as_well_is_told_with_the_first_error(rig, runner_of):
    rig.lost = {1, 2, 3}
    rig.stop = lambda: OSError("the line is gone")
    with pytest.raises(RunFailed) as failed:
        runner_of(psg=(0.0,)).run([0])
    assert failed.value.__notes__ == ["stopping the axes failed too: the line is gone"]


def test_observers_hear_what_the_rig_does(rig, runner_of):
    observer = Heard()
    runner_of(observers=(observer,)).tell("moving")
    assert observer.activities == ["moving"]


def test_the_oldest_messages_are_kept_and_the_others_counted():
    messages = Messages()
    for number in range(203):
        messages.add(f"{number} " + "x" * 600)
    assert len(messages.texts) == 200
    assert messages.dropped == 3
    assert messages.texts[0].split()[1] == "0"
    assert len(messages.texts[0]) == len("00:00:00 ") + 500


@pytest.mark.parametrize(("light", "times"), [(0, 1), (40, 0)])
def test_a_capture_without_light_says_so_once(rig, runner_of, light, times):
    observer = Heard()
    rig.picture = lambda number: np.full((4, 5), 100 + (light if number > 2 else 0), np.uint16)
    psg = (0.0, 10.0, *(9.0 * k for k in range(12)))
    assert runner_of(psg=psg, role=("dark", "dark") + ("sample",) * 12, observers=(observer,)).run(range(14))
    warnings = [text for text in observer.warnings if "no brighter than the dark ones: is the source on" in text]
    assert len(warnings) == times
