"""What ``skyless plan`` is given: its files and the texts of its options become values."""

from pathlib import Path
from typing import TYPE_CHECKING

from skyless.cli.common.options import finite_numbers, known_method, spare_inputs
from skyless.errors import ConfigurationError, SkylessError

if TYPE_CHECKING:
    from skyless.kernels.arrays import Matrix
    from skyless.planning.floor import Box, Floor
    from skyless.planning.mounts import Mounts
    from skyless.planning.predict import PlanSettings
    from skyless.site.model import Site


def load_inputs(file: Path, outputs: dict[str, Path | None]) -> "Site":
    """Read the site and its image, and see that no output is an input or another output. Raises SkylessError."""
    from skyless.site.load import load_site

    site = load_site(file)
    image = None if site.floor_plan is None else file.parent / site.floor_plan.image
    for name, path in outputs.items():
        spare_inputs(name, path, file, image, *(other for key, other in outputs.items() if key != name))
    if outputs["grid"] is not None and outputs["grid"].suffix.lower() not in {".csv", ".geojson", ".json"}:
        raise SkylessError(f"--grid is {str(outputs['grid'])!r}; it should end with .csv or .geojson")
    if outputs["out"] is not None and outputs["out"].exists():
        raise SkylessError(f"--out is {str(outputs['out'])!r}, which exists; it should be a new file")
    if image is not None:
        _check_image(file, site, image)
    return site


def _check_image(file: Path, site: "Site", image: Path) -> None:
    """See that the whole image can be read, not only its size."""
    from matplotlib.image import imread

    try:
        imread(image)
    except (OSError, SyntaxError, ValueError) as error:
        shown = site.floor_plan.image if site.floor_plan else ""
        right = f"an image that can be read to its end ({' '.join(str(error).split())})"
        raise ConfigurationError(file, "floor_plan.image", shown, right) from None


def settings_of(method: str, noise_ps: float | None, qa: float, range_m: float | None) -> "PlanSettings":
    """How tags compute, and how far a frame carries, ``range_m`` None for the link budget's. Raises SkylessError."""
    from skyless.planning.links import with_range
    from skyless.planning.predict import PlanSettings
    from skyless.simulation.channel import ChannelModel

    known_method(method)
    channel = ChannelModel() if range_m is None else with_range(ChannelModel(), range_m)
    return PlanSettings(method, noise_ps, qa, channel)


def check_count(site: "Site", file: Path) -> None:
    """See that the site has anchors enough for a position. Raises ConfigurationError."""
    needed, what = (4, "with its height") if site.tags.height_m is None else (3, "at a known height")
    if len(site.anchors) < needed:
        right = f"at least {needed}, which a position {what} needs"
        raise ConfigurationError(file, "anchors", f"a list of {len(site.anchors)}", right)


def outline_of(text: str | None) -> "Matrix | None":
    """Corners of the floor, shape (n, 2) in metres, None if not asked for. Raises SkylessError."""
    import numpy as np

    if text is None:
        return None
    corners = [finite_numbers("outline", part, (2,)) for part in text.replace(";", " ").split()]
    if len(corners) < 3:
        raise SkylessError(f"--outline is {text!r}; it should be three or more corners, 'x1,y1 x2,y2 x3,y3'")
    return np.array(corners)


def region_of(text: str | None) -> "Box | None":
    """The region of interest in metres, None if not asked for. Raises SkylessError."""
    if text is None:
        return None
    x1, y1, x2, y2 = finite_numbers("region", text, (4,))
    if not (x2 > x1 and y2 > y1):
        raise SkylessError(f"--region is {text!r}; it should be x1,y1,x2,y2 with x1 < x2 and y1 < y2")
    return x1, y1, x2, y2


def tag_heights_of(text: str | None, site: "Site") -> tuple[float, ...]:
    """Heights of the maps: the known one, or those asked for, or three between the lowest and the highest anchor.

    Raises SkylessError when heights are asked for at a site that knows its tags' height.
    """
    if site.tags.height_m is not None:
        if text is not None:
            raise SkylessError(f"--slices is {text!r}; this site's tags are all at {site.tags.height_m:g} m")
        return (site.tags.height_m,)
    if text is not None:
        return _numbers("slices", text)
    low, high = _lowest_and_highest(site)
    return tuple(round(low + share * (high - low), 2) for share in (1 / 6, 1 / 2, 5 / 6))[: 3 if high > low else 1]


def mounts_of(site: "Site", floor: "Floor", heights: str | None, walls: list[str]) -> "Mounts":
    """Where anchors may hang: ``walls``, or the floor's sides, at ``heights``. Raises SkylessError."""
    import numpy as np

    from skyless.planning.floor import sides, total_length
    from skyless.planning.mounts import Mounts

    segments = np.array([finite_numbers("mounts", text, (4,)) for text in walls]) if walls else sides(floor.outline_m)
    if not total_length(segments) > 0.0:
        raise SkylessError("--mounts has no length; it should be x1,y1,x2,y2 with two different ends")
    levels = _numbers("heights", heights) if heights is not None else tuple(dict.fromkeys(_lowest_and_highest(site)))
    return Mounts(segments, levels)


def _numbers(option: str, text: str) -> tuple[float, ...]:
    return finite_numbers(option, text, (text.count(",") + 1,))


def _lowest_and_highest(site: "Site") -> tuple[float, float]:
    levels = [anchor.z_m for anchor in site.anchors]
    return min(levels), max(levels)
