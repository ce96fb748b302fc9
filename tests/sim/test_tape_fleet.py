"""Tags at large sites, whose anchors are a tape."""

import pytest
from msgspec.structs import replace

from skyless.core.air.beacon import encode
from skyless.core.any_receiver import AnyReceiver
from skyless.core.site import EXACT
from skyless.sim.evaluation.fleet import Fleet, FleetSettings, TapeFleet
from skyless.sim.evaluation.scenarios import MAX_MACHINES, Request, fleet_of_any_size
from skyless.sim.impairments import Impairments
from skyless.sim.trajectory import Roaming
from skyless.site.file.template import grid_site

pytestmark = pytest.mark.statistical

GRID = replace(grid_site(240.0, 240.0, 15.0, 4.0, 1.0), accuracy=EXACT)


def tags(count):
    return [Roaming((100.0 + 10.0 * n, 120.0, 1.0), (6.0, 6.0, 0.0), seed=n) for n in range(count)]


def test_tags_are_as_accurate_as_their_fixes_say():
    fleet = TapeFleet(GRID, tags(3), Impairments(), 7, FleetSettings())
    assert all(judged.fix.std_m < 0.5 for judged in fleet.run(4.0))
    assert fleet.now_s == 4.0
    assert fleet.errors.summary().rmse_2d_m < 0.04
    assert fleet.tally.at_tags["heard"] > 3 * 4 * 120
    assert fleet.drops.keys() <= {"unconfirmed-anchor", "outlier"}


def test_the_bytes_of_the_frames_make_the_same_fixes():
    fleet = TapeFleet(GRID, tags(1), Impairments(), 8, FleetSettings())
    decoded, from_bytes, fixes = AnyReceiver(), AnyReceiver(), 0
    for heard in fleet.tape.hear(0, 0.5, 2.0):
        fix = decoded.hear_beacon(heard.beacon, heard.reception)
        again = from_bytes.hear(replace(heard.reception, frame=encode(heard.beacon)))
        assert (fix is None) == (again is None)
        if fix is not None:
            assert fix.rows == again.rows
            fixes += 1
    assert fixes > 150


def test_sites_with_more_anchors_than_machines_are_tapes():
    assert len(GRID.anchors) > MAX_MACHINES
    assert isinstance(fleet_of_any_size(Request(GRID)), TapeFleet)
    small = grid_site(60.0, 60.0, 15.0, 4.0, 1.0)
    assert isinstance(fleet_of_any_size(Request(small)), Fleet)


@pytest.mark.parametrize(
    ("fault", "name"),
    [({"nlos": 0.1}, "--nlos"), ({"temperature": True}, "--temperature"), ({"carrier": True}, "--carrier")],
)
def test_what_is_not_modelled_there_is_named(fault, name):
    with pytest.raises(ValueError, match=f"{name}: not modelled"):
        fleet_of_any_size(Request(GRID, **fault))
