"""What ``skyless simulate`` is given: the texts of its options become values."""

from collections.abc import Sequence
from itertools import pairwise
from math import dist
from pathlib import Path
from typing import TYPE_CHECKING, Final

from skyless.cli.common.options import finite_numbers
from skyless.errors import SkylessError

if TYPE_CHECKING:
    from skyless.simulation.impairments import AnchorBias, AnchorOutage, DelayError, Outage
    from skyless.site.model import Site

_LATEST_S: Final = 1e8
"""Three years: the 64 bits of unwrapped ticks last four and a half."""

_SHORTEST_M: Final = 0.01
"""Of the legs of a path, which are where its corners find room."""

_LONGEST_DELAY_NS: Final = 1000.0
"""Of an antenna, as far as a site file can tell it."""


ROOM: Final = "room"


def site_of(scenario: str | None, file: Path | None) -> "Site":
    """The site of that name, or in that file; the lab by default. Raises SkylessError."""
    from msgspec.structs import replace

    from skyless.site.lab import ideal_lab_site, lab_site
    from skyless.site.load import load_site

    if file is not None:
        if scenario is not None:
            raise SkylessError("give either --scenario or --site, not both")
        return load_site(file)
    if scenario not in {None, "lab", ROOM}:
        raise SkylessError(f"--scenario is {scenario!r}; it should be lab or room (or give a site file with --site)")
    return replace(lab_site(), name=ROOM) if scenario == ROOM else ideal_lab_site()


def path_of(text: str) -> tuple[tuple[float, ...], ...]:
    """Points of a path, x,y or x,y,z each, separated by semicolons or spaces. Raises SkylessError."""
    from skyless.air.page_codec import MAX_COORDINATE_M

    points = tuple(finite_numbers("waypoints", part, (2, 3)) for part in text.replace(";", " ").split())
    if len(points) < 2:
        raise SkylessError(f"--waypoints is {text!r}; it should be two or more points in quotes, 'x,y;x,y;x,y'")
    if len({len(point) for point in points}) > 1:
        raise SkylessError(f"--waypoints is {text!r}; all of its points should have a height, or none")
    if any(abs(value) > MAX_COORDINATE_M for point in points for value in point):
        raise SkylessError(f"--waypoints is {text!r}; its points should lie within {MAX_COORDINATE_M:g} m")
    if any(dist(a, b) < _SHORTEST_M for a, b in pairwise(points)):
        raise SkylessError(f"--waypoints is {text!r}; from point to point it should be {_SHORTEST_M:g} m or more")
    return points


def bias_of(text: str) -> "AnchorBias":
    """ANCHOR:METRES or ANCHOR:METRES:BURST_S. Raises SkylessError."""
    from skyless.simulation.impairments import AnchorBias

    anchor, metres, *burst = finite_numbers("bias", text, (2, 3), ":")
    if burst and burst[0] <= 0.0:
        raise SkylessError(f"--bias is {text!r}; a burst should last longer than 0 s")
    return AnchorBias(_whole("bias", text, anchor), metres, *burst)


def outage_of(text: str) -> "AnchorOutage":
    """ANCHOR:OFF_S or ANCHOR:OFF_S:ON_S. Raises SkylessError."""
    from skyless.simulation.impairments import AnchorOutage

    anchor, *times_s = finite_numbers("outage", text, (2, 3), ":")
    outage = _off_and_on("outage", text, times_s, "the anchor should come back after it has stopped")
    return AnchorOutage(_whole("outage", text, anchor), outage)


def silence_of(text: str) -> "Outage":
    """FROM_S or FROM_S:TO_S. Raises SkylessError."""
    return _off_and_on("deaf", text, finite_numbers("deaf", text, (1, 2), ":"), "it should end after it has begun")


def _off_and_on(option: str, text: str, times_s: Sequence[float], order: str) -> "Outage":
    from skyless.simulation.impairments import Outage

    if len(times_s) == 2 and times_s[1] <= times_s[0]:
        raise SkylessError(f"--{option} is {text!r}; {order}")
    if not 0.0 <= times_s[0] <= times_s[-1] <= _LATEST_S:
        raise SkylessError(f"--{option} is {text!r}; times should be 0 s or later, and at most {_LATEST_S:g} s")
    return Outage(*times_s)


def delay_errors_of(texts: list[str]) -> "tuple[DelayError, ...]":
    """ANCHOR:TX_NS:RX_NS, each of another anchor. Raises SkylessError."""
    from skyless.constants import TICK_S
    from skyless.simulation.impairments import DelayError

    errors: dict[int, DelayError] = {}
    for text in texts:
        number, *delays_ns = finite_numbers("delay-error", text, (3,), ":")
        anchor = _whole("delay-error", text, number)
        if anchor in errors:
            raise SkylessError(f"--delay-error is {text!r}; anchor {anchor} already has one")
        if any(abs(delay_ns) > _LONGEST_DELAY_NS for delay_ns in delays_ns):
            raise SkylessError(f"--delay-error is {text!r}; delays should be within {_LONGEST_DELAY_NS:g} ns")
        errors[anchor] = DelayError(anchor, *(delay_ns * 1e-9 / TICK_S for delay_ns in delays_ns))
    return tuple(errors.values())


def _whole(option: str, text: str, anchor: float) -> int:
    if not anchor.is_integer():
        raise SkylessError(f"--{option} is {text!r}; the anchor should be a whole number")
    return int(anchor)
