"""A tag by itself: on the air of a site, with a host that speaks to it, and in a simulated room, from its start on."""

import numpy as np
import pytest
from emulator.board_library import KEPT_BYTES
from emulator.site.host_board import HostBoard
from emulator.site.tag_world import TagWorld
from firmware_stage import BoardStage, needs_compiler
from msgspec.structs import replace

from skyless.core.air.frame import Diagnostics, after_rmarker_s
from skyless.core.ticks import from_seconds, to_seconds, wrap
from skyless.radio.dw1000.radio import OFF
from skyless.radio.serial.link import ASK_HELLO, ASK_TAG_CONFIG, SET_TAG_CONFIG, BoardSettings, Reader, decode, pack
from skyless.radio.tag_reports import BoardFix
from skyless.sim.evaluation.fleet import world_of
from skyless.sim.evaluation.scenarios import Request, Room, impairments_of, trajectories_of
from skyless.sim.lab import lab_site
from support.bench import ROOM, tape

pytestmark = [pytest.mark.site, needs_compiler]

SITE = replace(ROOM, schedule=replace(ROOM.schedule, mode="free", rate_hz=50.0), tags=replace(ROOM.tags, height_m=0.0))
SLEEP_S = 0.2
AWAKE_S = 5.0
"""After a start."""


class TagStage(BoardStage):
    """A tag that may sleep; ``fixes`` are those it has said, with the seconds since then."""

    def __init__(self, **settings):
        super().__init__()
        self.fixes, self._begin_ticks = [], self.air.ticks
        packed = pack(BoardSettings(mode=1, rate_hz=0, sleep_ms=round(1000 * SLEEP_S), **settings))
        self.bus.settings = packed.ljust(KEPT_BYTES, b"\0")
        self.board.begin()
        while self.now_s < AWAKE_S:
            self.air.pass_s(10e-3)
            self.step()
        self._begin_ticks = self.air.ticks

    @property
    def now_s(self):
        return to_seconds(self.air.ticks - self._begin_ticks)

    def step(self, before=lambda: None):
        before()
        self.board.turn()
        self.fixes += [(self.now_s, one.fix) for one in self.reports() if isinstance(one, BoardFix)]

    def hear(self, begin_s, end_s, before=lambda: None):
        """Let the site send from now on what it sends from one time to the other; the tag hears it if it is awake."""
        heard, from_ticks = tape(SITE, end_s), self.air.ticks
        for one in heard:
            stamp = from_ticks + wrap(one.rx_ticks - heard[0].rx_ticks) - from_seconds(begin_s)
            end_ticks = stamp + from_seconds(after_rmarker_s(len(one.frame)))
            if end_ticks < self.air.ticks or stamp < from_ticks:
                continue
            while self.air.ticks < end_ticks:
                self.air.pass_s(min(1e-3, to_seconds(end_ticks - self.air.ticks) + 1e-9))
                self.step(before)
            self.chip.receive(one.frame, wrap(stamp), Diagnostics(-80.0, -83.0, 1.0))
            self.step(before)
        return self


@pytest.mark.parametrize("predicts", [0, 1])
def test_a_tag_that_sleeps_says_a_fix_and_sleeps_again(predicts):
    """An advertisement after a sleep has no position from before it."""
    stage = TagStage(predicts=predicts, bluetooth_ms=100).hear(0.0, 3.0)
    assert len(stage.fixes) > 5
    assert stage.chip.asleep_s > 0.9 * SLEEP_S * len(stage.fixes)
    assert not stage.chip.misuse
    ages_ms = [10 * int.from_bytes(data[12:14], "little") for data in stage.bus.advertised]
    assert len(ages_ms) >= len(stage.fixes)
    assert max(ages_ms) < 1000 * SLEEP_S


def test_a_host_that_goes_on_speaking_keeps_the_tag_awake_and_gets_all_its_fixes():
    stage, asked_s = TagStage(), [0.0]

    def ask():
        if stage.now_s > asked_s[-1] + 0.5:
            asked_s.append(stage.now_s)
            stage.send(ASK_TAG_CONFIG)

    stage.hear(0.0, 3.0, ask)
    assert len([at_s for at_s, _ in stage.fixes if at_s > 1.0]) > 500


def test_a_tag_that_was_just_set_up_stays_awake_for_its_host():
    stage = TagStage()
    stage.send(SET_TAG_CONFIG, b"\0" + stage.bus.settings)
    stage.hear(0.0, 3.0)
    assert stage.chip.asleep_s == 0.0


def test_a_host_that_speaks_when_the_chip_sleeps_already_finds_a_tag_that_goes_on():
    stage, asked_s = TagStage(predicts=1), []

    def ask():
        if stage.board.chip.state == OFF and stage.now_s > 1.0 and not asked_s:
            asked_s.append(stage.now_s)
            stage.send(ASK_HELLO)

    stage.hear(0.0, 3.0, ask)
    assert len([at_s for at_s, _ in stage.fixes if 0.1 < at_s - asked_s[0] < 1.1]) > 50
    assert not stage.chip.misuse


def test_the_time_of_fixes_counts_sleeps_without_a_fix_once():
    stage = TagStage().hear(0.0, 1.0)
    before_s, before = stage.fixes[-1]
    while stage.now_s < 45.0:  # it sleeps for 10 s where it hears nothing
        stage.air.pass_s(1e-3)
        stage.step()
    after_s, after = stage.hear(1.0, 3.0).fixes[-1]
    assert after_s > 45.0
    assert after.time_s - before.time_s == pytest.approx(after_s - before_s, abs=0.05)


@pytest.mark.parametrize("predicts", [0, 1])
def test_a_tag_in_a_room_is_awake_after_its_start_and_then_sleeps_between_fixes_that_are_right(predicts):
    request, site, sleep_s = Request(lab_site(), seed=4, room=Room()), lab_site(), 0.4
    world = world_of(site, trajectories_of(request), replace(impairments_of(request, site), diagnostics=True), 4)
    settings = BoardSettings(mode=1, sleep_ms=int(1000 * sleep_s), superframes=2, predicts=predicts)
    fixes, reader = [], Reader()

    def said(now_s, data):
        for found in map(decode, reader.read(data)):
            if isinstance(found, BoardFix):
                error_m = np.linalg.norm((found.fix.position_m - one.truth_m)[:2])
                fixes.append((now_s, error_m, np.inf if found.fix.hpl_m is None else found.fix.hpl_m))

    one = TagWorld(world, HostBoard, said, settings, 1.0)
    one.run(AWAKE_S)
    assert (len(fixes) > 1, one.chip.asleep_s) == (True, 0.0)
    one.run(AWAKE_S + 2 * sleep_s)
    fixes.clear()
    receiving_s, asleep_s = one.chip.receiving_s, one.chip.asleep_s
    one.run(AWAKE_S + 14 * sleep_s)
    times_s, errors_m, levels_m = np.array(fixes).T
    assert 6 <= len(fixes) <= 12
    assert np.diff(times_s).min() > sleep_s
    assert errors_m.max() < 0.5
    assert np.all(errors_m < levels_m)
    assert one.chip.asleep_s - asleep_s > 0.6 * 12 * sleep_s
    assert (one.chip.receiving_s - receiving_s) / len(fixes) < (0.02 if predicts else 0.2)
    assert not +one.chip.misuse
