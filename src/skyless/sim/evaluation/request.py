"""A simulation's options, except for its site: shared by ``skyless simulate`` and ``Request``."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

from msgspec import Struct

from skyless.arguments import (
    ComputedOptions,
    Method,
    NotNegative,
    Option,
    Picoseconds,
    Positive,
    Rule,
    Seed,
    Text,
    check_number,
    number,
    points,
    read_numbers,
    read_points,
    sequence,
    tag_count,
    whole,
    wrong,
)
from skyless.core.air.site_pages import MAX_COORDINATE_M
from skyless.core.errors import SkylessError
from skyless.core.method_names import DEFAULT_METHOD, METHODS, PROTECTED

if TYPE_CHECKING:
    from skyless.core.integrity import IntegrityRequirement
    from skyless.sim.impairments import AnchorBias, AnchorOutage, DelayError, Outage

SHORTEST_LEG_M: Final = 0.01
"""Length of a path's legs, on which its corners are rounded."""

_LATEST_S: Final = 1e8
"""Three years: the 64 bits of unwrapped ticks last four and a half."""

_LONGEST_DELAY_NS: Final = 1000.0
"""An antenna's delay: the range of a site file."""

_Share = Annotated[float, number(least=0.0, below=1.0)]
IntegrityRisk = Annotated[float, number(above=0.0, most=0.1)]


class ProtectionOptions(ComputedOptions, frozen=True, kw_only=True):
    """What is required of protection levels."""

    integrity_risk: IntegrityRisk | None = None
    """Probability, for each fix, that the error exceeds its protection level (joint); 1e-4 by default."""
    alert_limit_m: Positive | None = None
    """Fixes whose protection level exceeds this, in metres, carry an alert (joint)."""

    def requirement(self, method: str | None = None, height_std_m: float | None = None) -> "IntegrityRequirement":
        """Them and --tag-height-std as the filter takes them.

        Raises SkylessError: the method gives no protection levels, so that a limit would have no effect.
        """
        from skyless.core.integrity import RISK, IntegrityRequirement  # noqa: PLC0415 - help needs no NumPy

        if method in METHODS and method != PROTECTED:
            why = f"{method} gives no protection levels"
            self.leave_out("integrity_risk", "alert_limit_m", why=why)
            if height_std_m is not None:
                raise SkylessError(f"--tag-height-std is {height_std_m:g}; it should be left out: {why}")
        return IntegrityRequirement(self.integrity_risk or RISK, self.alert_limit_m, height_std_m or 0.0)


# From texts to faults, and which faults can be simulated


def _anchor_and_more(name: str, text: str, counts: tuple[int, ...]) -> tuple[int, list[float]]:
    """ANCHOR:NUMBER:... Raises SkylessError."""
    anchor, *more = read_numbers(name, text, counts, ":")
    if not anchor.is_integer():
        raise SkylessError(f"{name} is {text!r}; the anchor should be a whole number")
    return int(anchor), more


def _read_bias(name: str, text: str) -> "AnchorBias":
    from skyless.sim.impairments import AnchorBias  # noqa: PLC0415

    anchor, more = _anchor_and_more(name, text, (2, 3))
    return AnchorBias(anchor, *more)


def _read_outage(name: str, text: str) -> "AnchorOutage":
    from skyless.sim.impairments import AnchorOutage, Outage  # noqa: PLC0415

    anchor, more = _anchor_and_more(name, text, (2, 3))
    return AnchorOutage(anchor, Outage(*more))


def _read_delay_error(name: str, text: str) -> "DelayError":
    from skyless.core.ticks import TICK_S  # noqa: PLC0415
    from skyless.sim.impairments import DelayError  # noqa: PLC0415

    anchor, more = _anchor_and_more(name, text, (3,))
    if any(abs(delay_ns) > _LONGEST_DELAY_NS for delay_ns in more):
        raise SkylessError(f"{name} is {text!r}; delays should be within {_LONGEST_DELAY_NS:g} ns")
    return DelayError(anchor, *(delay_ns * 1e-9 / TICK_S for delay_ns in more))


def _read_silence(name: str, text: str) -> "Outage":
    from skyless.sim.impairments import Outage  # noqa: PLC0415

    return Outage(*read_numbers(name, text, (1, 2), ":"))


def _faults(kind: str) -> Rule:
    """Values of a type of ``skyless.sim.impairments``."""

    def check(name: str, values: Any) -> tuple[Struct, ...]:  # noqa: ANN401 - what a user gives
        from skyless.sim import impairments  # noqa: PLC0415

        faults = sequence(name, values, f"values of {kind}")
        for index, fault in enumerate(faults):
            if not isinstance(fault, getattr(impairments, kind)):
                raise wrong(f"{name}[{index}]", fault, f"a skyless.sim.impairments.{kind}")
            _check_fault(f"{name}[{index}]", fault)
        return faults

    return Rule(check)


def _check_fault(name: str, fault: Any) -> None:  # noqa: ANN401 - of any kind
    outage = getattr(fault, "outage", fault)
    off_s, on_s = getattr(outage, "off_s", 0.0), getattr(outage, "on_s", math.inf)
    if not 0.0 <= off_s <= _LATEST_S or not (off_s < on_s <= _LATEST_S or on_s == math.inf):
        times = f"times from 0 s to {_LATEST_S:g} s, of which the later one ends it"
        raise SkylessError(f"{name} is from {off_s:g} s to {on_s:g} s; it should be two {times}")
    burst_s = getattr(fault, "burst_s", None)
    if burst_s is not None:
        check_number(f"{name}.burst_s", burst_s, above=0.0)


