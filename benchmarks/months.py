"""Months of messages through a filter: ``python benchmarks/months.py joint|joint_mesh [MESSAGES]``.

A minute of a tag that stands still, seven nodes, crystals of up to 20 ppm, is drawn once and heard again and again on
counters that go on. A hundred times on the way the covariance must be symmetric to the bit, positive and as large as
in the beginning, and the position where the tag is. A line of JSON tells the worst of it; a failure ends the run.
"""

import json
import sys
import time

import numpy as np

from skyless.core.estimator.estimator import Estimator, Packets
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.estimator.state import covariances
from skyless.core.native.records import view
from skyless.core.ticks import TICK_M, TICK_RATE_HZ, TICK_S

NODES, SUPERFRAMES, SLOT_TICKS = 7, 2048, round(5e-3 * TICK_RATE_HZ)
TAG_M = np.array([3.0, 4.0, 0.0])
ANGLES = 2.0 * np.pi * np.arange(NODES) / NODES
ANCHORS_M = np.column_stack([3.0 + 4.0 * np.cos(ANGLES), 4.0 + 5.0 * np.sin(ANGLES), np.zeros(NODES)])
NOISE_M = 0.03
EXACT = EstimatorSettings(qa=0.3, height_m=0.0, survey_std_m=0.0, range_std_m=0.0, slope_std_m=0.0, place_std_m=0.0)
CHECKS = 100


class Minute:
    """Receptions of 72 s, and how far every counter goes in that time."""

    def __init__(self):
        self.count = SUPERFRAMES * NODES
        draw = np.random.default_rng(1)
        period = self.tag_step = self.count * SLOT_TICKS
        self.senders = np.arange(self.count) % NODES
        self.steps = np.array([round(period * (1.0 + ppm * 1e-6)) for ppm in draw.uniform(-20.0, 20.0, NODES)])
        sent_m, noise_m = draw.normal(0.0, NOISE_M, (2, self.count))
        ideal = np.arange(self.count) * SLOT_TICKS
        flight_m = np.linalg.norm(ANCHORS_M - TAG_M, axis=1)
        self.tx_ticks = np.array([self.reading(k, sender) for k, sender in enumerate(self.senders)])
        self.rx_ticks = ideal + np.rint((flight_m[self.senders] + sent_m + noise_m) / TICK_M).astype(np.int64)
        self.way_m = np.linalg.norm(ANCHORS_M[:, None] - ANCHORS_M[None], axis=2)
        self.arrived_m = sent_m[:, None] + self.way_m[self.senders] + draw.normal(0.0, NOISE_M, (self.count, NODES))

    def reading(self, k, node):
        """What a node's counter shows when packet k leaves, in ticks (the products do not fit into 64 bits)."""
        return k * SLOT_TICKS * int(self.steps[node]) // self.tag_step

    def relays(self, mesh):
        """What each packet tells of the packets since the sender's own last one, and where each packet's share ends."""
        rows, ends = [], []
        for k, sender in enumerate(self.senders):
            for heard in range(max(0, k - NODES + 1), k):
                if mesh or self.senders[heard] == 0:
                    stamp = self.reading(heard, sender) + round(self.arrived_m[heard, sender] / TICK_M)
                    rows.append((sender, self.senders[heard], heard // NODES % 256, stamp))
            ends.append(len(rows))
        return np.array(rows, np.int64), np.array(ends)


class Joint:
    def __init__(self, mesh):
        minute = Minute()
        relays, ends = minute.relays(mesh)
        sequences = np.arange(minute.count) // NODES % 256
        self.minute, self.count = minute, minute.count
        self.packets = Packets(minute.senders, sequences, minute.rx_ticks, minute.tx_ticks, relays, ends)
        self.filter = Estimator(EXACT, ANCHORS_M)
        self.filter.start(0, TAG_M[:2], 1e-2 * np.eye(2), 0.01)

    def once(self):
        p = self.packets
        self.filter.track(p)
        p.rx_ticks[:] += self.minute.tag_step
        p.tx_ticks[:] += self.minute.steps[p.anchors]
        p.relays[:, 3] += self.minute.steps[p.relays[:, 0]]

    def state(self):
        s = self.filter.state
        clocked = s.layout.tx_noise
        return view(s.x)[:clocked], covariances(s)[:clocked, :clocked], s.status.rejected

    def position(self):
        return self.filter.motion()[0][:2]


def check(run, early):
    """The smallest eigenvalue of the correlations, the largest change of a variance, the error; raises if unsound."""
    x, P, _ = run.state()
    assert np.isfinite(x).all(), "the state is not finite"
    assert np.isfinite(P).all(), "the covariance is not finite"
    assert np.array_equal(P, P.T), "the covariance is not symmetric"
    scale = np.sqrt(np.diag(P))
    least = np.linalg.eigvalsh(P / np.outer(scale, scale)).min()
    growth = np.abs(np.diag(P) / early - 1.0).max()
    error_m = np.linalg.norm(run.position() - TAG_M[:2])
    assert least > 1e-9, f"the covariance is not positive: {least}"
    assert growth < 0.05, f"variances have changed by {growth:.0%}"
    assert error_m < 0.2, f"the position is {error_m:.2f} m off"
    return least, growth, error_m


def main():
    kind = sys.argv[1]
    wanted = int(float(sys.argv[2])) if len(sys.argv) > 2 else 10**9
    run = Joint(kind == "joint_mesh")
    rounds = -(-wanted // run.count)
    every = max(1, rounds // CHECKS)
    started_s, early, found = time.perf_counter(), None, []
    for number in range(1, rounds + 1):
        run.once()
        early = np.diag(run.state()[1]).copy() if early is None else early
        if number % every == 0 or number == rounds:
            found.append(check(run, early))
    least, growth, error_m = np.array(found).T
    count = rounds * run.count
    told = {"kernel": kind, "messages": count, "days": round(count * SLOT_TICKS * TICK_S / 86400.0, 1)}
    told |= {"checks": len(found), "states": len(early), "rejected": run.state()[2], "symmetric_to_the_bit": True}
    told |= {"least_eigenvalue": least.min(), "largest_change_of_a_variance": growth.max()}
    told |= {"largest_error_m": error_m.max(), "seconds": round(time.perf_counter() - started_s, 1)}
    print(json.dumps(told))


if __name__ == "__main__":
    main()
