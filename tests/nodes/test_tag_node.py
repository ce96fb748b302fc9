"""The tag's program on receptions of the simulated lab."""

import asyncio
import bisect

import msgspec
import numpy as np
import pytest
from node_stage import PLACE_M, FakeRadio, receptions

from skyless.air.reception import Reception
from skyless.mqtt.messages import FixMessage
from skyless.nodes.tag import TagNode, TagSettings
from skyless.radios.interface import Gone, Restarted

HEARD = receptions(6.0)


class Bench:
    def __init__(self, **settings):
        self.published, self.said = [], []
        self.now_s = 0.0
        self.node = TagNode(
            TagSettings(**settings), FakeRadio("t1"), self.published.append, self.said.append, clock=lambda: self.now_s
        )
        self.node.fix_log.unix_less_host_s = 1e9

    def hear(self, heard):
        """Receptions that are processed as soon as they have ended."""
        for reception in heard:
            self.now_s = self.now_s if reception.host_s is None else reception.host_s
            self.node.on_event(reception)


def test_fixes_are_right_and_say_when_they_held():
    bench = Bench(publish_hz=1000.0)
    bench.hear(HEARD)
    late = [fix for fix in bench.published if fix.unix_s > 1e9 + 3.0]
    assert len(late) > 1000
    for fix in late:
        error_m = np.linalg.norm(np.subtract(fix.position_m, PLACE_M))
        assert error_m < 6.0 * fix.std_m < 0.5
    ends = {reception.host_s + 1e9 for reception in HEARD}
    assert {fix.unix_s for fix in late} <= ends
    assert bench.node.receptions == len(HEARD)
    serials = [fix.serial for fix in bench.published]
    assert serials == list(range(1, len(serials) + 1))
    assert bench.node.fix_log.serial == serials[-1]
    again = msgspec.json.decode(msgspec.json.encode(late[-1]), type=FixMessage)
    assert again == late[-1]


@pytest.mark.parametrize("publish_hz", [1.0, 7.0, 50.0, 133.0, 399.0])
def test_no_more_fixes_are_published_than_asked_for_on_average_nor_in_any_second(publish_hz):
    bench = Bench(publish_hz=publish_hz)
    bench.hear(HEARD)
    times = [fix.unix_s for fix in bench.published]
    for first, begin_s in enumerate(times):
        assert bisect.bisect_left(times, begin_s + 1.0) - first <= publish_hz + 1
    made_s = times[-1] - times[0]
    assert len(times) - 1 <= publish_hz * made_s + 1.0
    assert len(times) >= min(publish_hz, 395.0) * made_s * 0.95  # and not many fewer
    assert bench.node.fix_log.serial > 1500  # all of them are made


def test_pauses_are_not_made_up_for_by_a_burst():
    heard = [reception for reception in HEARD if not 3.0 < reception.host_s < 4.0]
    bench = Bench(publish_hz=50.0)
    bench.hear(heard)
    times = [fix.unix_s - 1e9 for fix in bench.published]
    assert not any(3.0 < time_s < 4.0 for time_s in times)
    assert sum(4.0 <= time_s < 4.1 for time_s in times) <= 6


def test_a_radio_that_starts_again_gets_a_new_receiver_and_the_numbers_go_on():
    bench = Bench(publish_hz=1000.0)
    bench.node.on_event(Restarted())
    first = bench.node.receiver
    bench.hear(HEARD[:1000])
    fixes = bench.node.fix_log.serial
    assert fixes > 0
    bench.node.on_event(Gone("pulled out"))
    bench.node.on_event(Restarted())
    assert bench.node.receiver is not first
    jump = 2**39  # another counter
    shifted = [Reception(r.frame, (r.rx_ticks + jump) % 2**40, r.host_s, r.diagnostics) for r in HEARD[1000:]]
    bench.hear(shifted)
    assert bench.node.fix_log.serial > fixes + 500
    assert bench.published[-1].serial == bench.node.fix_log.serial
    assert bench.said == ["tag t1: listening", "tag t1: pulled out; still looking for it", "tag t1: listening again"]
    assert bench.node.receiver.counters["counter-jump"] == 0


def test_a_first_start_keeps_the_receiver():
    bench = Bench()
    receiver = bench.node.receiver
    bench.node.on_event(Restarted())
    assert bench.node.receiver is receiver


def test_what_is_done_before_a_reception_sees_the_receiver_before_it():
    seen = []

    def before(receiver, reception, serial):
        seen.append((receiver.counters["heard"], reception, serial))

    node = TagNode(TagSettings(), FakeRadio("t1"), lambda fix: None, lambda line: None, before, lambda: 0.0)
    for reception in HEARD[:300]:
        node.on_event(reception)
    assert [reception for _, reception, _ in seen] == HEARD[:300]
    assert [heard for heard, _, _ in seen] == list(range(300))
    assert seen[-1][2] in {node.fix_log.serial, node.fix_log.serial - 1}


def test_latencies_and_phases_are_kept():
    bench = Bench()
    bench.hear(HEARD[:600])
    median_s, late_s, number = bench.node.fix_log.latencies.drain()
    assert number == bench.node.fix_log.serial
    assert median_s <= late_s
    assert 1 <= len(bench.node.phases.last) <= 6
    assert [phase.slot for phase in bench.node.phases.last] == sorted(phase.slot for phase in bench.node.phases.last)


def test_without_the_host_s_time_a_frame_counts_from_when_it_came():
    bench = Bench(publish_hz=1000.0)
    bench.hear(Reception(r.frame, r.rx_ticks) for r in HEARD[:600])
    assert bench.published
    assert all(fix.latency_s == 0.0 for fix in bench.published)


def test_it_listens_until_it_is_cancelled():
    async def main():
        bench = Bench()
        task = asyncio.ensure_future(bench.node.run())
        await asyncio.sleep(0)
        for reception in HEARD[:50]:
            bench.now_s = reception.host_s
            bench.node.radio.listener(reception)
        task.cancel()
        await asyncio.wait([task])
        assert bench.node.receptions == 50

    asyncio.run(main())
