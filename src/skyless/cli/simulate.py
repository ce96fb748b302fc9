"""``skyless simulate``: a site in the simulated world, judged against the truth."""

import csv
import sys
import time
from collections.abc import Sequence
from itertools import pairwise
from math import dist
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, TextIO

from cyclopts import App, Parameter
from cyclopts.validators import Number

from skyless.arguments import process_noise
from skyless.cli.common.options import (
    NotNegative,
    Picoseconds,
    Positive,
    ProtectionOptions,
    Seed,
    check_method,
    check_output,
    finite_numbers,
    options,
)
from skyless.cli.common.output import NO_FIX, cm, new_table, print_facts, print_json
from skyless.cli.common.progress import loading_kernels, progress_bar
from skyless.cli.common.simulated_site import check_simulated
from skyless.errors import SkylessError
from skyless.method_names import DEFAULT_METHOD, Dynamics

if TYPE_CHECKING:
    from skyless.evaluation.fleet import FleetReport, JudgedFix, TagFleet
    from skyless.evaluation.scenarios import Request
    from skyless.simulation.impairments import AnchorBias, AnchorOutage, DelayError, Outage
    from skyless.site.model import Site

_Share = Annotated[float, Parameter(validator=Number(gte=0, lt=1))]

_ROOM: Final = "room"

_LATEST_S: Final = 1e8
"""Three years: the 64 bits of unwrapped ticks last four and a half."""

_SHORTEST_M: Final = 0.01
"""Of the legs of a path, whose corners are rounded on them."""

_LONGEST_DELAY_NS: Final = 1000.0
"""Of an antenna: the range of a site file."""

FIXES_CSV_COLUMNS: Final = (
    *("t_s", "tag"),
    *("x_m", "y_m", "z_m", "var_x_m2", "var_y_m2", "var_z_m2", "truth_x_m", "truth_y_m", "truth_z_m", "anchors"),
    *("hpl_m", "vpl_m", "integrity_risk", "alert"),
)
"""Columns of the file that --fixes-csv writes."""

app = App(
    name="simulate",
    help_epilogue=(
        "Example: skyless simulate --scenario lab --method joint --noise-ps 100 --position 3,4 --fixes 3000 --seed 7"
    ),
)


