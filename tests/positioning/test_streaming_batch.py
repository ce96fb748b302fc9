"""What a receiver computes message by message, one compiled loop over arrays computes again, bit for bit."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from skyless.experiments.scenarios import Request, fleet_of
from skyless.positioning.tracker import PseudorangeTracker, track
from skyless.site.lab import ideal_lab_site
from skyless.site.room import room_site

ROOM = room_site(8.0, 6.0, 8, 3.0, None)


def streamed(site, until_s, **request):
    """All that the receiver of a simulated tag gave its tracker, and the state after each."""
    starts, messages, states = [], [], []
    start, hear = PseudorangeTracker.start, PseudorangeTracker.hear

    def spy_start(tracker, *args):
        start(tracker, *args)
        starts.append(
            (len(messages), tracker.x.copy(), tracker.P.copy(), tracker.whole.copy(), tracker.statistics.copy())
        )

    def spy_hear(tracker, *args):
        accepted = hear(tracker, *args)
        messages.append(args)
        states.append(tracker.x.copy())
        return accepted

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PseudorangeTracker, "start", spy_start)
        patch.setattr(PseudorangeTracker, "hear", spy_hear)
        fleet = fleet_of(Request(site, method="tracker", **request))
        for _ in fleet.run(until_s):
            pass
    return starts, messages, np.array(states), fleet.receivers[0].method._tracker


@pytest.mark.parametrize(
    ("site", "request_"),
    [
        (ideal_lab_site(), {"positions_m": ((3.0, 4.0),)}),
        (ideal_lab_site(), {"seed": 3, "speed_mps": 1.5, "loss": 0.3, "nlos": 0.05}),
        (ROOM, {"positions_m": ((3.0, 4.0, 1.2),)}),
    ],
    ids=["static", "walking with obstacles", "3-D"],
)
def test_a_simulated_stream_in_one_loop(site, request_):
    """18 s: the counters wrap on the way."""
    starts, messages, states, tracker = streamed(site, 18.0, **request_)
    assert len(starts) == 1
    _, x, P, whole, statistics = starts[0]
    anchors_m, rx, tx, fraction, variance, _ = (np.array(column) for column in zip(*messages, strict=True))
    batch = np.empty_like(states)
    accepted = track(
        x, P, whole, statistics, tracker.settings, np.zeros(len(x)), np.zeros(len(x)), anchors_m, rx, tx, fraction,
        variance, batch,
    )  # fmt: skip
    assert len(states) > 4000
    assert accepted == tracker.whole[2]
    assert np.array_equal(batch, states)
    assert np.array_equal(P, tracker.P)
    assert np.array_equal(whole, tracker.whole)
    assert np.array_equal(statistics, tracker.statistics)


def positions(until_s=0.25):
    """All positions of a tag by three methods, through anchors, ether and receiver."""
    found = {}
    for method in ("literal", "bracketed", "tracker"):
        fleet = fleet_of(Request(ideal_lab_site(), method=method, positions_m=((3.0, 4.0),)))
        found[method] = [judged.fix.position_m.tolist() for judged in fleet.run(until_s)]
    return found


def test_without_the_compiler_the_whole_simulation_is_the_same_to_rounding():
    """Anchors, ether and tags as plain Python, in a process of their own."""
    script = "import json, test_streaming_batch as t; print(json.dumps(t.positions()))"
    plain = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(Path(__file__).parent)},
        capture_output=True,
        text=True,
        check=True,
    )
    compiled = positions()
    for method, rows in json.loads(plain.stdout).items():
        assert len(rows) > 6
        np.testing.assert_allclose(rows, compiled[method], rtol=0.0, atol=1e-6)