_POINTS: Final = points(2, 3, form="points, (x, y) or (x, y, z)", farthest_m=MAX_COORDINATE_M)


def _check_paths(name: str, values: Any) -> tuple[tuple[tuple[float, ...], ...], ...]:  # noqa: ANN401
    found = sequence(name, values, "paths, two or more points each")
    return tuple(_checked_path(f"{name}[{index}]", path_m) for index, path_m in enumerate(found))


def _checked_path(name: str, path_m: Sequence[Sequence[float]]) -> tuple[tuple[float, ...], ...]:
    points_m: tuple[tuple[float, ...], ...] = _POINTS.check(name, path_m)
    if len(points_m) < 2:
        raise wrong(name, path_m, "two or more points, x,y or x,y,z in metres each")
    if len({len(point_m) for point_m in points_m}) > 1:
        raise wrong(name, path_m, "points that all have a height, or none")
    if any(math.dist(a, b) < SHORTEST_LEG_M for a, b in pairwise(points_m)):
        raise wrong(name, path_m, f"points that are {SHORTEST_LEG_M:g} m or more from the ones before them")
    return points_m


class Conditions(ProtectionOptions, frozen=True, kw_only=True):
    """How tags move, compute and are judged, and what goes wrong."""

    method: Method = DEFAULT_METHOD
    """How positions are computed: literal, literal-delayed, weighted, bracketed or joint. Fixes of all but joint hold
    at the master's message that they refer to, but are judged when made."""
    positions_m: Annotated[
        "Sequence[Sequence[float]]",
        Option("position"),
        Text(lambda name, text: read_numbers(name, text, (2, 3)), "x,y or x,y,z", many=True),
        _POINTS,
    ] = ()
    """Where tags lie still, x, y or x, y, z in metres each."""
    paths_m: Annotated[
        "Sequence[Sequence[Sequence[float]]]",
        Option("waypoints"),
        Text(lambda name, text: read_points(name, text, (2, 3)), '"x,y;x,y;..."', many=True),
        Rule(_check_paths),
    ] = ()
    """Paths of tags, two or more points in metres each, walked once, or for ever if it ends where it begins."""
    tags: Annotated[int | None, *tag_count(1, 10_000)] = None
    """How many tags walk about where neither --position nor --waypoints is given; 1 by default."""
    speed_mps: Annotated[float | None, Option("speed"), number(above=0.0, most=1000.0)] = None
    """How fast tags walk, in m/s; 1 by default. In the room only for --waypoints."""
    noise_ps: Picoseconds | None = None
    """Noise of every TX and RX stamp in picoseconds, known to the filters; by default the site's own figures."""
    fixes: Annotated[int | None, whole(1)] = None
    """Stop when every tag has this many judged fixes (one per superframe), or has had none for 60 s."""
    settle_s: Annotated[NotNegative, Option("settle")] = 2.0
    """Seconds from the start that are not judged, simulated; less than the run lasts."""
    seed: Seed = 1
    """Same seed, same bytes and ticks."""
    loss: _Share = 0.0
    """Probability that a message is lost."""
    nlos: _Share = 0.0
    """Probability that a message reaches a tag late."""
    nlos_mean_m: Annotated[Positive, Option("nlos-mean")] = 1.0
    """Mean delay of such a message in metres."""
    biases: Annotated[
        "Sequence[AnchorBias]",
        Option("bias"),
        Text(_read_bias, "ANCHOR:METRES, or ANCHOR:METRES:BURST_S for bursts", many=True),
        _faults("AnchorBias"),
    ] = ()
    """Anchors that tags hear late."""
    outages: Annotated[
        "Sequence[AnchorOutage]",
        Option("outage"),
        Text(_read_outage, "ANCHOR:OFF_S or ANCHOR:OFF_S:ON_S", many=True),
        _faults("AnchorOutage"),
    ] = ()
    """Anchors that stop, and restart."""
    delay_errors: Annotated[
        "Sequence[DelayError]",
        Option("delay-error"),
        Text(_read_delay_error, "ANCHOR:TX_NS:RX_NS", many=True),
        _faults("DelayError"),
    ] = ()
    """By how much an anchor's antenna delays are longer than in its site file."""
    silences: Annotated[
        "Sequence[Outage]",
        Option("silence"),
        Text(_read_silence, "FROM_S or FROM_S:TO_S", many=True),
        _faults("Outage"),
    ] = ()
    """When the tags' radios hear nothing: from then on, or for that time."""
    temperature: bool = False
    """Let the crystals warm up and swing."""
    carrier: bool = False
    """Let radios measure the phase of the carrier, as a DW1000 can; joint uses it, which needs a tag that moves."""

    carries: Literal["imu", "wheels"] | None = None
    """Motion sensors of the tags, which joint uses: imu, accelerometer and gyroscope in a hand; wheels, odometer and
    gyroscope of a robot; both with errors of low-cost parts. None by default."""

    def check(self) -> None:
        """See that the options fit one another. Raises SkylessError."""
        self.requirement(self.method)
        anchors = [(error.anchor, error.from_s) for error in self.delay_errors]
        for anchor, from_s in anchors:
            if anchors.count((anchor, from_s)) > 1:
                raise SkylessError(f"--delay-error is given twice for anchor {anchor}; it should be given once")
