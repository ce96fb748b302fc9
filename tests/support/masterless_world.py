"""Captures of Bitcraze's two systems in a simulated hall whose truth is known; oscillators are the radio world's.

Eight anchors at its corners, 9 m × 7 m × 3 m. TDoA2: slots of 2²⁷ ticks, eight to a frame. TDoA3: random times, 30 Hz
an anchor on average. Nodes stamp with 100 ps. All stamps hold antenna delays, some 32 930 ticks of TX and RX together,
and so do the flights that anchors tell. Payloads are those of ``capture_makers``, not of the code under test.
"""

from itertools import product
from math import cos, dist, sin

import numpy as np

from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_RATE_HZ
from skyless.sim.oscillator import OscillatorModel, advance, make_clocks
from skyless.sim.streams import Streams
from support.capture_makers import binary_record, tdoa2, tdoa3

ANCHORS_M = dict(enumerate(product((0.0, 9.0), (0.0, 7.0), (0.3, 2.7))))
TAG = 8
SLOT_S = 2**27 / TICK_RATE_HZ
STAMP_TICKS = 100e-12 * TICK_RATE_HZ
DELAY_TICKS = 16_465
TOLD_TICKS = 6.0
"""Scatter of told flights."""


def path_m(t_s, speed_mps, rest_s=0.0):
    """A circle of 2 m about the middle, 1.2 m high, after a rest on it; at rest with no speed."""
    angle = 0.7 + speed_mps * max(t_s - rest_s, 0.0) / 2.0
    return 4.5 + 2.0 * cos(angle), 3.5 + 2.0 * sin(angle), 1.2


class MasterlessWorld:
    """Oscillators, antenna delays and the air between the nodes; node ``TAG`` listens."""

    def __init__(self, seed, speed_mps=0.0, random_walk_fm=1e-9, delay_scatter_ticks=20.0, rest_s=0.0):
        self.random = np.random.default_rng(seed)
        generators = [np.random.default_rng([seed, node]) for node in range(2 * TAG + 2)]
        self.clocks = make_clocks(OscillatorModel(random_walk_fm=random_walk_fm), generators[: TAG + 1])
        self.streams = Streams(generators[TAG + 1 :])
        self.speed_mps, self.rest_s = speed_mps, rest_s
        scatter = self.random.normal(0.0, delay_scatter_ticks / 2.0, (TAG + 1, 2))
        self.delays = DELAY_TICKS + scatter  # of TX and RX
        self.late_m = {}
        """By how much the tag hears an anchor late: anchor → (from_s, to_s, metres)."""

    def read(self, node, t_s):
        """A node's counter at a true time, whole ticks."""
        whole = int(t_s * TICK_RATE_HZ)
        fraction = t_s * TICK_RATE_HZ - whole
        clock, noise = self.clocks[node], self.streams.noise[node]
        advance(clock, noise, whole, fraction)
        self.streams.refill(noise.used)
        return clock.local_ticks + round(clock.local_fraction)

    def noise(self):
        return self.random.normal(0.0, STAMP_TICKS)

    def flight(self, sender, place_m):
        return dist(ANCHORS_M[sender], place_m) / SPEED_OF_LIGHT_MPS * TICK_RATE_HZ

    def send(self, sender, t_s):
        """A packet: its TX stamp, and the RX stamp of every node that heard it."""
        tx_ticks = self.read(sender, t_s)
        late = self.delays[sender, 0] + self.noise()
        places = dict(ANCHORS_M) | {TAG: path_m(t_s, self.speed_mps, self.rest_s)}
        rx_ticks = {}
        for node, place_m in places.items():
            if node != sender:
                arrival = late + self.flight(sender, place_m) + (self._blocked(sender, t_s) if node == TAG else 0.0)
                stamp = self.read(node, t_s + arrival / TICK_RATE_HZ)
                rx_ticks[node] = stamp + round(self.delays[node, 1] + self.noise())
        return tx_ticks, rx_ticks

    def _blocked(self, sender, t_s):
        from_s, to_s, metres = self.late_m.get(sender, (0.0, 0.0, 0.0))
        return metres / SPEED_OF_LIGHT_MPS * TICK_RATE_HZ if from_s <= t_s < to_s else 0.0

    def told(self, one, other):
        """A flight as two anchors range it."""
        delays = (self.delays[one].sum() + self.delays[other].sum()) / 2.0
        return round(self.flight(one, ANCHORS_M[other]) + delays + self.random.normal(0.0, TOLD_TICKS))


def low(ticks, bits=32):
    return ticks % (1 << bits)


def tdoa3_capture(world, seconds, rate_hz=30.0, told=True):
    """(true time, sender, the tag's RX stamp, payload)."""
    heard = {anchor: {} for anchor in ANCHORS_M}
    due = {anchor: world.random.uniform(0.0, 1.0 / rate_hz) for anchor in ANCHORS_M}
    sequences = dict.fromkeys(ANCHORS_M, 100)
    t_s = 0.0
    while t_s < seconds:
        sender = min(due, key=due.__getitem__)
        t_s = max(due[sender], t_s + 0.0004)  # who hears another waits
        due[sender] = t_s + world.random.uniform(0.6, 1.4) / rate_hz
        relays = [(anchor, *kept) for anchor, kept in heard[sender].items()]
        heard[sender] = {}
        sequence = sequences[sender] = (sequences[sender] + 1) % 128
        tx_ticks, rx_ticks = world.send(sender, t_s)
        yield t_s, sender, low(rx_ticks[TAG], 40), tdoa3(sequence, low(tx_ticks), relays)
        for other in ANCHORS_M:
            if other != sender:
                distance = world.told(other, sender) if told else None
                heard[other][sender] = (sequence, low(rx_ticks[other]), distance)


def tdoa2_capture(world, seconds, told=True):
    """(true time, sender, the tag's RX stamp, payload)."""
    stamps = {anchor: [0] * 8 for anchor in ANCHORS_M}
    heard = {anchor: [0] * 8 for anchor in ANCHORS_M}
    for slot in range(int(seconds / SLOT_S)):
        sender, sequence, t_s = slot % 8, (slot // 8 + 250) % 256, slot * SLOT_S
        tx_ticks, rx_ticks = world.send(sender, t_s)
        stamps[sender][sender], heard[sender][sender] = low(tx_ticks), sequence
        flights = [world.told(sender, other) if told and other != sender else 0 for other in ANCHORS_M]
        yield t_s, sender, low(rx_ticks[TAG], 40), tdoa2(heard[sender], stamps[sender], flights)
        for other in ANCHORS_M:
            if other != sender:
                stamps[other][sender], heard[other][sender] = low(rx_ticks[other]), sequence


CAPTURES = {"tdoa2": tdoa2_capture, "tdoa3": tdoa3_capture}


def write_capture(path, records):
    """As Bitcraze's sniffer writes it, binary."""
    path.write_bytes(b"".join(binary_record(sender, rx_ticks, payload) for _, sender, rx_ticks, payload in records))
    return path


def anchors_csv():
    return "id,x_m,y_m,z_m\n" + "".join(f"{n},{x},{y},{z}\n" for n, (x, y, z) in ANCHORS_M.items())


def truth_csv(until_s, speed_mps, begun_s=0.0):
    """Times count from the first packet, as a replay's do."""
    times_s = (0.01 * k for k in range(int(100 * until_s) + 100))
    lines = ("{:.3f},{:.5f},{:.5f},{:.5f}\n".format(t_s, *path_m(t_s + begun_s, speed_mps)) for t_s in times_s)
    return "t_s,x_m,y_m,z_m\n" + "".join(lines)