@options
class SimulateOptions:
    """Options of ``skyless simulate``."""

    scenario: str | None = None
    """A named site: lab (six anchors on the walls of 6 m × 8 m, 2-D), the default; room (the lab as real rooms are:
    anchors 2 cm off per axis, ranges 5 cm off, and more with the distance, tags with random acceleration)."""
    site: Path | None = None
    """Site file instead of a named site. Positions of anchors and ranges are wrong by chance, as its [accuracy]
    states; all its deviations 0: exact."""
    method: str = DEFAULT_METHOD
    """How positions are computed: literal, literal-delayed, weighted, bracketed or joint.
    Fixes of all but joint hold at the master's message that they refer to, but are judged when made."""
    position: list[str] | None = None
    """Where a tag lies still, x,y or x,y,z in metres; may be given several times."""
    waypoints: list[str] | None = None
    """A tag's path, "x,y;x,y;..." with or without z, walked once, or for ever if it ends where it begins;
    repeatable."""
    tags: Annotated[int, Parameter(validator=Number(gte=1, lte=10_000))] | None = None
    """How many tags walk about where neither --position nor --waypoints is given; 1 by default."""
    speed: Annotated[float, Parameter(validator=Number(gt=0, lte=1000))] | None = None
    """How fast tags walk, in m/s; 1 by default. In the room only for --waypoints."""
    qa: Positive | None = None
    """Process noise that joint assumes: spectral density of the acceleration, m²/s³; by default 0.3."""
    dynamics: Dynamics | None = None
    """How tags move: walk (as people), robot or drone, which sets the process noise instead of --qa."""
    protection: ProtectionOptions = ProtectionOptions()
    noise_ps: Picoseconds | None = None
    """Noise of every TX and RX stamp in picoseconds, known to the filters; by default the site's own figures."""
    fixes: Annotated[int, Parameter(validator=Number(gte=1))] | None = None
    """Stop when every tag has this many judged fixes (one per superframe), or has had none for 60 s."""
    duration: Positive | None = None
    """Seconds to simulate; by default 60 unless --fixes is given."""
    settle: NotNegative = 2.0
    """Seconds from the start that are not judged, simulated; less than the run lasts."""
    seed: Seed = 1
    """Same seed, same bytes and ticks."""
    loss: _Share = 0.0
    """Probability that a message is lost."""
    nlos: _Share = 0.0
    """Probability that a message reaches a tag late."""
    nlos_mean: Positive = 1.0
    """Mean delay of such a message in metres."""
    bias: list[str] | None = None
    """ANCHOR:METRES, or ANCHOR:METRES:BURST_S for bursts: tags hear this anchor late."""
    outage: list[str] | None = None
    """ANCHOR:OFF_S or ANCHOR:OFF_S:ON_S: an anchor that stops, and restarts."""
    delay_error: list[str] | None = None
    """ANCHOR:TX_NS:RX_NS: by how much this anchor's antenna delays are longer than in its site file."""
    silence: list[str] | None = None
    """FROM_S or FROM_S:TO_S: the tags' radios hear nothing from then on, or for that time."""
    power_bias: bool = False
    """Give RX stamps the DW1000's bias by received power."""
    temperature: bool = False
    """Let the crystals warm up and swing."""
    fixes_csv: Path | None = None
    """Write every fix with its truth into this file."""
    json: bool = False
    """Write one JSON object instead of the table."""

    def __post_init__(self) -> None:
        """Raises SkylessError when options contradict each other."""
        check_output("fixes-csv", self.fixes_csv, self.site)
        if self.position and not self.waypoints and (self.tags is not None or self.speed is not None):
            raise SkylessError(
                "--position is for tags that lie still, --tags and --speed for tags that walk; give either"
            )
        if self.waypoints and self.tags is not None:
            raise SkylessError(
                "--waypoints is the path of one tag, --tags a number of tags that walk about; give either"
            )
        if self.scenario == _ROOM and self.speed is not None and not self.waypoints:
            raise SkylessError(
                "--speed is for tags that walk from point to point; those of --scenario room accelerate at "
                "random, or give --waypoints"
            )

    @property
    def until_s(self) -> float:
        """When the run ends, unless it reaches its goal before."""
        from skyless.evaluation.fleet_run import end_s

        return end_s(self.duration, self.fixes)


@app.default
def simulate(*, asked: SimulateOptions = SimulateOptions()) -> int:
    """Run a site faster than real time and report the errors of its tags.

    Anchors and tags are the machines that would run on radios; clocks, noise, air and motion are simulated.

    Ends with exit code 1 if no fix was judged, and names the reason.
    """
    check_method(asked.method)
    request = _request(asked)
    check_simulated(request.site, request.method)
    if asked.settle >= asked.until_s:
        raise SkylessError(
            f"--settle is {asked.settle:g}; a run of {asked.until_s:g} s (--duration) ends before any fix is judged"
        )
    result, reason = _run(request, asked)
    if asked.json:
        import msgspec

        settings = {
            "seed": asked.seed, "noise_ps": asked.noise_ps, "warmup_s": asked.settle, "site": request.site.name,
            "errors_drawn": request.room,
        }  # fmt: skip
        print_json({**msgspec.to_builtins(result), **settings})
    else:
        _show(result, request)
    if result.fixes:
        return 0
    print(f"skyless: no fix: {_why_none(result, reason, request, asked)}", file=sys.stderr)
    return NO_FIX


def _why_none(result: "FleetReport", reason: str, request: "Request", asked: SimulateOptions) -> str:
    """Why no fix was judged; ``reason`` is that of the first tag's receiver."""
    from skyless.site.advice import RADIO_REACH_M, too_few_anchors

    if result.tags_without_fix < result.tags:
        return f"all came before --settle, {asked.settle:g} s; the run should last longer (--duration)"
    if too_few := too_few_anchors(request.site):
        return too_few
    if result.messages == 0:
        reach = f"no anchor within {RADIO_REACH_M:.0f} m, the range in the open, or none that is on (--outage)"
        return f"the tags heard nothing: {reach}"
    if result.drops.get("radio-off") == result.messages:
        return f"the tags' radios were off all the time (--silence); {result.messages} messages were lost on them"
    most = sorted(result.drops.items(), key=lambda item: -item[1])[:3]
    drops = f"; dropped: {', '.join(f'{count} × {name}' for name, count in most)}" if most else ""
    return f"tags heard {result.messages} messages in {result.simulated_s:g} s, and had no position: {reason}{drops}"


