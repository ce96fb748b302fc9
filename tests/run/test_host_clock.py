"""Unix times of recorded receptions after stalls: of the host, which then has a backlog, and of the tag's counter."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from skyless.core.air.frame import Reception
from skyless.core.ticks import TICK_S
from skyless.research.replays.site import SiteReplay
from skyless.run.mqtt import topics
from skyless.run.mqtt.messages import FixMessage, ReceptionsMessage, TrueMotion, TruthMessage
from skyless.run.recordings.recording import HostClock, McapRecording
from support.live_site import PLACES, SITE, UNIX_S, messages, record

pytestmark = pytest.mark.site

_STEP_S = 0.02


def times(moments, unix_less_host_s=UNIX_S):
    """Unix times less ``UNIX_S`` of receptions, each a counter's and a host's time in s; all come out in order."""
    clock, out = HostClock(), []
    for number, (counter_s, host_s) in enumerate(moments):
        ticks = round(counter_s / TICK_S) % (1 << 40)
        out += clock.add(Reception(b"", ticks, host_s), unix_less_host_s, number)
    out += clock.rest()
    assert [number for number, _ in out] == list(range(len(out)))
    return [unix_s - UNIX_S for _, unix_s in out]


delays = st.lists(st.floats(0.0, 0.08), min_size=300, max_size=300)


@given(delays, st.integers(60, 250), st.floats(0.3, 30.0))
@pytest.mark.statistical
def test_a_counter_that_stood_still_is_tied_again(late_s, stalled_at, stall_s):
    """The emulated air was stopped, or the host's clock set: all later times are later, none is between."""
    late_s[0] = late_s[stalled_at] = 0.0
    at_s = [_STEP_S * k + (stall_s if k >= stalled_at else 0.0) for k in range(300)]
    found = times([(_STEP_S * k, at_s[k] + late_s[k]) for k in range(300)])
    assert max(abs(a - b) for a, b in zip(found, at_s, strict=True)) < 0.09


@given(st.integers(60, 200), st.floats(0.3, 8.0))
def test_a_backlog_of_a_stopped_host_keeps_its_times(stalled_at, stall_s):
    """The counter went on; all that came meanwhile is read at once."""
    stalled = range(stalled_at, stalled_at + round(stall_s / _STEP_S))
    end_s = _STEP_S * (stalled[-1] + 1)
    moments = [(_STEP_S * k, end_s if k in stalled else _STEP_S * k) for k in range(stalled[-1] + 100)]
    found = times(moments)
    assert max(abs(at_s - counter_s) for at_s, (counter_s, _) in zip(found, moments, strict=True)) < 1e-2


@pytest.mark.parametrize("stall_s", [0.5, 5.0, 40.0])
def test_what_comes_shortly_before_the_end_is_timed_too(stall_s):
    moments = [(_STEP_S * k, _STEP_S * k + (stall_s if k >= 100 else 0.0)) for k in range(110)]
    assert times(moments)[-1] == pytest.approx(moments[-1][1], abs=1e-3)


def test_receptions_without_a_host_time_keep_their_counter():
    assert times([(1.0, None), (2.0, None)]) == pytest.approx([1.0 - UNIX_S, 2.0 - UNIX_S])
    assert times([(1.0, 1.5), (2.0, None)]) == pytest.approx([1.5, 2.5], abs=1e-3)


def test_a_forged_recording_holds_back_a_bounded_number():
    clock, out = HostClock(), 0
    for number in range(25_000):
        out += len(clock.add(Reception(b"", 0, 1.0 if number else 0.0), 0.0, None))
    assert 25_000 - out <= 10_001


def test_a_replay_judges_after_a_stall_of_the_air_as_the_live_run_did(tmp_path):
    """Its fixes have the times of the recorded ones; the truth of the stall is used for none of them."""
    stall_s, stalled_s = 4.0, 1.5
    path = tmp_path / "stalled.mcap"
    heard = [one for one in messages(3.5, join_s=0.0) if not one[1].endswith("/truth")]
    said = [_after_a_stall(*one, stalled_s, stall_s) for one in heard]
    far = {"a": TrueMotion((30.0, 30.0, 0.0), (0.0, 0.0, 0.0))}
    here = {"a": TrueMotion(PLACES["a"], (0.0, 0.0, 0.0))}
    for k in range(80):
        is_stalled = stalled_s + 0.1 < 0.1 * k < stalled_s + stall_s - 0.1
        truth = TruthMessage(UNIX_S + 0.1 * k, far if is_stalled else here)
        said.append((truth.unix_s, topics.truth_topic(SITE.id), msgspec.json.encode(truth)))
    record(path, sorted(said, key=lambda one: one[0]))
    live = {}
    for _, topic, payload in said:
        if topic.endswith("/fix"):
            fix = msgspec.json.decode(payload, type=FixMessage)
            live[fix.position_m] = fix.unix_s
    found = {}
    with McapRecording(path) as recording:
        replay = SiteReplay(recording, settle_s=0.3)
        (report,) = replay.run(lambda _, unix_s, fix: found.update({tuple(fix.position_m): unix_s}), lambda _: None)
    assert report.fixes == len(found) > 200
    assert max(abs(at_s - live[position_m]) for position_m, at_s in found.items()) < 0.01
    assert report.max_2d_m < 0.3


def _after_a_stall(unix_s, topic, payload, stalled_s, stall_s):
    """A message as it would be had the air stood still."""
    if topic.endswith("/fix"):
        fix = msgspec.json.decode(payload, type=FixMessage)
        late_s = stall_s if fix.unix_s >= UNIX_S + stalled_s else 0.0
        return unix_s + late_s, topic, msgspec.json.encode(replace(fix, unix_s=fix.unix_s + late_s))
    if topic.endswith("/receptions"):
        message = msgspec.json.decode(payload, type=ReceptionsMessage)
        later = tuple(
            replace(one, host_s=one.host_s + (stall_s if one.host_s >= stalled_s else 0.0))
            for one in message.receptions
        )
        late_s = stall_s if later[-1].host_s > stalled_s else 0.0
        return unix_s + late_s, topic, msgspec.json.encode(replace(message, receptions=later))
    return unix_s, topic, payload
