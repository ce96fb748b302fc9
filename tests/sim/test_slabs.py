"""Two floors: slabs are crossed by who is on both sides of them, and tags walk on a floor, not in the slab."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

import skyless
from skyless.arguments import tag_count
from skyless.core.errors import SkylessError
from skyless.core.site import FloorSite
from skyless.sim.evaluation.scenarios import CARRIED_M, patrols
from skyless.site.channel import barriers_of, cross_walls
from skyless.site.file.template import rectangular_site

FLOORS = (FloorSite(0, 0.0), FloorSite(1, 3.2, slab_loss_db=200.0), FloorSite(2, 6.4, slab_delay_m=0.7))


def house():
    """Six anchors on each of two floors; nothing comes through the slab between them."""
    room = rectangular_site(12.0, 8.0, 6, 3.0, None)
    upper = [replace(one, id=one.id + 6, z_m=one.z_m + 3.2, floor=1) for one in room.anchors]
    return replace(room, anchors=(*room.anchors, *upper), floors=FLOORS[:2])


@given(st.floats(-1.0, 10.0), st.floats(-1.0, 10.0))
def test_a_signal_crosses_the_slabs_between_its_ends(a_m, b_m):
    slabs = [floor for floor in FLOORS[1:] if min(a_m, b_m) < floor.low_m <= max(a_m, b_m)]
    loss_db, delay_m = cross_walls(*barriers_of((), FLOORS), 1.0, 2.0, a_m, 5.0, 1.0, b_m)
    assert loss_db == pytest.approx(sum(floor.slab[0] for floor in slabs))
    assert delay_m == pytest.approx(sum(floor.slab[1] for floor in slabs))


@pytest.mark.parametrize(("asked", "floors"), [("4", [0, 1, 0, 1]), ("3@1", [1, 1, 1]), ("2@0", [0, 0])])
def test_tags_walk_on_each_floor_in_turn_or_on_the_named_one(asked, floors):
    rule, text = tag_count(1, 10)
    paths = patrols(house(), rule.check("--tags", text.read("--tags", asked)))
    assert [path.position(7.0)[2] for path in paths] == pytest.approx([FLOORS[one].low_m + CARRIED_M for one in floors])


@pytest.mark.parametrize("asked", ["", "3@", "@1", "3@x", "1.5", "1@5"])
def test_what_is_no_number_of_tags_and_no_floor_of_the_site_is_refused(asked):
    with pytest.raises(
        SkylessError, match=r"--tags is .* it should be a whole number, or one with a floor, as 3@1|0, 1$"
    ):
        patrols(house(), tag_count(1, 10)[1].read("--tags", asked))


@pytest.mark.site
def test_tags_use_the_anchors_of_their_own_floor():
    fixes = skyless.simulate(site=house(), tags=2, duration_s=4.0, seed=3).fixes
    assert set(fixes.anchor_count[fixes.judged]) <= set(range(4, 7))
    assert abs(fixes.error_m[fixes.judged]).max() < 0.5
