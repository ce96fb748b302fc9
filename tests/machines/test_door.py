"""What ``joint`` makes of protocol 1's beacons: what they state beyond those of protocol 2 counts."""

import numpy as np
import pytest

from skyless.core.estimator.estimator import NO_REPORT
from skyless.core.protocol1.door import Door
from skyless.sim.evaluation.scenarios import Request, fleet_of
from skyless.sim.lab import paper_lab_site


@pytest.mark.statistical
def test_the_anchors_own_estimates_help_where_most_frames_are_lost(monkeypatch):
    def rmse_m():
        squares = []
        for seed in range(6):
            fleet = fleet_of(Request(paper_lab_site(), seed=seed, tags=2, loss=0.9))
            squares += [np.square(one.error_m[:2]).sum() for one in fleet.run(10.0)]
        return np.sqrt(np.mean(squares))

    with_reports_m = rmse_m()
    monkeypatch.setattr(Door, "report", lambda *_: NO_REPORT)
    assert with_reports_m < 0.9 * rmse_m()
