"""A hostile channel: random, mutated, truncated and spliced frames among valid ones, and radios that stamp nonsense.

20 000 frames for every machine by default; ``SKYLESS_FUZZ_FRAMES=1000000`` for the full run.
"""

import os
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from skyless.core.air.beacon import Beacon, decode
from skyless.core.air.frame import MAX_FRAME_BYTES, Reception
from skyless.core.any_anchor import new_anchor
from skyless.core.any_receiver import AnyReceiver
from skyless.core.protocol1.anchor import Anchor
from skyless.core.site import AnchorSite, ScheduleSite, UnplacedAnchor
from skyless.core.ticks import TICK_RATE_HZ, wrap
from support.bench import EVERY_METHOD, LAB, ROOM, Stage, assert_honest, tape
from support.frames import with_fcs

pytestmark = pytest.mark.site

FRAMES = int(os.environ.get("SKYLESS_FUZZ_FRAMES", "20000"))
NOISE_PER_FRAME = 6
SLOT_TICKS = round(2.5e-3 * TICK_RATE_HZ)


class Noise:
    """Draws hostile frames, most of them with a right FCS."""

    def __init__(self, seed, seeds):
        self.generator = np.random.default_rng(seed)
        self.seeds = seeds

    def frame(self):
        kind = self.generator.integers(5)
        if kind == 0:
            return self.generator.bytes(int(self.generator.integers(0, 140)))
        body = bytearray(self.a_body())
        if kind == 1:
            for _ in range(int(self.generator.integers(1, 4))):
                body[self.generator.integers(len(body))] = self.generator.integers(256)
        elif kind == 2:
            body = body[: self.generator.integers(len(body))]
        elif kind == 3:
            other = self.a_body()
            body = body[: self.generator.integers(len(body))] + other[self.generator.integers(len(other)) :]
        else:  # the fields that matter most: stamps, number, issue, master, flags
            place = int(self.generator.choice([2, 7, 11, 12, 16, 17, 20, 22, 23, 25, 26, 32, 37]))
            body[place : place + 2] = self.generator.bytes(2)
        frame = bytes(body[: MAX_FRAME_BYTES - 2])
        return with_fcs(frame) if self.generator.random() < 0.9 else frame

    def a_body(self):
        return self.seeds[self.generator.integers(len(self.seeds))][:-2]