# What is simulated


def _request(asked: SimulateOptions) -> "Request":
    from skyless.evaluation.scenarios import Request, room_of

    site, at_rest = _site(asked), bool(asked.position) and not asked.waypoints
    return Request(
        site=site,
        room=room_of(site, asked.seed, is_named_room=asked.scenario == _ROOM, at_rest=at_rest),
        method=asked.method,
        seed=asked.seed,
        noise_ps=asked.noise_ps,
        positions_m=tuple(finite_numbers("position", text, (2, 3)) for text in asked.position or ()),
        paths_m=tuple(map(_path, asked.waypoints or ())),
        tags=asked.tags or 1,
        speed_mps=asked.speed or 1.0,
        qa=process_noise(asked.qa, asked.dynamics) or 0.3,
        integrity=asked.protection.requirement(asked.method),
        warmup_s=asked.settle,
        most_fixes=asked.fixes,
        loss=asked.loss,
        nlos=asked.nlos,
        nlos_mean_m=asked.nlos_mean,
        power_bias=asked.power_bias,
        temperature=asked.temperature,
        biases=tuple(map(_bias, asked.bias or ())),
        outages=tuple(map(_outage, asked.outage or ())),
        delay_errors=_delay_errors(asked.delay_error or []),
        silences=tuple(map(_silence, asked.silence or ())),
    )


def _site(asked: SimulateOptions) -> "Site":
    """The site of that name, or in that file; the lab by default. Raises SkylessError."""
    from msgspec.structs import replace

    from skyless.site.lab import ideal_lab_site, lab_site
    from skyless.site.load import load_site

    if asked.site is not None:
        if asked.scenario is not None:
            raise SkylessError("give either --scenario or --site, not both")
        return load_site(asked.site)
    if asked.scenario not in {None, "lab", _ROOM}:
        raise SkylessError(
            f"--scenario is {asked.scenario!r}; it should be lab or room (or give a site file with --site)"
        )
    return replace(lab_site(), name=_ROOM) if asked.scenario == _ROOM else ideal_lab_site()


def _path(text: str) -> tuple[tuple[float, ...], ...]:
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


def _bias(text: str) -> "AnchorBias":
    """ANCHOR:METRES or ANCHOR:METRES:BURST_S. Raises SkylessError."""
    from skyless.simulation.impairments import AnchorBias

    anchor, metres, *burst = finite_numbers("bias", text, (2, 3), ":")
    if burst and burst[0] <= 0.0:
        raise SkylessError(f"--bias is {text!r}; a burst should last longer than 0 s")
    return AnchorBias(_whole("bias", text, anchor), metres, *burst)


def _outage(text: str) -> "AnchorOutage":
    """ANCHOR:OFF_S or ANCHOR:OFF_S:ON_S. Raises SkylessError."""
    from skyless.simulation.impairments import AnchorOutage

    anchor, *times_s = finite_numbers("outage", text, (2, 3), ":")
    outage = _off_and_on("outage", text, times_s, "the anchor should come back after it has stopped")
    return AnchorOutage(_whole("outage", text, anchor), outage)


def _silence(text: str) -> "Outage":
    """FROM_S or FROM_S:TO_S. Raises SkylessError."""
    times_s = finite_numbers("silence", text, (1, 2), ":")
    return _off_and_on("silence", text, times_s, "it should end after it has begun")


def _off_and_on(option: str, text: str, times_s: Sequence[float], order: str) -> "Outage":
    from skyless.simulation.impairments import Outage

    if len(times_s) == 2 and times_s[1] <= times_s[0]:
        raise SkylessError(f"--{option} is {text!r}; {order}")
    if not 0.0 <= times_s[0] <= times_s[-1] <= _LATEST_S:
        raise SkylessError(f"--{option} is {text!r}; times should be 0 s or later, and at most {_LATEST_S:g} s")
    return Outage(*times_s)


