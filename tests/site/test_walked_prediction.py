"""What is predicted of tags that walk a metre with phases of the carrier: against the bound, and without cycles."""

import math

import numpy as np
import pytest
from msgspec.structs import replace

import skyless
from skyless.core.geometry import anchor_positions
from skyless.core.protocol1.beacon import schedule_of
from skyless.core.site import ScheduleSite
from skyless.core.ticks import TICK_S
from skyless.research.uncertainty import BoundSettings, tracking_bound
from skyless.sim.lab import lab_site, paper_lab_site
from skyless.site.channel import ChannelModel
from skyless.site.planning.maps import Predictor

pytestmark = pytest.mark.site

LAB = paper_lab_site(100.0)
PLACE = np.array([[2.0, 3.0, 0.0], [4.5, 5.5, 0.0]])


@pytest.mark.parametrize("has_phases", [False, True])
def test_the_filter_claims_the_bound_of_a_tag_that_has_walked(has_phases):
    """Nearly: the bound's phases begin with the first frame, the filter's after two seconds."""
    anchors, noise, slot_s = anchor_positions(LAB), LAB.noise, schedule_of(LAB).slot_ticks * TICK_S
    frames, rested = round(1.0 / (6 * slot_s)) * 6, round(3.0 / (6 * slot_s)) * 6
    settings = BoundSettings(
        noise.tx_stamp_ps * 1e-12,
        white_fm=noise.white_fm,
        random_walk_fm=noise.random_walk_fm,
        qa=0.3,
        slot_s=slot_s,
        speed_std_mps=1.0,
        mesh=True,
        at_once=False,
        phase_std_m=0.003 if has_phases else math.inf,
        phase_wander=25.0 * 0.003**2,
    )
    found = Predictor(LAB, ChannelModel()).walked_sigma(PLACE, has_phases=has_phases)
    ways = [(PLACE[0], np.eye(3)[0]), (PLACE[0], np.eye(3)[1]), (PLACE[1], -np.eye(3)[0]), (PLACE[1], -np.eye(3)[1])]
    for sigma_m, (place, way) in zip(found, ways, strict=True):
        steps_m = np.append(np.zeros(rested), np.arange(1, frames + 1) / frames)
        bound = tracking_bound(anchors, place + steps_m[:, None] * way, settings)[-1]
        # the bound's phases wander with each packet, the filter's with each step of 2 cm
        assert sigma_m == pytest.approx(np.sqrt(np.trace(bound)), rel=0.02 if has_phases else 0.01)


def test_phases_give_nothing_where_packets_are_too_rare_or_crystals_too_poor_for_their_cycles():
    def gain(site):
        predictor = Predictor(site, ChannelModel())
        with_phases, stamps = (predictor.walked_sigma(PLACE, has_phases=has_phases) for has_phases in (True, False))
        return stamps / with_phases

    slow = replace(LAB, schedule=replace(LAB.schedule, slot_s=40e-3))
    poor = replace(LAB, noise=replace(LAB.noise, random_walk_fm=1e-7))
    assert gain(LAB).min() > 1.7
    for site in (slow, poor):
        np.testing.assert_allclose(gain(site), 0.9, atol=0.05)  # less, as more process noise is expected


def test_a_plan_says_what_phases_give_only_where_the_site_has_them():
    plain = skyless.plan(lab_site(), step_m=1.0)
    assert plain.summary["after_metre"] is None
    assert "after 1 m of walking" not in dict(plain.facts())
    site = replace(lab_site(), schedule=ScheduleSite(slot_s=2.5e-3, carrier_phase=True))
    found = skyless.plan(site, step_m=1.0)
    after = found.summary["after_metre"]
    assert after.walks == 12
    assert after.median_sigma_m < 0.85 * after.stamps_median_sigma_m
    assert after.worst_sigma_m < 0.85 * after.stamps_worst_sigma_m
    assert f"median {100 * after.median_sigma_m:.2f} cm" in dict(found.facts())["after 1 m of walking"]
