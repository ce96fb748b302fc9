"""Overlays: their grid, and values against the planner's at the same points."""

import asyncio

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace
from starlette.exceptions import HTTPException

from skyless.core.errors import ConfigurationError
from skyless.core.method_names import DEFAULT_METHOD
from skyless.core.site import AccuracySite, AnchorSite, FloorPlanSite, TagsSite
from skyless.page.overlay_process import MAX_CELLS, grid_of, overlay
from skyless.page.tasks import KINDS, MovedAnchors, OverlayTask, TaskProcess
from skyless.sim.lab import lab_site, paper_lab_site
from skyless.site.channel import ChannelModel
from skyless.site.planning.colours import COLOUR_STOPS
from skyless.site.planning.links import HDOP, PDOP, SIGMA
from skyless.site.planning.maps import Predictor

pytestmark = pytest.mark.site

LAB = paper_lab_site(accuracy=AccuracySite())


def task(site=LAB, kind="sigma", step_m=1.0):
    return OverlayTask(site, kind, step_m, None)


def values(*args, **kwargs):
    return overlay(task(*args, **kwargs))["values"]


def box_m(grid):
    """The outer edges of its cells."""
    half_m = grid.step_m / 2
    return grid.x_m[0] - half_m, grid.y_m[0] - half_m, grid.x_m[-1] + half_m, grid.y_m[-1] + half_m


def test_the_grid_covers_all_anchors_in_cells_of_the_step():
    grid = grid_of(LAB, None, 0.25)
    assert (len(grid.x_m), len(grid.y_m), grid.step_m) == (24, 32, 0.25)
    assert box_m(grid) == (0.0, 0.0, 6.0, 8.0)
    assert len(grid_of(LAB, None, 0.35).x_m) == 18  # the last cell sticks out


def test_the_grid_covers_the_floor_plan_too():
    site = replace(LAB, floor_plan=FloorPlanSite("plan.png", 20.0, -5.0, -1.0))
    assert box_m(grid_of(site, (200, 100), 0.5)) == (-5.0, -1.0, 15.0, 9.0)
    assert box_m(grid_of(site, None, 0.5)) == (0.0, 0.0, 6.0, 8.0)


def test_a_large_hall_gets_a_coarser_grid_and_every_grid_is_bounded():
    anchors = tuple(replace(anchor, x_m=anchor.x_m * 100.0, y_m=anchor.y_m * 100.0) for anchor in LAB.anchors)
    grid = grid_of(replace(LAB, anchors=anchors), None, 0.25)
    assert grid.points <= MAX_CELLS
    assert grid.step_m == 5.0


def test_values_are_the_planners_row_by_row_from_the_lowest_y():
    predictor = Predictor(LAB, ChannelModel())
    for kind, which, error in (("pdop", PDOP, 1e-3), ("hdop", HDOP, 1e-3), ("sigma", SIGMA, 1e-5)):
        found = overlay(task(kind=kind))
        for column, row in ((0, 0), (5, 0), (2, 7), (3, 3)):
            (expected,) = predictor.at(np.array([[column + 0.5, row + 0.5, LAB.tags.height_m]]))
            assert found["values"][row * found["columns"] + column] == pytest.approx(expected[which], abs=error)


def test_where_there_is_no_fix_there_is_no_value():
    """One anchor a kilometre away: beyond the middle no tag hears three."""
    far = AnchorSite(id=99, x_m=1000.0, y_m=4.0)
    site = replace(LAB, anchors=(*LAB.anchors, far))
    sigma = overlay(task(site, step_m=10.0))
    assert sigma["values"][0] is not None
    assert sigma["values"][sigma["columns"] - 1] is None
    assert values(site, "pdop", step_m=10.0)[sigma["columns"] - 1] is None


def test_each_kind_has_its_unit_and_scale():
    pdop, hdop, sigma = (overlay(task(kind=kind)) for kind in KINDS)
    assert (pdop["unit"], hdop["unit"], sigma["unit"]) == ("1", "1", "m")
    assert (sigma["x_m"], sigma["y_m"], sigma["columns"], sigma["rows"]) == ([0.5, 5.5], [0.5, 7.5], 6, 8)
    assert len(sigma["values"]) == 48
    assert sigma["method"] == DEFAULT_METHOD
    assert sigma["least"] <= sigma["scale"]["low"] < sigma["scale"]["high"]
    assert sigma["scale"]["stops"] == COLOUR_STOPS
    assert sigma["height_m"] == LAB.tags.height_m


async def test_a_process_answers_as_here_says_why_it_cannot_and_is_started_again():
    process = TaskProcess("skyless.page.overlay_process")
    try:
        with pytest.raises(HTTPException, match="4 anchors or more"):
            await process.run(task(replace(LAB, anchors=LAB.anchors[:3], tags=TagsSite())))
        process._process.kill()
        process._process.wait()
        assert msgspec.json.decode(await process.run(task()))["values"] == values()
    finally:
        process.stop()


def test_anchors_are_moved_in_the_prediction_only():
    moved = MovedAnchors((AnchorSite(2, 4.0, 1.0, 2.0),)).site_of(LAB)
    assert [(a.x_m, a.y_m, a.z_m) for a in moved.anchors if a.id == 2] == [(4.0, 1.0, 2.0)]
    assert [a for a in moved.anchors if a.id != 2] == [a for a in LAB.anchors if a.id != 2]
    with pytest.raises(ConfigurationError, match="the same point"):
        MovedAnchors((AnchorSite(2, 0.0, 0.0, 0.0),)).site_of(LAB)


@pytest.mark.statistical
async def test_nothing_is_computed_after_the_end():
    process = TaskProcess("skyless.page.overlay_process")
    began = asyncio.create_task(process.run(task(step_m=0.05)))
    await asyncio.sleep(0.2)
    process.stop()
    waited = asyncio.create_task(process.run(task(step_m=0.1)))
    answers = await asyncio.gather(began, waited, return_exceptions=True)
    assert all(isinstance(answer, HTTPException) for answer in answers)


def test_errors_are_predicted_without_a_master_too():
    assert None not in values(lab_site())
