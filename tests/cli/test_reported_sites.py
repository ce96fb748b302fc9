"""Sites that people reported, simulated: how their tags move, and how their anchors stand."""

import pytest
from msgspec.structs import replace

import skyless
from skyless.core.site import ScheduleSite, TagsSite
from skyless.site.file.template import rectangular_site

pytestmark = pytest.mark.statistical

RINK = replace(rectangular_site(60.0, 30.0, 8, 5.0, 1.0), schedule=ScheduleSite(mode="free"))
AT_ONE_HEIGHT = replace(rectangular_site(3.0, 4.35, 4, 2.6, 1.0), schedule=ScheduleSite(mode="free"), tags=TagsSite())


@pytest.mark.parametrize(("speed_mps", "most_m"), [(1.0, 0.045), (3.0, 0.04), (5.0, 0.04), (8.0, 0.042)])
@pytest.mark.parametrize("seed", range(1, 6))
def test_levels_hold_at_any_speed_without_an_option(seed, speed_mps, most_m):
    report = skyless.simulate(site=RINK, tags=12, speed_mps=speed_mps, duration_s=15.0, seed=seed).report
    assert report.levels.misleading == 0
    assert report.levels.available > 0.99
    assert report.rmse_m < most_m


@pytest.mark.parametrize("seed", range(1, 4))
def test_one_beacon_a_second_is_enough_for_fixes_with_levels(seed):
    corners = rectangular_site(8.0, 6.0, 4, 3.0, 1.0)
    site = replace(corners, schedule=ScheduleSite(mode="free", rate_hz=1.0))
    report = skyless.simulate(site=site, tags=4, duration_s=120.0, seed=seed).report
    assert report.first_fix_s < 5.0
    assert report.levels.misleading == 0
    assert report.levels.available > 0.7
    assert report.rmse_m < 0.5


def test_anchors_at_one_height_give_no_level_without_a_known_height():
    report = skyless.simulate(site=AT_ONE_HEIGHT, duration_s=10.0).report
    assert report.levels is None or not report.levels.available
