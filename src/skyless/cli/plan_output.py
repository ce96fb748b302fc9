"""What ``skyless plan`` writes of its report: for the terminal and the page; tables, pictures and a site."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from skyless.cli.common.output import cm, new_table, print_facts, print_warnings, write_file
from skyless.errors import SkylessError

if TYPE_CHECKING:
    from skyless.planning.floor import Floor
    from skyless.planning.maps import PlanMap
    from skyless.planning.optimise import OneMore
    from skyless.planning.picture import Background
    from skyless.planning.verify import Verification
    from skyless.site.model import Site

_NOTES: Final = (
    "Tags are at rest. A moving tag's filter (joint) is less accurate; motion hardly affects the paper's methods "
    "up to 1 m/s.",
    "Stamps' noise and crystals are those of the site file, and the filters know them.",
    "Links are free space on channel 5 with the walls' losses of the site file; people, furniture, reflections and "
    "antennas' patterns are not known to the plan.",
    "Walls delay what crosses them as the site file states; nothing else is delayed.",
    "joint's figures hold the errors of survey and ranges that the site file states (accuracy); for the other methods "
    "positions of the anchors, antenna delays and ranges are assumed to be right.",
)


def _facts(result: dict[str, Any]) -> dict[str, str]:
    """The numbers for people."""
    worst_at, dimensions = result["worst_at_m"], f"{result['dimensions']}-D"
    where = "" if worst_at is None else " at ({:.2f}, {:.2f}, {:.2f}) m".format(*worst_at)
    facts = {
        "anchors": f"{len(result['anchors'])}, master {result['master']}, range {result['range_m']:.0f} m in the open",
        "map": _map_line(result),
        "covered": f"{result['covered_share']:.1%} of the region; fewest anchors in view: {result['fewest_anchors']}",
        f"standard deviation {dimensions}": f"mean {cm(result['mean_sigma_m'])}, "
        f"median {cm(result['median_sigma_m'])}, 95 % {cm(result['p95_sigma_m'])}, "
        f"worst {cm(result['worst_sigma_m'])}{where}",
    }
    if result["walls_bias"]:
        facts["with the walls' delays"] = f"RMSE mean {cm(result['mean_rmse_m'])}, worst {cm(result['worst_rmse_m'])}"
    if result["target_share"] is not None:
        facts["target met"] = f"in {result['target_share']:.1%} of the region"
    if result["one_more"] is not None:
        facts["one more anchor"] = _one_more(result["one_more"])
    if result["optimised"] is not None:
        facts["optimised"] = _against_even(result["optimised"])
    if result["verification"] is not None:
        facts["simulated"] = _verified(result["verification"])
    return facts


def _map_line(result: dict[str, Any]) -> str:
    line = f"{result['points']} points, {result['step_m']:g} m apart"
    if result["computed_every_m"] > result["step_m"]:
        line += f"; {result['method']} computed every {result['computed_every_m']:g} m and interpolated by the PDOP"
    return line


def _one_more(more: "OneMore") -> str:
    x, y, z = more.position_m
    mean = _change(more.mean_before_m, more.mean_after_m)
    worst = _change(more.worst_before_m, more.worst_after_m)
    if not more.helps:
        return f"none helps noticeably; with the best one mean {mean}, worst {worst}"
    return f"helps most at ({x:.2f}, {y:.2f}, {z:.2f}) m: mean {mean}, worst {worst}"


def _change(before_m: float, after_m: float) -> str:
    """A change as a share only: the facts' own mean and worst are those of the map, at other points."""
    return f"{after_m / before_m - 1.0:+.0%}"


def _against_even(found: dict[str, Any]) -> str:
    best, even = found["best"], found["even"]
    mean, worst = (_change(even[name], best[name]) for name in ("mean_sigma_m", "worst_sigma_m"))
    text = f"mean {mean}, worst {worst} against as many anchors evenly along the walls"
    if found["target_met"] is not None:
        text += "; the target is met everywhere" if found["target_met"] else "; the target is not met everywhere"
    return text if found["finished"] else text + "; the search was ended before it was complete"


def _verified(checked: "Verification") -> str:
    if checked.mean_ratio is None or checked.smallest_ratio is None or checked.largest_ratio is None:
        return "no point with a fix in both"
    return (
        f"simulated over predicted at {len(checked.points)} points: mean {checked.mean_ratio:.3f}, from "
        f"{checked.smallest_ratio:.3f} to {checked.largest_ratio:.3f}; each ± {checked.mean_ratio_error:.3f}"
    )


def show(file: Path, result: dict[str, Any]) -> None:
    """Show a plan in the terminal."""
    from skyless.planning.report import described

    print_facts(f"{result['site']} ({file}): {described(result)}", _facts(result).items())
    print_warnings(result["warnings"])


def _page(result: dict[str, Any], mapped: "PlanMap", background: "Background") -> str:
    """The plan as a page."""
    from skyless.planning.page import page
    from skyless.planning.picture import draw_layer, layers_for
    from skyless.planning.report import described

    sections = [
        (layer.title.capitalize() if layer.title.islower() else layer.title, draw_layer(mapped, layer, background))
        for layer in layers_for(mapped)
    ]
    facts = _facts(result)
    for anchor in result["anchors"]:
        position = f"({anchor['x_m']:g}, {anchor['y_m']:g}, {anchor['z_m']:g}) m"
        silent = "" if anchor["sends"] else ", silent"
        facts[f"anchor {anchor['id']}"] = (
            f"{position}, hears {anchor['hears_master']:.0%} of the master's frames{silent}"
        )
    title = f"Plan of {result['site']}"
    return page(title, described(result), facts, result["warnings"], sections, _NOTES)


def write_site(out: Path, site: "Site", source: Path) -> None:
    """Write an optimised site, made from ``source``, with the path of its image relative to the new file.

    Raises SkylessError when it cannot be written.
    """
    from skyless.site.check import check_site
    from skyless.site.template import site_template

    if site.floor_plan is not None:
        image = os.path.relpath(source.parent / site.floor_plan.image, out.parent)
        site = msgspec.structs.replace(site, floor_plan=msgspec.structs.replace(site.floor_plan, image=image))
    check_site(site, out)
    write_file(out, site_template(site).encode())


def write_files(
    file: Path,
    site: "Site",
    floor: "Floor",
    mapped: "PlanMap",
    result: dict[str, Any],
    plot: Path | None,
    grid: Path | None,
    html: Path | None,
) -> None:
    """Write the files that were asked for. Raises SkylessError when one cannot be written."""
    if grid is not None:
        from skyless.planning.maps import csv_lines, geojson_lines

        with new_table(grid) as table:
            is_csv = grid.suffix.lower() == ".csv"
            table.writelines(csv_lines(mapped) if is_csv else geojson_lines(mapped, site.georeference))
    if plot is None and html is None:
        return
    from skyless.evaluation.figures import save_figure
    from skyless.planning.picture import Background, draw_layer, main_layer
    from skyless.planning.report import described

    background = Background(site, floor, file, described(result))
    if plot is not None:
        try:
            save_figure(draw_layer(mapped, main_layer(mapped), background), plot)
        except (OSError, ValueError) as error:
            raise SkylessError(f"{plot} cannot be written: {error}") from None
    if html is not None:
        write_file(html, _page(result, mapped, background).encode())