def mixture(site, seed, count):
    """Valid receptions with hostile ones between them: (reception, truth or None), in order of their stamps."""
    heard = tape(site, 2.0, position=(3.0, 4.0, 1.2) if site is ROOM else (3.0, 4.0, 0.0))
    noise = Noise(seed, [one.frame for one in heard])
    made = 0
    while made < count:
        for one in heard:
            yield one.reception, one.truth_m
            for k in range(NOISE_PER_FRAME):
                rx_ticks = wrap(one.rx_ticks + (k + 1) * (SLOT_TICKS // (NOISE_PER_FRAME + 2)))
                yield Reception(noise.frame(), rx_ticks, one.host_s), None
            made += NOISE_PER_FRAME
            if made >= count:
                return
        yield None, None


@pytest.mark.parametrize("method", EVERY_METHOD)
@pytest.mark.parametrize("site", [LAB, ROOM], ids=["2-D", "3-D"])
@pytest.mark.statistical
def test_a_tag_on_a_hostile_channel(method, site):
    """Nothing raises. Forged frames may cost fixes; valid ones still give them, and once the forger stops, all do."""
    receiver, valid = AnyReceiver(method, site=1), []
    for reception, truth_m in mixture(site, 1, FRAMES // 2):
        if reception is None:
            receiver = AnyReceiver(method, site=1)
            continue
        fix = receiver.hear(reception)
        if fix is not None:
            assert np.isfinite(fix.position_m).all()
            assert np.isfinite(fix.covariance_m2).all()
        if truth_m is not None:
            valid.append(fix is not None)
    assert sum(valid) > 5
    fresh, fixes = tape(site, 4.0, position=(3.0, 4.0, 1.2) if site is ROOM else (3.0, 4.0, 0.0)), 0
    for one in fresh:
        if one.host_s > 2.1:
            fix = receiver.hear(one.reception)
            if fix is not None and one.host_s > 2.5:
                assert_honest(fix, one.truth_m)
                fixes += 1
    assert fixes > 70


def test_an_anchor_on_a_hostile_channel():
    """The machine goes on to send frames that can be sent, and follows its master again."""
    stage_tape = tape(LAB, 2.0)
    noise, anchor = Noise(2, [one.frame for one in stage_tape]), Anchor(LAB, 4)
    sent = made = 0
    while made < FRAMES:
        for one in stage_tape:
            anchor.hear(one.reception)
            for k in range(NOISE_PER_FRAME):
                rx_ticks = wrap(one.rx_ticks + (k + 1) * (SLOT_TICKS // (NOISE_PER_FRAME + 2)))
                anchor.hear(Reception(noise.frame(), rx_ticks, one.host_s))
            made += NOISE_PER_FRAME
            tx_ticks = anchor.next_transmission_ticks(wrap(one.rx_ticks + SLOT_TICKS - 10**6))
            if tx_ticks is not None:
                assert len(anchor.transmission(tx_ticks).frame) <= MAX_FRAME_BYTES
                sent += 1
    assert sent > 0.2 * made / NOISE_PER_FRAME
    for one in tape(LAB, 4.0):
        if one.host_s > 2.1:
            anchor.hear(one.reception)
    assert anchor.clock(None).offset_std_m < 0.05
    assert anchor.clock(None).beacons > 50


@pytest.mark.parametrize("method", ["weighted", "joint"])
def test_a_radio_that_stamps_nonsense(method):
    """Any stamps and host times for any frames; sane again, the tag has fixes within a second."""
    heard, generator = tape(), np.random.default_rng(4)
    noise, receiver, anchor = Noise(3, [one.frame for one in heard]), AnyReceiver(method, site=1), Anchor(LAB, 4)
    for number in range(FRAMES // 4):
        one = heard[number % len(heard)]
        frame = one.frame if number % 2 else noise.frame()
        host_s = None if number % 3 else float(generator.uniform(-1e6, 1e6))
        reception = Reception(frame, int(generator.integers(2**40)), host_s)
        receiver.hear(reception)
        anchor.hear(reception)
        tx_ticks = anchor.next_transmission_ticks(int(generator.integers(2**40)))
        if tx_ticks is not None:
            anchor.transmission(tx_ticks)
    fixes = 0
    for one in tape(LAB, 3.0):
        fix = receiver.hear(one.reception)
        anchor.hear(one.reception)
        if fix is not None and one.host_s > 1.0:
            assert_honest(fix, one.truth_m)
            fixes += 1
    assert fixes > 100
    assert anchor.clock(None).offset_std_m < 0.05


@pytest.mark.parametrize("machine", ["tag", "anchor"])
def test_memory_stays_flat(machine):
    """What 3000 more hostile frames leave behind is less than 256 KiB (the cache of decoded frames is warm by then)."""
    hearer = AnyReceiver(site=1) if machine == "tag" else Anchor(LAB, 4)
    frames = [reception for reception, _ in mixture(LAB, 5, 3000) if reception is not None]
    more = [reception for reception, _ in mixture(LAB, 6, 3000) if reception is not None]
    tracemalloc.start()
    try:
        for reception in frames:
            hearer.hear(reception)
        before = tracemalloc.get_traced_memory()[0]
        for reception in more:
            hearer.hear(reception)
        after = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert after - before < 2**18


STAMPS = st.integers(0, 2**40 - 1)


@settings(max_examples=100)
@given(st.lists(st.tuples(st.binary(max_size=140), STAMPS, st.none() | st.floats(-1e9, 1e9)), max_size=20))
@pytest.mark.statistical
def test_any_bytes_at_any_time(receptions):
    """Random bytes are dropped and counted, and leave no trace in what comes after."""
    heard = tape()[:120]
    receiver, undisturbed, anchor = AnyReceiver(), AnyReceiver(), Anchor(LAB, 4)
    for number, one in enumerate(heard):
        if number < len(receptions):
            reception = Reception(*receptions[number])
            assert receiver.hear(reception) is None
            anchor.hear(reception)
        one_fix, other_fix = receiver.hear(one.reception), undisturbed.hear(one.reception)
        assert (one_fix is None) == (other_fix is None)
        if one_fix is not None:
            assert np.array_equal(one_fix.position_m, other_fix.position_m)
    assert sum(receiver.counters.values()) - sum(undisturbed.counters.values()) == len(receptions)
    assert sum(anchor.counters.values()) == len(receptions)


MAX_ANCHORS = 6


class Noise2(Noise):
    """Hostile frames of protocol 2: periods, stamps and senders of valid beacons, changed."""

    def frame(self):
        if self.generator.random() < 0.3:
            return super().frame()
        body, draw = bytearray(self.a_body()), self.generator
        kind = draw.integers(3)
        if kind == 0:  # another period
            body[19] = int(draw.integers(256))
        elif kind == 1:  # another sender
            body[7:9] = int(draw.integers(1, 9)).to_bytes(2, "little")
        else:  # a stamp that nearly fits
            tx_ticks = int.from_bytes(body[12:17], "little") + int(draw.integers(-200_000, 200_000))
            body[12:17] = wrap(tx_ticks).to_bytes(5, "little")
        return with_fcs(body)


class Recorder:
    """An anchor, and what it receives."""

    def __init__(self, machine, received):
        self.id, self.machine, self.received = machine.id, machine, received
        self.next_transmission_ticks, self.transmission = machine.next_transmission_ticks, machine.transmission

    def hear(self, reception):
        self.received.append(reception)
        self.machine.hear(reception)


@pytest.mark.parametrize("is_placed", [True, False])
def test_machines_of_protocol_2_on_a_hostile_channel(is_placed):
    """Nothing raises, and what is sent can be received."""
    anchors = tuple(AnchorSite(n + 1, 4.0 * n, float(n % 2), 3.0) for n in range(MAX_ANCHORS))
    schedule, received = ScheduleSite(mode="free", rate_hz=160.0), []
    site = replace(LAB, anchors=anchors, master=1, schedule=schedule)
    own = replace(site, anchors=anchors[:3] + anchors[4:], unplaced=(UnplacedAnchor(4),))

    def make(_, anchor):
        machine = new_anchor(site, anchor)
        return Recorder(machine, received) if anchor == 4 else machine

    for _ in Stage(site, make=make).world.run(1.5):
        pass
    noise, tag = Noise2(7, [one.frame for one in received]), AnyReceiver(site=site.id)
    anchor, sent = new_anchor(site if is_placed else own, 4), 0
    for one in received:
        tag.hear(one)
        anchor.hear(one)
        tx_ticks = anchor.next_transmission_ticks(wrap(one.rx_ticks + 10**5))
        for k in range(3):
            false = Reception(noise.frame(), wrap(one.rx_ticks + 10**6 * (k + 1)), one.host_s)
            tag.hear(false)
            anchor.hear(false)
        assert isinstance(decode(anchor.transmission(tx_ticks).frame), Beacon)
        sent += 1
    assert sent > 0.5 * len(received) > 300
