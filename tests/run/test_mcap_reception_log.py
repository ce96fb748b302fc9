"""What a tag keeps for those who record it: whole runs, each with the receiver's settings before it."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.air.frame import Diagnostics, Reception
from skyless.core.any_receiver import AnyReceiver
from skyless.research.replays.site import reception_of
from skyless.run.mqtt.messages import RawReception, ReceptionsMessage, RequestMessage
from skyless.run.recordings.reception_log import MAX_PENDING_RECEPTIONS, ReceptionLog, raw, receiver_settings
from support.bench import LAB, tape

pytestmark = pytest.mark.site

SETTINGS = receiver_settings("joint")
HEARD = [one.reception for one in tape(LAB, 2.0)]


def ask(by="r", receptions=("*",), lease_s=5.0):
    return RequestMessage(by, receptions, lease_s)


class Bench:
    """A tag's day: receptions 2.5 ms apart, collected every 20 ms."""

    def __init__(self):
        self.log = ReceptionLog("a", SETTINGS, "run")
        self.receiver = AnyReceiver()
        self.now_s = 100.0
        self.messages = []

    def hear(self, receptions):
        for number, reception in enumerate(receptions):
            self.log.add(self.receiver, reception)
            self.now_s += 0.0025
            if number % 8 == 0:
                self.collect()

    def collect(self):
        while (message := self.log.collect(self.now_s, 0.5)) is not None:
            self.messages.append(msgspec.json.decode(msgspec.json.encode(message), type=ReceptionsMessage))


def segments(messages):
    found = {}
    for message in messages:
        run = found.setdefault(message.segment, [])
        assert (message.start is None) == bool(run)
        assert message.first == sum(len(m.receptions) for m in run)
        run.append(message)
    return list(found.values())


def flat(run):
    return [one for message in run for one in message.receptions]


def test_nothing_is_kept_until_somebody_asks():
    bench = Bench()
    bench.hear(HEARD[:100])
    bench.log.request(ask(receptions=("b",)), bench.now_s)
    bench.hear(HEARD[100:200])
    assert bench.messages == []
    assert not bench.log.wanted


def test_a_lease_gives_one_whole_run():
    bench = Bench()
    bench.hear(HEARD[:300])
    bench.log.request(ask(), bench.now_s)
    bench.hear(HEARD[300:400])
    bench.log.request(ask(), bench.now_s)
    bench.hear(HEARD[400:500])
    bench.log.interrupt()
    bench.collect()
    (run,) = segments(bench.messages)
    assert flat(run) == [raw(reception) for reception in HEARD[300:500]]
    assert all(20 <= len(message.receptions) <= 60 for message in run[:-1])
    assert run[0].start.settings == SETTINGS


def test_a_lease_that_ended_and_one_who_joins_begin_other_segments():
    bench = Bench()
    bench.log.request(ask(lease_s=0.1), bench.now_s)
    bench.hear(HEARD[:100])  # 0.25 s
    assert len(flat(bench.messages)) < 60
    assert not bench.log.wanted
    bench.log.request(ask(lease_s=9.0), bench.now_s)
    bench.hear(HEARD[100:150])
    bench.log.request(ask("another", ("a",)), bench.now_s)
    bench.hear(HEARD[150:200])
    bench.log.request(ask("another", ("a",)), bench.now_s)
    bench.log.request(ask("another", ()), bench.now_s)
    bench.hear(HEARD[200:250])
    bench.now_s += 1.0
    bench.collect()
    _first, second, third = segments(bench.messages)
    assert flat(second) == [raw(reception) for reception in HEARD[100:150]]
    assert flat(third) == [raw(reception) for reception in HEARD[150:250]]
    assert len({message.segment for message in bench.messages}) == 3


def test_a_log_that_nobody_collects_takes_no_memory():
    log, receiver = ReceptionLog("a", SETTINGS, "run"), AnyReceiver()
    log.request(ask(lease_s=60.0), 0.0)
    for _ in range(2 * MAX_PENDING_RECEPTIONS + 3):
        log.add(receiver, HEARD[0])
    assert log.counters["not-collected"] == 2 * MAX_PENDING_RECEPTIONS
    message = log.collect(1.0, 0.0)
    assert message is not None
    assert len(message.receptions) == 3
    assert message.start is not None
    assert log.collect(1.0, 0.0) is None


@given(
    st.sampled_from([None, Diagnostics(-80.5, -81.25, 3.0)]),
    st.one_of(st.none(), st.floats(0.0, 1.0, exclude_max=True)),
)
def test_raw_receptions_keep_every_bit(diagnostics, phase_cycles):
    reception = Reception(bytes(range(127)), (1 << 40) - 1, 0.1 + 1.7e9, diagnostics, phase_cycles)
    again = msgspec.json.decode(msgspec.json.encode(raw(reception)), type=RawReception)
    assert again == raw(reception)
    assert reception_of(again) == reception


def test_receptions_of_an_older_recording_have_no_phase():
    old = msgspec.json.decode(b'["AAAA", 5, 1.5, -80.5, -81.25, 3.0]', type=RawReception)
    assert reception_of(old) == Reception(bytes(3), 5, 1.5, Diagnostics(-80.5, -81.25, 3.0))


@pytest.mark.parametrize("phase_cycles", [-0.001, 1.0, 1e300])
def test_no_radio_gives_such_a_phase(phase_cycles):
    assert reception_of(RawReception(b"frame", 5, 1.0, carrier_phase_cycles=phase_cycles)) is None
