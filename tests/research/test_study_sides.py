"""Pictures of studies say which side of a limit is safe."""

from types import SimpleNamespace

import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from skyless.research.studies.picture import CONFIDENCE, STATED_RISK, draw, shade_sides
from skyless.research.studies.run import STUDIES
from skyless.research.studies.runner import Limit


def row(study, number, case, series, x=None):
    """A row with all figures that pictures show."""
    figures = {
        "rmse_m": 0.03 + 0.01 * number, "rmse_error_m": 0.001, "nees": 0.7 + 0.25 * number, "nees_interval": (0.9, 1.1),
        "ratio": 1.0, "ratio_error": 0.02, "level": 0.9, "exceeded": 1e-4, "found": 0.9, "found_s": 3.0, "hpl_m": 0.1,
        "available": 0.9, "hmi": 1e-5 * number,
    }  # fmt: skip
    limits = (Limit("nees", 0.7, 1.3), Limit("ratio", most=1.2))
    return SimpleNamespace(
        study=study, method="joint", case=case, series=series, x=x, limits=limits, passed=True, **figures
    )


def words_of(figure):
    found = []
    for axes in figure.axes:
        found += [text.get_text() for text in axes.texts] + [axes.get_xlabel(), axes.get_ylabel()]
    return " ".join(found)


@pytest.mark.parametrize("name", ["efficiency", "room", "large", "survey", "watch"])
def test_every_figure_that_can_mislead_names_its_safe_side(name):
    for x in (None, 1.0):
        rows = [row(name, n, f"case {n}", "a series", x and n + x) for n in range(3)]
        assert "safe side" in words_of(draw(STUDIES[name], rows))


def test_levels_name_theirs():
    faults = [row("integrity", n, f"lab, step {n} m", "lab, step", float(n)) for n in range(1, 4)]
    words = words_of(draw(STUDIES["integrity"], [row("integrity", 0, "lab, clean", "lab, clean", 0.0), *faults]))
    assert STATED_RISK.above in words
    assert "too confident" in words


@pytest.mark.parametrize("scale", ["linear", "log"])
@pytest.mark.parametrize("values", [(0.2, 0.4), (3.0, 5.0), (0.5, 2.0)])
def test_both_sides_are_in_view_and_meet_at_the_limit(scale, values):
    axes = Figure().subplots()
    axes.plot([0.0, 1.0], values)
    axes.set_yscale(scale)
    shade_sides(axes, CONFIDENCE, 1.0, along="y")
    low, high = axes.get_ylim()
    assert low < 1.0 < high
    bands = [patch for patch in axes.patches if isinstance(patch, Rectangle)]
    edges = sorted((patch.get_y(), patch.get_y() + patch.get_height()) for patch in bands)
    assert edges[0][1] == pytest.approx(1.0)
    assert edges[1][0] == pytest.approx(1.0)
