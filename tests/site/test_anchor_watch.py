"""The watch of the anchors: what it finds, names, keeps and gives up, on drawn ranges and on real ones."""

import math
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyless.research.calibration.biases import ranges_of
from skyless.research.studies.surveyed_rooms import survey_layouts
from skyless.research.studies.watch import WatchCase, run_watch, striking_windows
from skyless.site.survey.explain import sentence_of
from skyless.site.survey.facts import PairBlock
from skyless.site.survey.pair_ranger import PairRanger
from skyless.site.survey.watch import AnchorWatch

pytestmark = pytest.mark.site

SQUARE = {1: (0.0, 0.0, 0.0), 2: (6.0, 0.0, 0.0), 3: (6.5, 5.0, 0.0), 4: (0.0, 6.0, 0.0), 5: (2.5, 2.0, 0.0)}


class Ranges:
    """Ranges of a small site with 5 mm of noise in each window, in front of a watch."""

    def __init__(self, *, baseline=False, missing=(), seed=1):
        self.position_m = {anchor: np.array(of) for anchor, of in SQUARE.items()}
        self.draw = np.random.default_rng(seed)
        self.late_m = {}
        self.silent = set(missing)
        self.away = set()
        self.window = 0
        known = {pair: self.distance_m(pair) for pair in self.pairs()} if baseline else None
        self.watch = AnchorWatch(SQUARE, 2, known)

    def pairs(self):
        return [(a, b) for a in SQUARE for b in SQUARE if a < b and (a, b) not in self.silent]

    def distance_m(self, pair):
        return float(np.linalg.norm(self.position_m[pair[0]] - self.position_m[pair[1]])) + self.late_m.get(pair, 0.0)

    def run(self, windows):
        for _ in range(windows):
            for a, b in self.pairs():
                if not {a, b} & self.away:
                    range_m = self.distance_m((a, b)) + float(self.draw.normal(0.0, 0.005))
                    self.watch.add(PairBlock(a, b, 10.0 * self.window + 5.0, range_m, 0.002, 200))
            self.window += 1
            self.watch.advance(10.0 * self.window + 3.0)
        return [(one.kind, one.anchors) for one in self.watch.findings]


def drawn(layout, event, size_m, events, seed, drift_m=(0.02, 0.02), *, missing=0.0):
    return run_watch(WatchCase("", "", layout, event, size_m, drift_m, missing=missing), events, seed)


def test_noise_strikes_no_more_often_than_stated():
    """Fewer than stated, as causes overlap; 5 sigma above it would be wrong."""
    expected = 1e-3 * 100_000
    assert (
        expected / 10.0
        < striking_windows(survey_layouts()["lab"], 0.1, 1e-3, 100_000, 81)
        < expected + 5.0 * math.sqrt(expected)
    )
    assert striking_windows(survey_layouts()["lab"], 0.1, 1e-7, 100_000, 82) == 0


@pytest.mark.parametrize("event", ["moved", "two moved", "link"])
def test_drift_of_two_centimetres_hides_nothing_in_the_hall(event):
    size_m = {"moved": 0.1, "two moved": 0.3, "link": 0.35}[event]
    result = drawn("hall", event, size_m, 5, 85)
    assert result.found == 5
    assert max(result.found_s) <= 30.0
    assert result.wrong == 0
    assert result.alarms_moved == 0


def test_an_anchor_that_creeps_is_found():
    result = drawn("hall", "slow", 0.3, 2, 86)
    assert (result.found, result.named, result.wrong) == (2, 2, 0)


def test_drift_of_a_real_room_is_no_finding():
    case = WatchCase("", "", "lab", "none", 0.0, (0.008, 0.025), 60.0, 0.09)
    assert run_watch(case, 500, seed=87).alarms == 0


def test_a_finding_stays_until_the_anchor_is_put_back():
    site = Ranges()
    assert site.run(40) == []
    site.position_m[2] = site.position_m[2] + np.array([0.1, 0.06, 0.0])
    assert site.run(90) == [("moved", (2,))]  # for longer than the usual range is a median of
    (found,) = site.watch.findings
    assert found.size_m == pytest.approx(math.hypot(0.1, 0.06), abs=5.0 * found.std_m)
    assert found.since_s == 400.0
    site.position_m[2] = np.array(SQUARE[2])
    assert site.run(3) == []


def test_what_is_accepted_is_the_new_state():
    site = Ranges()
    site.run(40)
    site.position_m[3] = site.position_m[3] + np.array([0.0, 0.5, 0.0])
    assert site.run(4) == [("moved", (3,))]
    site.watch.accept()
    assert site.watch.findings == ()
    assert site.run(40) == []
    site.position_m[3] = np.array(SQUARE[3])
    assert site.run(4) == [("moved", (3,))]


def test_an_anchor_that_was_carried_across_the_room_is_named():
    site = Ranges(baseline=True)
    site.run(20)
    site.position_m[4] = np.array([3.0, 5.5, 0.0])
    assert site.run(4) == [("moved", (4,))]
    assert site.watch.findings[0].size_m == pytest.approx(math.hypot(3.0, 0.5), abs=0.1)


def test_an_anchor_that_comes_back_elsewhere_has_moved():
    site = Ranges()
    site.run(40)
    site.away.add(5)
    site.position_m[5] = site.position_m[5] + np.array([0.3, 0.0, 0.0])
    assert site.run(100) == []
    site.away.clear()
    assert site.run(4) == [("moved", (5,))]


def test_what_moved_while_nobody_watched_shows_against_the_survey():
    site = Ranges(baseline=True)
    site.position_m[1] = site.position_m[1] - np.array([0.25, 0.1, 0.0])
    assert site.run(4) == [("moved", (1,))]


