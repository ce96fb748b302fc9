"""Whole runs packet by packet, in Python and in C: the same outcomes, fixes and states, to the bit.

python tests/native/test_whole_runs.py 112000 1        # number of packets that are sent, seed
"""

import sys
from collections import Counter
from multiprocessing import Pool
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "core"))

from estimator_builders import (
    LAB_M,
    MESH,
    ROOM_M,
    SLOT_S,
    begun,
    episode_of,
    jumped,
    kept,
    late,
    late_from,
    one_by_one,
    settings_of,
)
from test_same_bits import ERRORS, bits

from skyless.core.estimator.process import ACCEPTED, JOINED, REJECTED, STALE, process_frame

pytestmark = pytest.mark.site

OUTCOMES = {ACCEPTED: "accepted", JOINED: "joined", REJECTED: "rejected", STALE: "stale"}


def as_they_are(packets, draw):
    return packets


def with_range_errors(packets, draw):
    """Each anchor's range is wrong by a constant of its own."""
    return late(packets, draw.uniform(-0.05, 0.05, packets.anchors.max() + 1)[packets.anchors])


def with_late_ones(packets, draw):
    """Single packets are late; one anchor is for the second third, another for the last quarter."""
    count = len(packets.anchors)
    some = np.where(draw.random(count) < 0.05, draw.exponential(1.0, count), 0.0)
    packets = late_from(late(with_range_errors(packets, draw), some), 2, 0.5, count // 3, 2 * count // 3)
    return late_from(packets, 4, 1.5, 3 * count // 4)


def with_losses(packets, draw):
    """Half of all is lost; one anchor is silent for the second third, another's clock jumps in the middle."""
    count = len(packets.anchors)
    packets = jumped(packets, 1, count // 2, 30.0)
    is_silent = (packets.anchors == 3) & (np.arange(count) // (count // 3) == 1)
    return kept(packets, (draw.random(count) > 0.5) & ~is_silent)


CASES = {
    "lab": (LAB_M, 0.0, {}, as_they_are),
    "room": (LAB_M, 0.0, ERRORS, with_range_errors),
    "late": (LAB_M, 0.0, ERRORS, with_late_ones),
    "3-D": (ROOM_M, None, ERRORS, with_range_errors),
    "loss": (ROOM_M, 0.0, ERRORS, with_losses),
}
"""Anchors, the tag's height if it is known, errors that the settings expect, and what happens to the packets."""


def walk(anchors_m, height_m, frames, draw):
    """To and fro between the anchors at some 1 m/s, and at rest for the last third; shape (frames, 3)."""
    time_s = np.minimum(np.arange(frames), 2 * frames // 3)[:, None] * SLOT_S
    low_m, high_m = anchors_m.min(axis=0), anchors_m.max(axis=0)
    swing_m = 0.4 * (high_m - low_m) * np.sin(draw.uniform(0.2, 0.4, 3) * time_s + draw.uniform(0.0, 6.0, 3))
    path_m = (low_m + high_m) / 2.0 + swing_m
    if height_m is not None:
        path_m[:, 2] = height_m
    return path_m


def run(name, count, seed):
    """How many of so many packets were accepted and so on; Python and C do the same with each that is received."""
    anchors_m, height_m, errors, changed = CASES[name]
    draw, superframes = np.random.default_rng(seed), count // len(anchors_m)
    path_m = walk(anchors_m, height_m, superframes * len(anchors_m), draw)
    episode = episode_of(MESH, superframes, seed, anchors_m, path_m=path_m)
    settings = settings_of(height_m=height_m, stationary_s=0.5, **errors)
    compiled, plain = begun(episode, settings, anchors_m), begun(episode, settings, anchors_m)
    outcomes = Counter()
    for number, packet in enumerate(one_by_one(changed(episode.packets, draw))):
        outcome = process_frame(plain.state, *plain.packet_of(*packet), b"", 0)
        assert compiled.process(*packet) == outcome, f"packet {number} of {name}"
        assert compiled.rows == plain.rows, f"packet {number} of {name}"
        assert bits(compiled.state) == bits(plain.state), f"packet {number} of {name}"
        outcomes[OUTCOMES[outcome]] += 1
    return outcomes


@pytest.mark.parametrize("name", CASES)
def test_python_and_c_do_the_same_with_every_packet(name):
    assert run(name, 240, 1)["accepted"] > 80


if __name__ == "__main__":
    each, first = int(sys.argv[1]) // len(CASES), int(sys.argv[2])
    with Pool() as pool:
        found = pool.starmap(run, [(case, each, first) for case in CASES])
    for case, outcomes in zip(CASES, found, strict=True):
        print(f"{case}: {dict(outcomes)}")
    print(f"{sum(map(Counter.total, found))} packets received, the same bits after each")
