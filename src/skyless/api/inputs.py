"""What several functions are given: a site as a value or a file, what is required of levels, where progress goes."""

from collections.abc import Callable, Mapping
from pathlib import Path

from skyless.arguments import check_number, existing_file, wrong
from skyless.errors import SkylessError
from skyless.method_names import METHODS, PROTECTED
from skyless.positioning.integrity import RISK, IntegrityRequirement
from skyless.site.check import check_site
from skyless.site.load import load_site
from skyless.site.model import Site

AnySite = Site | str | Path
"""A site, or the path of its file."""

AnyPath = str | Path

Progress = Callable[[float], None]
"""Called now and then with the share of the work that is done, from 0 to 1."""


def site_of(site: AnySite, *, slots_given: bool = True) -> tuple[Site, Path]:
    """A site, and the file that errors name and next to which its image lies; a value without a file is ``site``.

    Raises:
        SkylessError: there is no such file, or the site has a value that cannot be used.
    """
    if isinstance(site, Site):
        file = Path("site")
        check_site(site, file, slots_given=slots_given)
        if site.floor_plan is not None and not Path(site.floor_plan.image).is_file():
            right = "an image in the working folder; or give the path of the site's file, next to which it lies"
            raise wrong("site.floor_plan.image", site.floor_plan.image, right)
        return site, file
    file = existing_file("site", site)
    return load_site(file, slots_given=slots_given), file


def requirement_of(
    method: str | None,
    integrity_risk: float | None,
    alert_limit_m: float | None,
    max_acceleration_mps2: float | None,
    tag_height_std_m: float | None = None,
) -> IntegrityRequirement | None:
    """What is required of protection levels; None if nothing is given.

    Raises:
        SkylessError: a value cannot be, or the method gives no levels.
    """
    check_number("integrity_risk", integrity_risk, above=0.0, most=0.1)
    check_number("alert_limit_m", alert_limit_m, above=0.0)
    check_number("max_acceleration_mps2", max_acceleration_mps2, least=0.0)
    check_number("tag_height_std_m", tag_height_std_m, least=0.0)
    given = {
        "integrity_risk": integrity_risk,
        "alert_limit_m": alert_limit_m,
        "max_acceleration_mps2": max_acceleration_mps2,
        "tag_height_std_m": tag_height_std_m,
    }
    if all(value is None for value in given.values()):
        return None
    if method in METHODS and method != PROTECTED:
        name, value = next((name, value) for name, value in given.items() if value is not None)
        raise SkylessError(f"{name} is {value:g}; it should be left out: {method} gives no protection levels")
    risk = RISK if integrity_risk is None else integrity_risk
    return IntegrityRequirement(risk, alert_limit_m, max_acceleration_mps2 or 0.0, tag_height_std_m or 0.0)


def silent(_share: float) -> None:
    """Where progress goes that nobody asked for."""


def left_out(given: Mapping[str, object], reason: str) -> None:
    """See that arguments that have no effect here are not given. Raises SkylessError."""
    for name, value in given.items():
        if value is not None:
            raise SkylessError(f"{name} is {str(value)!r}; it should be left out: {reason}")