def _delay_errors(texts: list[str]) -> "tuple[DelayError, ...]":
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


# The run


def _run(request: "Request", asked: SimulateOptions) -> "tuple[FleetReport, str]":
    """The report, and why the first tag had no fix last."""
    from skyless.evaluation.compile_ahead import compile_kernels
    from skyless.evaluation.fleet import report
    from skyless.evaluation.scenarios import fleet_of_any_size
    from skyless.preparation.parts import parts_of

    try:
        fleet = fleet_of_any_size(request)
    except ValueError as error:
        raise SkylessError(str(error)) from None
    with loading_kernels(*parts_of(request.method)):
        compile_kernels(request.method)
    started_s = time.perf_counter()
    if asked.fixes_csv is None:
        _advance(fleet, request, asked.until_s, None)
    else:
        with new_table(asked.fixes_csv) as file:
            _advance(fleet, request, asked.until_s, file)
    return report(fleet, request.method, started_s), str(fleet.receivers[0].reason)


def _advance(fleet: "TagFleet", request: "Request", until_s: float, file: TextIO | None) -> None:
    """Run to the end, with a bar; every fix becomes a row of the file."""
    from skyless.evaluation.fleet_run import run_fleet

    write = None if file is None else csv.writer(file).writerow
    if write is not None:
        write(FIXES_CSV_COLUMNS)
    on_fix = None if write is None else lambda judged: write(_row(judged))
    with progress_bar("simulating", 1.0) as bar:
        run_fleet(fleet, request, until_s, on_fix, bar.reach)


def _row(judged: "JudgedFix") -> tuple[object, ...]:
    """One fix as a row of ``FIXES_CSV_COLUMNS``."""
    fix = judged.fix
    numbers = [*fix.position_m, *fix.covariance_m2.diagonal(), *judged.truth_m]
    levels = ("" if one is None else f"{one:.4g}" for one in (fix.hpl_m, fix.vpl_m, fix.integrity_risk))
    return (
        *(f"{judged.time_s:.6f}", judged.tag, *(f"{value:.6g}" for value in numbers)),
        *(" ".join(map(str, fix.anchors)), *levels, fix.alert or ""),
    )


# The report


def _without_fix(result: "FleetReport") -> list[tuple[str, str]]:
    """How many tags have had no fix at all, where there are any: nothing else in the table counts them."""
    without = result.tags_without_fix
    return [("tags without a fix", f"{without} of {result.tags}")] if without else []


def _show(result: "FleetReport", request: "Request") -> None:
    from skyless.evaluation.scenarios import errors_words
    from skyless.evaluation.statistics import dimensions

    of_all = dimensions(planar=request.site.tags.height_m is not None)
    facts = [
        ("errors drawn", f"{errors_words(request.site, request.room)}; seed {request.seed}"),
        ("simulated time", f"{result.simulated_s:.1f} s in {result.wall_s:.1f} s ({result.speed:.1f} × real time)"),
        ("messages at tags", f"{result.messages} ({result.dropped} dropped)"),
        ("fixes judged", f"{result.fixes}"),
        ("updates", f"{result.updates_per_s:.1f} per second and tag"),
        *_without_fix(result),
        ("first fix", "none" if result.first_fix_s is None else f"{result.first_fix_s:.3f} s after power-on"),
        (f"RMSE {of_all}", cm(result.rmse_m)),
        (f"predicted σ {of_all}", cm(result.sigma_m)),
        (f"95 % {of_all}", cm(result.p95_m)),
        (f"largest {of_all}", cm(result.max_m)),
    ]
    if (levels := result.levels) is not None:
        alerts = ", ".join(f"{alert} {count}" for alert, count in levels.alerts.items() if alert != "none")
        available = f"{100 * levels.available:.1f} % of the fixes"
        facts += [
            ("protection level", f"median {cm(levels.hpl_m)}, for {available}"),
            ("errors beyond it", f"{levels.misleading} (stated risk {levels.integrity_risk:g})"),
            ("alerts", alerts or "none"),
        ]
    drops = [(f"dropped: {reason}", str(count)) for reason, count in result.drops.items()]
    print_facts(f"{result.method}, {result.tags} tag(s)", [*facts, *drops])
