"""Receptions per second of ``skyless replay``, decoding and filter together, beside a filter in plain NumPy."""

import time

import numpy as np
import pytest
from plain_filter import PlainFilter

import synthetic_recordings as synthetic
from skyless.research.replays.captures import CaptureReplay
from skyless.research.replays.options import ReplayOptions

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
    asked = ReplayOptions(path, anchors=synthetic.ANCHORS_M, tag_height_m="free", listener=listener)

    def replay():
        return CaptureReplay(asked).run(None, lambda _: None)

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
