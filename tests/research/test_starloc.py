"""Two-way exchanges of STARLOC as differences of ranges, with anchors and truth from the files."""

from math import dist

import pytest

import skyless
from skyless.research.foreign import datasets as starloc
from skyless.research.foreign.formats import open_recording

TICK_NS = 1e3 / (499.2 * 128)
MARKERS = {12: (0.0, 0.0, 2.0), 15: (4.0, 0.0, 1.0)}
TAG_M = (1.0, 2.0, 1.5)
HEAD = ",".join((*starloc.COLUMNS, "tag_pos_x", "tag_pos_y", "tag_pos_z")) + "\n"


def exchange(t_s, anchor, tag=1, place_m=TAG_M, rate=5e-6):
    """A row: the tag's clock is faster than the anchor's by ``rate``, and both counters wrap at 2³² ticks."""
    flight_ns = dist(place_m, MARKERS[{4: 12, 5: 15}[anchor]]) / 0.299702547
    sent_ns = 67_108_000.0  # shortly before the counters wrap
    times_ns = (0.0, flight_ns, 300_000.0 + flight_ns, 300_000.0 + 2 * flight_ns)
    times_ns = (*times_ns, 2_000_000.0, 2_000_000.0 + flight_ns)
    tags = (True, False, False, True, False, True)
    ticks = ((sent_ns + t * (1 + rate if of_tag else 1)) / TICK_NS for t, of_tag in zip(times_ns, tags, strict=True))
    stamps = (round(one) % 2**32 * TICK_NS for one in ticks)
    return ",".join(map(str, (t_s, tag, anchor, *stamps, *place_m))) + "\n"


@pytest.fixture
def file(tmp_path):
    folder = tmp_path / "walk_s1"
    folder.mkdir()
    (tmp_path / "mocap").mkdir()
    table = "".join(f"{marker},{x},{y},{z}\n" for marker, (x, y, z) in MARKERS.items())
    (tmp_path / "mocap" / "uwb_markers_v1.csv").write_text(",x,y,z\n" + table)
    rows = [
        exchange(1.0, 4),
        exchange(1.005, 5, tag=2),
        exchange(1.01, 5),
        exchange(1.2, 4),
        "1.21,1,5" + ",x" * 9 + "\n",
    ]
    (folder / "uwb.csv").write_text(HEAD + "".join(rows))
    return folder / "uwb.csv"


def test_differences_anchors_and_truth(file):
    with open_recording(file) as recording:
        (pair,) = recording
    assert (recording.format.name, pair.time_s, pair.anchor_a, pair.anchor_b) == ("starloc", 1.01, 4, 5)
    assert pair.tdoa_m == pytest.approx(dist(TAG_M, MARKERS[15]) - dist(TAG_M, MARKERS[12]), abs=0.01)
    assert recording.drops == {"other-listener": 1, "range-without-another": 2, "malformed-number": 1}
    assert starloc.starloc_anchors(file) == {4: MARKERS[12], 5: MARKERS[15]}
    truth = starloc.starloc_truth(file, "2")
    assert (truth.t_s.tolist(), truth.position_m.tolist()) == ([1.005], [list(TAG_M)])
    other = file.parent.rename(file.parent.with_name("walk_s5"))
    assert starloc.starloc_anchors(other / "uwb.csv") == {}


@pytest.mark.statistical
def test_a_published_recording_is_replayed_without_options(recordings):
    path = recordings / "starloc" / "loop-2d-fast_s1" / "uwb.csv"
    if not path.is_file():
        pytest.skip(f"no recording at {path}")
    for tag in (None, "2"):
        report = skyless.replay(path, listener=tag).reports["tag"]
        assert report.rmse_2d_m < 0.15
        assert report.rmse_3d_m < 0.22
        assert report.exceeded_horizontal == report.exceeded_vertical == 0
