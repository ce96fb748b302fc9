"""Messages per second of ``joint``'s kernels on one core, and of the tracker's: ``python benchmarks/joint_speed.py``.

Seven nodes in the lab's room, 2.1 ms slots; with the stamps of the tag and of the master only, and with mesh
receptions. Other work on the machine only ever takes away, so the best of several short runs counts, by the thread's
own time and by the clock.
"""

import os
import time

import numpy as np

from skyless.constants import SPEED_OF_LIGHT_MPS, TICK_M
from skyless.experiments.studies.episodes import Case, draw_episode
from skyless.positioning.joint import JointFilter, JointSettings
from skyless.positioning.joint_state import states
from skyless.positioning.tracker import PseudorangeTracker, TrackerSettings, track

SLOT_S = 2.1e-3
SUPERFRAMES = 1000
ROUNDS = 25
ANGLES = 2.0 * np.pi * np.arange(7) / 7.0
ANCHORS_M = np.column_stack([3.0 + 4.0 * np.cos(ANGLES), 4.0 + 5.0 * np.sin(ANGLES), np.zeros(7)])


def best_of(run, rounds=ROUNDS):
    """Least seconds of the thread's own time, and of the clock."""
    times = []
    for _ in range(rounds):
        prepared = run.prepare()
        clock_s, own_s = time.perf_counter(), time.thread_time()
        run(prepared)
        times.append((time.thread_time() - own_s, time.perf_counter() - clock_s))
    return np.min(times, axis=0)


class Joint:
    """Batch of the joint filter."""

    def __init__(self, mesh, height_m=0.0):
        case = Case(mesh=mesh, qa=0.0)
        self.episode = draw_episode(np.random.default_rng(1), ANCHORS_M, SLOT_S, case, SUPERFRAMES)
        self.messages = self.episode.messages
        self.count = len(self.messages.sites)
        self.settings = JointSettings(height_m=height_m)

    def prepare(self):
        joint = JointFilter(self.settings, ANCHORS_M)
        dim = joint.dim
        joint.start(int(self.messages.rx_ticks[0]), self.episode.path_m[0, :dim], 0.09 * np.eye(dim), 0.16)
        self.last = joint
        return joint

    def __call__(self, joint):
        joint.track(self.messages)

    def stream(self):
        """Seconds per message, one call each."""
        m, joint = self.messages, self.prepare()
        begin = [0, *m.ends[:-1].tolist()]
        rows = [m.relays[a:b] for a, b in zip(begin, m.ends.tolist(), strict=True)]
        packets = list(
            zip(m.sites.tolist(), m.sequences.tolist(), m.rx_ticks.tolist(), m.tx_ticks.tolist(), rows, strict=True)
        )
        started_s = time.thread_time()
        for packet in packets:
            joint.hear(*packet)
        return (time.thread_time() - started_s) / len(packets)


class Tracker:
    """Batch of the tracker, on the same receptions."""

    def __init__(self):
        m = Joint(mesh=False).messages
        self.count = len(m.sites)
        ranges = np.linalg.norm(ANCHORS_M[m.sites] - [3.0, 4.0, 0.0], axis=1)
        noise = np.random.default_rng(1).normal(0.0, 100e-12 * SPEED_OF_LIGHT_MPS, self.count)
        tx_ticks = m.rx_ticks - np.rint((ranges + noise) / TICK_M).astype(np.int64)
        self.arrays = (ANCHORS_M[m.sites], m.rx_ticks, tx_ticks, np.zeros(self.count), np.full(self.count, 1e-4))

    def prepare(self):
        tracker = PseudorangeTracker(TrackerSettings(height_m=0.0))
        tracker.start(int(self.arrays[1][0]), 0, np.array([3.0, 4.0, 0.0]), 0.01 * np.eye(3), 0.0, 1.0, 1.0)
        return tracker

    def __call__(self, t):
        state = (t.x, t.P, t.whole, t.statistics, t.settings, t.h, t.ph)
        track(*state, *self.arrays, np.empty((self.count, 6)))


def main():
    print(
        f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores; best of {ROUNDS} runs of {SUPERFRAMES * 7} messages"
    )
    runs = [("tracker", Tracker()), ("joint", Joint(mesh=False)), ("joint, mesh", Joint(mesh=True))]
    runs += [("joint, 3-D", Joint(mesh=False, height_m=None)), ("joint, 3-D, mesh", Joint(mesh=True, height_m=None))]
    for name, run in runs:
        own_s, clock_s = best_of(run) / run.count
        size = f"{states(run.last.arrays):3} states" if isinstance(run, Joint) else "  6 states"
        print(f"{name:18} {size} {1e9 * own_s:7.0f} ns  {1e-6 / own_s:6.2f} million/s  (clock {1e-6 / clock_s:.2f})")
    for name, run in runs[1:3]:
        print(f"{name:18} streaming from Python {1e6 * min(run.stream() for _ in range(5)):.2f} µs a message")


if __name__ == "__main__":
    main()
