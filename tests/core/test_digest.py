"""The digest of a site: what of it counts, and what does not."""

import pytest
from msgspec.structs import replace

from skyless.core.site import ScheduleSite, TagsSite, UnplacedAnchor, is_same_but_placed, site_digest
from skyless.sim.lab import lab_site, paper_lab_site

LAB = lab_site()
UNPLACED = replace(LAB, anchors=(), unplaced=tuple(UnplacedAnchor(anchor.id, anchor.slot) for anchor in LAB.anchors))


def changed(**values):
    return replace(LAB, anchors=(replace(LAB.anchors[0], **values), *LAB.anchors[1:]))


@pytest.mark.parametrize(
    "other",
    [
        *(changed(**{key: 1e-3}) for key in ("x_m", "y_m", "z_m")),
        changed(tx_antenna_delay_ticks=16437),
        changed(rx_antenna_delay_ticks=16437),
        changed(slot=7),
        changed(id=99),
        replace(LAB, name="other"),
        replace(LAB, id=2),
        UNPLACED,
    ],
)
def test_it_changes_with_what_a_survey_changes(other):
    assert site_digest(other) != site_digest(LAB)


@pytest.mark.parametrize(
    "other",
    [
        replace(LAB, anchors=LAB.anchors[::-1]),
        replace(LAB, tags=TagsSite(height_m=1.5)),
        changed(std_m=0.1),
        lab_site(200.0),
    ],
)
def test_it_does_not_change_with_anything_else(other):
    assert site_digest(other) == site_digest(LAB)


def test_positions_and_delays_alone_may_differ_in_a_placed_site():
    assert is_same_but_placed(LAB, changed(x_m=3.0, tx_antenna_delay_ticks=5))
    assert not is_same_but_placed(LAB, replace(LAB, anchors=LAB.anchors[1:]))
    paper = paper_lab_site()
    assert not is_same_but_placed(paper, replace(paper, anchors=LAB.anchors[::-1]))  # slots follow the order
    assert not is_same_but_placed(LAB, replace(LAB, schedule=ScheduleSite(slot_s=5e-3)))
    assert not is_same_but_placed(LAB, replace(LAB, id=3))
    slots = ScheduleSite(mode="free")
    assert is_same_but_placed(replace(UNPLACED, schedule=slots), replace(LAB, schedule=slots))
