"""Receptions per second of ``skyless replay``, decoding and filter together, beside a filter in plain NumPy."""

import time

import numpy as np
import pytest
from plain_filter import PlainFilter

import synthetic_recordings as synthetic
from skyless.experiments.judge import Judge
from skyless.experiments.replay import Replay, ReplayRequest
from skyless.positioning.pair_state import PairSettings
from skyless.positioning.pair_tracker import PairTracker, track_pairs

ROWS = {"tdoa-table": 100_000, "miluv": 20_000, "avalue": 10_000}
PACKETS = 20_000


@pytest.fixture(scope="session")
def plain_per_s():
    """Differences per second of the plain filter, which follows the tag."""
    places = {anchor: np.array(place) for anchor, place in synthetic.ANCHORS_M.items()}
    rows = list(synthetic.tdoa_rows(10_000))
    plain = PlainFilter(np.array(synthetic.place_m(0.0)))
    started_s = time.perf_counter()
    for _, a, b, tdoa_m in rows:
        plain.hear(places[a], places[b], synthetic.PERIOD_S, tdoa_m)
    elapsed_s = time.perf_counter() - started_s
    assert np.linalg.norm(plain.x[:3] - synthetic.place_m(rows[-1][0])) < 0.5
    return len(rows) / elapsed_s


@pytest.mark.parametrize("name", synthetic.MAKERS)
def test_replay(benchmark, tmp_path, plain_per_s, name):
    rows = ROWS.get(name, PACKETS)
    path = synthetic.write(tmp_path / "recording", name, rows)
    listener = synthetic.LISTENER.get(name, [None])[-1]
    request = ReplayRequest(path=path, anchors_m=synthetic.ANCHORS_M, listener=listener)

    def replay():
        return Replay(request, Judge(None, planar=False)).run(None, lambda _: None)

    report = benchmark.pedantic(replay, rounds=5, warmup_rounds=1)
    assert report.fixes > 0.98 * rows
    per_s = rows / benchmark.stats.stats.min
    differences = sum(pair.count for pair in report.pairs)
    benchmark.extra_info.update(
        receptions_per_s=round(per_s),
        differences_per_s=round(per_s * differences / rows),
        plain_numpy_differences_per_s=round(plain_per_s),
        ratio=round(per_s * differences / rows / plain_per_s, 1),
    )


def test_pair_filter_in_batch(benchmark, plain_per_s):
    rows = list(synthetic.tdoa_rows(100_000))
    a_m, b_m = (np.array([synthetic.ANCHORS_M[row[side]] for row in rows]) for side in (1, 2))
    dt_s, tdoa_m = np.full(len(rows), synthetic.PERIOD_S), np.array([row[3] for row in rows])
    states = np.empty((len(rows), 6))

    def batch():
        tracker = PairTracker(PairSettings())
        tracker.start(np.array(synthetic.place_m(0.0)), np.eye(3), 1.0)
        a, b = (np.array([tracker.slot(row[side]) for row in rows]) for side in (1, 2))
        return track_pairs(tracker.arrays, a, b, a_m, b_m, dt_s, tdoa_m, states)

    assert benchmark.pedantic(batch, rounds=5, warmup_rounds=1) > 0.95 * len(rows)
    per_s = len(rows) / benchmark.stats.stats.min
    benchmark.extra_info.update(differences_per_s=round(per_s), ratio=round(per_s / plain_per_s, 1))
