"""Tags far faster than the tracker's start assumes: it learns that from losing them."""

import math

import pytest

from skyless.experiments.fleet import Fleet, FleetSettings
from skyless.experiments.scenarios import Request, impairments_of
from skyless.simulation.trajectory import Waypoints
from skyless.site.room import room_site


@pytest.mark.parametrize("tag_height_m", [1.2, None])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_vehicle_at_20_metres_a_second(tag_height_m, seed):
    """It crosses the hall in 1.4 s; half a second after the site's power-on it must be followed, and rightly."""
    site = room_site(30.0, 20.0, 8, 4.0, tag_height_m)
    path = Waypoints([(1.0, 10.0, 1.2), (29.0, 10.0, 1.2)], 20.0)
    fleet = Fleet(site, [path], impairments_of(Request(site), site), seed, FleetSettings())
    judged = [one for one in fleet.run(1.35) if one.time_s > 0.5]
    assert len(judged) > 0.8 * 0.85 * 400
    assert max(math.dist(one.fix.position_m, one.truth_m) / one.fix.std_m for one in judged) < 5.0
    assert judged[-1].fix.velocity_mps[0] == pytest.approx(20.0, abs=1.0)
