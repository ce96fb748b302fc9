"""``joint`` hears protocol 1's beacons as those of protocol 2, and what they state beyond those counts."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from protocol1_strategies import beacons, unsigned

from skyless.core.air.frame import Reception
from skyless.core.any_receiver import AnyReceiver
from skyless.core.estimator.estimator import NO_REPORT
from skyless.core.protocol1.beacon import encode
from skyless.core.protocol1.translator import Translator
from skyless.sim.evaluation.scenarios import Request, fleet_of
from skyless.sim.lab import paper_lab_site


@pytest.mark.site
@given(st.lists(st.tuples(beacons(), unsigned(40)), min_size=1, max_size=8))
def test_no_beacon_raises(received):
    """Frames are drawn over the whole range of every field, all of one site so that their pages are used."""
    receiver = AnyReceiver()
    for beacon, rx_ticks in received:
        receiver.hear(Reception(encode(replace(beacon, site=1)), rx_ticks, None))
    assert sum(receiver.counters.values()) >= len(received)


@pytest.mark.statistical
def test_the_anchors_own_estimates_help_where_most_frames_are_lost(monkeypatch):
    def rmse_m():
        squares = []
        for seed in range(6):
            fleet = fleet_of(Request(paper_lab_site(), seed=seed, tags=2, loss=0.9))
            squares += [np.square(one.error_m[:2]).sum() for one in fleet.run(10.0)]
        return np.sqrt(np.mean(squares))

    with_reports_m = rmse_m()
    monkeypatch.setattr(Translator, "report", lambda *_: NO_REPORT)
    assert with_reports_m < 0.9 * rmse_m()
