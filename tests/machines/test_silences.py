"""Walking tags that hear nothing for a while, behind a pillar or in a lift: no fix after it is silently wrong."""

import math

import numpy as np
import pytest
from msgspec.structs import replace

from skyless.core.estimator.estimator import Estimator
from skyless.core.estimator.kalman import predict
from skyless.core.estimator.state import EstimatorSettings
from skyless.core.site import EXACT
from skyless.core.ticks import from_seconds
from skyless.sim.evaluation.scenarios import Request, fleet_of
from skyless.sim.lab import paper_lab_site
from skyless.site.file.template import rectangular_site

LISTENING_S = 3.0


HALL = replace(rectangular_site(30.0, 20.0, 8, 4.0, None), accuracy=EXACT)


@pytest.mark.parametrize("site", [paper_lab_site(), HALL], ids=lambda site: site.name)
@pytest.mark.parametrize("silence_s", [2.0, 3.0, 4.5])
def test_fixes_after_a_silence_know_their_error(site, silence_s):
    """Errors of a normal variable in 2 or 3 axes exceed five of its radial sigmas once in 10⁶ and more."""
    fleet = fleet_of(Request(site, seed=3, tags=2, speed_mps=2.0))
    ratios, after = [], 0
    for broadcast in fleet.world.run(25.0):
        since_s = broadcast.end_s % (silence_s + LISTENING_S) - silence_s
        if since_s < 0.0:
            continue
        for tag, reception, truth_m in broadcast.receptions():
            fix = fleet.receivers[tag].hear(reception)
            if fix is not None:
                ratios.append(math.dist(fix.position_m, truth_m) / fix.std_m)
                after += since_s < 0.2
    assert max(ratios) < 5.0
    assert after > 100
    assert len(ratios) > 6000


def test_the_spread_ahead_is_that_of_the_prediction():
    generator = np.random.default_rng(1)
    for dim in (2, 3):
        root = generator.normal(size=(2 * dim, 2 * dim))
        estimator = Estimator(EstimatorSettings(qa=0.4, height_m=0.0 if dim == 2 else None))
        P = estimator.state.P
        P[: 2 * dim, : 2 * dim] = root @ root.T
        told, epoch = estimator.horizontal_variance_m2(1.7), int(estimator.state.status[0]["epoch_ticks"])
        predict(estimator.state, epoch + from_seconds(1.7))
        assert told == pytest.approx(P[0, 0] + P[1, 1], rel=1e-9)


def test_superframes_of_seconds_are_silences():
    """255 slots of 15.7 ms, of which six are used: 94 ms of beacons every 4 s."""
    lab = paper_lab_site()
    slow = replace(lab, schedule=replace(lab.schedule, slot_s=15.7e-3, slots=255))
    fleet = fleet_of(Request(slow, tags=4))
    judged = list(fleet.run(60.0))
    assert len(judged) > 4 * 8
    assert max(math.dist(one.fix.position_m, one.truth_m) / one.fix.std_m for one in judged) < 5.0
    assert max(one.fix.std_m for one in judged) < 1.0