def test_a_delay_and_a_late_link_are_named():
    site = Ranges()
    site.run(40)
    site.late_m = {pair: 0.2 for pair in site.pairs() if 5 in pair}
    assert site.run(4) == [("delay", (5,))]
    site.late_m = {(2, 4): 0.34}
    assert site.run(4) == [("link", (2, 4))]
    assert site.watch.findings[0].sentence == "the link between 2 and 4 is blocked: 34 cm late"
    site.late_m = {}
    assert site.run(4) == []


def test_a_silent_link_is_found_and_an_absent_anchor_is_not():
    site = Ranges()
    site.run(40)
    site.silent.add((2, 5))
    assert site.run(3) == [("link", (2, 5))]
    assert site.run(100) == [("link", (2, 5))]
    site.silent.clear()
    assert site.run(1) == []
    site.away.add(2)
    assert site.run(20) == []


def test_an_anchor_with_two_links_is_checked():
    """Two late links explain as much as a displacement."""
    site = Ranges(missing={(1, 4), (3, 4)})
    site.run(40)
    site.position_m[4] = site.position_m[4] + np.array([-0.2, 0.3, 0.0])
    found = site.run(4)
    assert [kind for kind, _ in found] == ["check"]
    assert 4 in found[0][1]


def test_a_moved_anchor_is_named_though_pairs_are_missing():
    site = Ranges(missing={(1, 4), (2, 3)})
    site.run(40)
    site.position_m[4] = site.position_m[4] + np.array([-0.2, 0.3, 0.0])
    assert site.run(4) == [("moved", (4,))]


def test_state_and_number_of_pairs():
    site = Ranges()
    assert (site.watch.state, site.watch.pairs) == ("no data", 0)
    site.run(5)
    assert (site.watch.state, site.watch.pairs) == ("learning", 0)
    site.run(10)
    assert (site.watch.state, site.watch.pairs) == ("watching", 10)
    site.watch.advance(1e5)
    assert site.watch.state == "no data"
    assert Ranges(baseline=True).watch.pairs == 10


def test_blocks_that_cannot_be_used_are_counted():
    watch = AnchorWatch(SQUARE)
    watch.add(PairBlock(1, 9, 5.0, 6.0, 0.01, 10))
    watch.add(PairBlock(1, 2, math.nan, 6.0, 0.01, 10))
    watch.add(PairBlock(1, 2, 5.0, math.inf, 0.01, 10))
    watch.add(PairBlock(1, 2, 95.0, 6.0, 0.01, 10))
    watch.add(PairBlock(1, 2, 45.0, 6.0, 0.01, 10))
    assert watch.counters == {"unknown-anchor": 1, "impossible-block": 2, "late-block": 1}


def test_a_clock_that_is_set_back_does_not_end_the_watch():
    site = Ranges()
    site.window = 10_000
    site.run(40)
    site.window = 0
    site.position_m[2] = site.position_m[2] + np.array([0.3, 0.0, 0.0])
    assert site.run(4) == [("moved", (2,))]


@settings(max_examples=25)
@given(
    st.lists(
        st.builds(
            PairBlock,
            st.integers(1, 6),
            st.integers(1, 6),
            st.floats(0.0, 100.0),
            st.floats(-1e6, 1e6),
            st.floats(),
            st.integers(-1, 1000),
        ),
        max_size=40,
    )
)
def test_any_blocks_are_survived(blocks):
    watch = AnchorWatch(SQUARE, learning_windows=1, window_s=5.0)
    for block in blocks:
        watch.add(block)
    watch.advance(200.0)
    assert all(math.isfinite(one.size_m) for one in watch.findings)


def test_sentences():
    assert sentence_of("moved", (4,), 0.113) == "anchor 4 has moved by about 11 cm"
    assert sentence_of("moved", (4,), 2.04) == "anchor 4 has moved by about 2.0 m"
    assert sentence_of("moved", (4,), 0.1, or_else="delay").endswith(", or its delay has changed")
    assert sentence_of("delay", (2,), -0.05) == "the delay of anchor 2 has changed: 5 cm less"
    assert sentence_of("link", (2, 5), 0.34) == "the link between 2 and 5 is blocked: 34 cm late"
    assert sentence_of("check", (1, 4), 0.2) == "something has changed at anchors 1 or 4: check"
    assert sentence_of("check", (1, 4, 6), 0.2) == "something has changed at anchors 1, 4 or 6: check"


@pytest.mark.parametrize("window_s", [1.0, 2.0])
@pytest.mark.parametrize(
    ("name", "position_m"),
    [
        (
            "nozomi_rtls/avalue_first90s/ccp.csv",
            {38654746706: (0.0, 0.0), 38654746714: (6.88, 0.0), 38654746715: (6.7, 5.29), 38654746718: (0.0, 5.88)},
        ),
        (
            "kuipman_tdoa3_sniffer/raw_yaml/b34daf0_output20240415.yaml",
            {1: (0.0, 0.0), 2: (0.0, 4.5), 3: (4.5, 0.0), 4: (4.5, 4.5)},
        ),
    ],
)
def test_nobody_has_moved_in_real_recordings(recordings, name, position_m, window_s):
    """Their links drift and are blocked for seconds."""
    placed = {anchor: (*of, 0.0) for anchor, of in position_m.items()}
    watch = AnchorWatch(placed, window_s=window_s, learning_windows=5)
    kinds = set()

    def add(block):
        watch.add(block)
        kinds.update(one.kind for one in watch.findings)

    ranges_of(recordings / name, new_ranger=partial(PairRanger, block_s=min(window_s, 1.0), on_block=add))
    assert watch.state == "watching"
    assert kinds <= {"link"}
