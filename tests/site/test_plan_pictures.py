"""Pictures of plans: no label covers a title, a mark or another label, whatever the shape of the site."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from matplotlib.text import Annotation
from msgspec.structs import replace

from skyless.core.site import AnchorSite, TagsSite, WallSite
from skyless.sim.lab import paper_lab_site
from skyless.site.planning.links import ANCHORS_IN_VIEW, PLAN_COLUMNS, SIGMA, floor_of
from skyless.site.planning.maps import PlanMap, grid_of
from skyless.site.planning.picture import RMSE_LAYER, SIGMA_LAYER, Background, Layer, draw_layer

pytestmark = pytest.mark.site

LAB = paper_lab_site()
IN_VIEW = Layer(ANCHORS_IN_VIEW, "anchors in view", "", more_is_better=True)


def grid_site(columns, rows, step_m, height_m=1.2):
    """A site with anchors on a grid, and a wall."""
    points = [(step_m * column, step_m * row) for row in range(rows) for column in range(columns)]
    anchors = tuple(AnchorSite(number, x, y, 2.5) for number, (x, y) in enumerate(points, start=1))
    walls = (WallSite(step_m, 0.0, step_m, 0.6 * step_m),)
    return replace(LAB, name="Hall", master=1, anchors=anchors, walls=walls, tags=TagsSite(height_m))


def made_up_map(site, heights):
    """A map with a smooth bowl of errors, without predicting anything."""
    floor = floor_of(site, Path("hall.toml"), None, None)
    grid = grid_of(floor, heights, None)
    table = np.full((len(heights), *grid.within.shape, len(PLAN_COLUMNS)), np.nan)
    x, y = np.meshgrid(np.linspace(-1, 1, len(grid.x_m)), np.linspace(-1, 1, len(grid.y_m)))
    table[..., :] = (0.03 * (1.0 + 4.0 * (x * x + 0.5 * y * y)))[None, ..., None]
    table[..., ANCHORS_IN_VIEW] = 5.0
    table[..., SIGMA][:, 0, 0] = np.inf
    return PlanMap(grid, table, grid.step_m), Background(site, floor, Path("hall.toml"), "predicted for joint, at rest")


SITES = {
    "small": (LAB, (1.2,), SIGMA_LAYER),
    "wide": (grid_site(7, 2, 10.0), (1.2,), RMSE_LAYER),
    "tall": (grid_site(2, 7, 10.0), (1.2,), SIGMA_LAYER),
    "many anchors": (grid_site(15, 10, 5.0), (1.2,), SIGMA_LAYER),
    "heights": (grid_site(4, 3, 4.0, None), (0.5, 1.5, 2.5), SIGMA_LAYER),
    "whole numbers": (grid_site(4, 3, 4.0), (1.2,), IN_VIEW),
}


@pytest.mark.parametrize("name", SITES)
def test_no_label_covers_another(name):
    site, heights, layer = SITES[name]
    figure = draw_layer(*made_up_map(site, heights)[:1], layer, made_up_map(site, heights)[1])
    figure.draw_without_rendering()
    panels, legend = figure.axes[: len(heights)], figure.legends[0].get_window_extent()
    outer = [figure._suptitle.get_window_extent(), legend]
    for axes in panels:
        outer += [axes.title.get_window_extent(), axes.xaxis.label.get_window_extent()]
        texts = [text for text in axes.texts if text.get_text()]
        names = {text.get_text().partition(":")[0] for text in texts if isinstance(text, Annotation)}
        assert len(names) >= 0.9 * len(site.anchors)
        boxes = [text.get_window_extent() for text in texts]
        for one, other in combinations(boxes, 2):
            assert not one.overlaps(other)
        frame = axes.get_window_extent()
        assert all(
            frame.x0 <= box.x0 and box.x1 <= frame.x1 and frame.y0 <= box.y0 and box.y1 <= frame.y1 for box in boxes
        )
    shown = [box for box in outer if box.width > 1.0]
    for one, other in combinations(shown, 2):
        assert not one.overlaps(other)
