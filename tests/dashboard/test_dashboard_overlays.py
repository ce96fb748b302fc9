"""Overlays: their grid, and values against the planner's at the same points."""

import asyncio

import numpy as np
import pytest
from msgspec.structs import replace

from skyless.core.errors import ConfigurationError
from skyless.core.method_names import DEFAULT_METHOD, METHODS
from skyless.core.site import AccuracySite, AnchorSite, FloorPlanSite, TagsSite
from skyless.page.overlay_process import overlay_grids
from skyless.page.overlays import MAX_CELLS, MovedAnchor, MovedAnchors, NoOverlayError, Overlays, overlay_task
from skyless.sim.lab import lab_site, paper_lab_site
from skyless.site.planning.colours import COLOUR_STOPS
from skyless.site.planning.links import HDOP, PDOP, SIGMA
from skyless.site.planning.predict import PlanSettings, Predictor

pytestmark = pytest.mark.site

LAB = paper_lab_site(accuracy=AccuracySite())
PNG_2_BY_1 = b"\x89PNG\r\n\x1a\n" + b"\0\0\0\x0dIHDR" + (200).to_bytes(4, "big") + (100).to_bytes(4, "big")


def test_the_grid_covers_all_anchors_in_cells_of_the_step():
    task = overlay_task(LAB, None, "joint", 0.25)
    assert (task.columns, task.rows, task.step_m) == (24, 32, 0.25)
    assert task.box_m == (0.0, 0.0, 6.0, 8.0)
    assert overlay_task(LAB, None, "joint", 0.35).columns == 18  # the last cell sticks out


def test_the_grid_covers_the_floor_plan_too():
    site = replace(LAB, floor_plan=FloorPlanSite("plan.png", 20.0, -5.0, -1.0))
    assert overlay_task(site, PNG_2_BY_1, "joint", 0.5).box_m == (-5.0, -1.0, 15.0, 9.0)
    assert overlay_task(site, None, "joint", 0.5).box_m == (0.0, 0.0, 6.0, 8.0)


def test_a_large_hall_gets_a_coarser_grid_and_every_grid_is_bounded():
    anchors = tuple(replace(anchor, x_m=anchor.x_m * 100.0, y_m=anchor.y_m * 100.0) for anchor in LAB.anchors)
    task = overlay_task(replace(LAB, anchors=anchors), None, "joint", 0.25)
    assert task.columns * task.rows <= MAX_CELLS
    assert task.step_m == 5.0


def test_values_are_the_planners_row_by_row_from_the_lowest_y():
    task = overlay_task(LAB, None, "weighted", 1.0)
    grids = overlay_grids(task)
    predictor = Predictor(LAB, PlanSettings("weighted"))
    for column, row in ((0, 0), (5, 0), (2, 7), (3, 3)):
        (expected,) = predictor.at(np.array([[column + 0.5, row + 0.5, LAB.tags.height_m]]))
        place = row * task.columns + column
        assert grids.pdop[place] == pytest.approx(expected[PDOP], abs=1e-3)
        assert grids.hdop[place] == pytest.approx(expected[HDOP], abs=1e-3)
        assert grids.sigma[place] == pytest.approx(expected[SIGMA], abs=1e-5)


def test_where_there_is_no_fix_there_is_no_value():
    """One anchor a kilometre away: beyond the middle no tag hears three."""
    far = AnchorSite(id=99, x_m=1000.0, y_m=4.0)
    task = overlay_task(replace(LAB, anchors=(*LAB.anchors, far)), None, "weighted", 10.0)
    grids = overlay_grids(task)
    assert grids.sigma[0] is not None
    assert grids.sigma[task.columns - 1] is None
    assert grids.pdop[task.columns - 1] is None


def test_a_method_that_does_not_exist_is_taken_for_the_default():
    task = overlay_task(LAB, None, "magic", 2.0)
    assert overlay_grids(task).sigma == overlay_grids(replace(task, method=DEFAULT_METHOD)).sigma


def test_the_methods_of_tags_are_predicted_each_as_itself():
    sigmas = [overlay_grids(overlay_task(LAB, None, method, 2.0)).sigma for method in METHODS]
    assert all(None not in sigma for sigma in sigmas)
    assert len({sigma[5] for sigma in sigmas}) == len(METHODS)


async def answers_of(*requests):
    """What one server answers."""
    overlays = Overlays()
    try:
        return [await overlays.get(*request) for request in requests]
    finally:
        overlays.stop()


def test_one_process_answers_all_three_kinds():
    kinds = ("pdop", "hdop", "sigma")
    pdop, hdop, sigma = asyncio.run(answers_of(*((LAB, None, ["weighted"], kind, 1.0) for kind in kinds)))
    assert (pdop["unit"], hdop["unit"], sigma["unit"]) == ("1", "1", "m")
    assert (sigma["x_m"], sigma["y_m"], sigma["columns"], sigma["rows"]) == ([0.5, 5.5], [0.5, 7.5], 6, 8)
    assert len(sigma["values"]) == 48
    assert sigma["method"] == "weighted"
    assert sigma["least"] <= sigma["scale"]["low"] < sigma["scale"]["high"]
    assert sigma["scale"]["stops"] == COLOUR_STOPS
    assert sigma["height_m"] == LAB.tags.height_m
    assert sigma["values"] == overlay_grids(overlay_task(LAB, None, "weighted", 1.0)).sigma


def test_too_few_anchors_are_an_error():
    site = replace(LAB, anchors=LAB.anchors[:3], tags=TagsSite())
    with pytest.raises(NoOverlayError, match="4 anchors or more"):
        asyncio.run(answers_of((site, None, [], "pdop", 1.0)))


def test_a_process_that_has_died_is_started_again():
    async def ask():
        overlays = Overlays()
        try:
            await overlays.get(LAB, None, ["weighted"], "pdop", 2.0)
            overlays._process._process.kill()
            overlays._process._process.wait()
            return await overlays.get(LAB, None, ["weighted"], "pdop", 1.0)
        finally:
            overlays.stop()

    assert asyncio.run(ask())["columns"] == 6


def test_anchors_are_moved_in_the_prediction_only():
    moved = MovedAnchors((MovedAnchor(2, 4.0, 1.0, 2.0),)).site_of(LAB)
    assert [(a.x_m, a.y_m, a.z_m) for a in moved.anchors if a.id == 2] == [(4.0, 1.0, 2.0)]
    assert [a for a in moved.anchors if a.id != 2] == [a for a in LAB.anchors if a.id != 2]
    with pytest.raises(ConfigurationError, match="the same point"):
        MovedAnchors((MovedAnchor(2, 0.0, 0.0, 0.0),)).site_of(LAB)


@pytest.mark.statistical
def test_nothing_is_computed_after_the_end():
    async def ask():
        overlays = Overlays()
        began = asyncio.create_task(overlays.get(LAB, None, [], "pdop", 0.05))
        await asyncio.sleep(0.2)
        overlays.stop()
        waited = asyncio.create_task(overlays.get(LAB, None, [], "pdop", 0.1))
        return await asyncio.gather(began, waited, return_exceptions=True)

    assert all(isinstance(answer, NoOverlayError) for answer in asyncio.run(ask()))


def test_errors_are_predicted_without_a_master_too():
    grids = overlay_grids(overlay_task(lab_site(), None, "joint", 1.0))
    assert grids.error is None
    assert None not in grids.sigma
    assert "needs a master" in overlay_grids(overlay_task(lab_site(), None, "weighted", 1.0)).error
