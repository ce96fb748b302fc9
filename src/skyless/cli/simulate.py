"""``skyless simulate``: a site in the simulated world, judged against the truth."""

import csv
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TextIO

from cyclopts import App, Parameter
from cyclopts.validators import Number

from skyless.cli.options import NotNegative, Picoseconds, Positive, finite_numbers, open_for_writing, spare_inputs
from skyless.cli.output import console, print_json
from skyless.cli.progress import progress_bar, status
from skyless.errors import SkylessError

if TYPE_CHECKING:
    from skyless.experiments.fleet import Fleet, FleetReport, JudgedFix
    from skyless.experiments.scenarios import Request
    from skyless.simulation.impairments import AnchorBias, AnchorOutage
    from skyless.site.model import Site

_Share = Annotated[float, Parameter(validator=Number(gte=0, lt=1))]

_LATEST_S = 1e8
"""Three years: the 64 bits of unwrapped ticks last four and a half."""

app = App(
    name="simulate",
    help_epilogue=(
        "Example: skyless simulate --scenario lab --method tracker --noise-ps 100 --position 3,4 --fixes 3000 --seed 7"
    ),
)


@app.default
def simulate(
    *,
    scenario: str | None = None,
    site: Path | None = None,
    method: str = "tracker",
    position: list[str] | None = None,
    tags: Annotated[int, Parameter(validator=Number(gte=1, lte=10_000))] | None = None,
    speed: Annotated[float, Parameter(validator=Number(gt=0, lte=1000))] | None = None,
    qa: Positive = 0.3,
    noise_ps: Picoseconds | None = None,
    fixes: Annotated[int, Parameter(validator=Number(gte=1))] | None = None,
    duration: Positive | None = None,
    warmup: NotNegative = 2.0,
    seed: Annotated[int, Parameter(validator=Number(gte=0))] = 1,
    loss: _Share = 0.0,
    nlos: _Share = 0.0,
    nlos_mean: Positive = 1.0,
    bias: list[str] | None = None,
    outage: list[str] | None = None,
    power_bias: bool = False,
    temperature: bool = False,
    fixes_csv: Path | None = None,
    json: bool = False,
) -> None:
    """Run a site faster than real time and report the errors of its tags.

    Anchors and tags are the machines that would run on radios; clocks, noise, air and motion are simulated.

    Parameters
    ----------
    scenario
        A named site: lab (six anchors on the walls of 6 m × 8 m, 2-D), the default.
    site
        A site file instead of a named one.
    method
        literal, literal-delayed, weighted, bracketed or tracker.
    position
        Where a tag lies still, x,y or x,y,z in metres; may be given several times. Without it the tags walk about.
    tags
        How many tags walk about; 1 by default.
    speed
        Their speed in m/s; 1 by default.
    qa
        Agility that the tracker assumes, m²/s³.
    noise_ps
        Noise of every TX and RX stamp in picoseconds, known to the filters; by default the site's own figures.
    fixes
        Stop when every tag has so many judged fixes (one per superframe).
    duration
        Stop after so many simulated seconds; by default 60 unless --fixes is given.
    warmup
        Simulated seconds before which fixes are not judged.
    seed
        Same seed, same bytes and ticks.
    loss
        Probability that a message is lost.
    nlos
        Probability that a message reaches a tag late.
    nlos_mean
        Mean delay of such a message in metres.
    bias
        ANCHOR:METRES, or ANCHOR:METRES:BURST_S for bursts: tags hear this anchor late.
    outage
        ANCHOR:OFF_S or ANCHOR:OFF_S:ON_S: an anchor that stops, and restarts.
    power_bias
        Give RX stamps the DW1000's bias by received power.
    temperature
        Let the crystals warm up and swing.
    fixes_csv
        Write every fix with its truth into this file.
    json
        Write one JSON object instead of the table.
    """
    from skyless.experiments.scenarios import Request

    spare_inputs("fixes-csv", fixes_csv, site)
    if position and (tags is not None or speed is not None):
        raise SkylessError("--position is for tags that lie still, --tags and --speed for tags that walk; give either")
    request = Request(
        site=_site(scenario, site),
        method=method,
        seed=seed,
        noise_ps=noise_ps,
        positions_m=tuple(finite_numbers("position", text, (2, 3)) for text in position or ()),
        tags=1 if tags is None else tags,
        speed_mps=1.0 if speed is None else speed,
        qa=qa,
        warmup_s=warmup,
        most_fixes=fixes,
        loss=loss,
        nlos=nlos,
        nlos_mean_m=nlos_mean,
        power_bias=power_bias,
        temperature=temperature,
        biases=tuple(_bias(text) for text in bias or ()),
        outages=tuple(_outage(text) for text in outage or ()),
    )
    result = _run(request, duration, fixes_csv)
    if json:
        import msgspec

        settings = {"seed": seed, "noise_ps": noise_ps, "warmup_s": warmup, "site": request.site.name}
        print_json({**msgspec.to_builtins(result), **settings})
    else:
        show(result)


def _site(scenario: str | None, file: Path | None) -> "Site":
    from skyless.site.lab import lab_site
    from skyless.site.load import load_site

    if file is not None:
        if scenario is not None:
            raise SkylessError("give either --scenario or --site, not both")
        return load_site(file)
    if scenario not in {None, "lab"}:
        raise SkylessError(f"--scenario is {scenario!r}; it should be lab (or give a site file with --site)")
    return lab_site()


def _bias(text: str) -> "AnchorBias":
    from skyless.simulation.impairments import AnchorBias

    anchor, metres, *burst = finite_numbers("bias", text, (2, 3), ":")
    if burst and burst[0] <= 0.0:
        raise SkylessError(f"--bias is {text!r}; a burst should last longer than 0 s")
    return AnchorBias(_whole("bias", text, anchor), metres, *burst)


def _outage(text: str) -> "AnchorOutage":
    from skyless.simulation.impairments import AnchorOutage, Outage

    anchor, *times = finite_numbers("outage", text, (2, 3), ":")
    if len(times) == 2 and times[1] <= times[0]:
        raise SkylessError(f"--outage is {text!r}; the anchor should come back after it has stopped")
    if not 0.0 <= times[0] <= times[-1] <= _LATEST_S:
        raise SkylessError(f"--outage is {text!r}; times should be 0 s or later, and at most {_LATEST_S:g} s")
    return AnchorOutage(_whole("outage", text, anchor), Outage(*times))


def _whole(option: str, text: str, anchor: float) -> int:
    if not anchor.is_integer():
        raise SkylessError(f"--{option} is {text!r}; the anchor should be a whole number")
    return int(anchor)


def _run(request: "Request", duration: float | None, fixes_csv: Path | None) -> "FleetReport":
    from skyless.experiments.fleet import report
    from skyless.experiments.scenarios import fleet_of
    from skyless.experiments.warm import compile_kernels

    try:
        fleet = fleet_of(request)
    except ValueError as error:
        raise SkylessError(str(error)) from None
    with status("loading the kernels; the first start compiles them, which takes some ten seconds"):
        compile_kernels(request.method)
    started_s = time.perf_counter()
    fixes = request.most_fixes
    until_s = duration if duration is not None else (float("inf") if fixes else 60.0)
    if fixes_csv is None:
        _pass_time(fleet, fixes, until_s, None)
    else:
        with open_for_writing(fixes_csv) as file:
            _pass_time(fleet, fixes, until_s, file)
    return report(fleet, request.method, started_s)


def _pass_time(fleet: "Fleet", fixes: int | None, until_s: float, file: TextIO | None) -> None:
    """Let the world run in steps, so that the bar moves and the goal is seen; without any fix it ends after 60 s."""
    writer = None if file is None else csv.writer(file)
    if writer is not None:
        writer.writerow(("t_s", "tag", *COLUMNS))
    goal = fixes if fixes is not None else until_s
    with progress_bar("simulating", goal) as bar:
        now_s = 0.0
        while now_s < until_s and not _enough(fleet, fixes, now_s):
            now_s = min(now_s + 0.25, until_s)
            for judged in fleet.run(now_s):
                if writer is not None:
                    writer.writerow(_row(judged))
            bar.reach(fleet.errors.count / len(fleet.records) if fixes is not None else now_s)


def _enough(fleet: "Fleet", fixes: int | None, now_s: float) -> bool:
    if fixes is None:
        return False
    hopeless = now_s > 60.0 and all(record.fixes == 0 for record in fleet.records)
    return hopeless or all(record.judged >= fixes for record in fleet.records)


COLUMNS = ("x_m", "y_m", "z_m", "var_x_m2", "var_y_m2", "var_z_m2", "truth_x_m", "truth_y_m", "truth_z_m", "anchors")


def _row(judged: "JudgedFix") -> tuple[object, ...]:
    fix = judged.fix
    numbers = [*fix.position_m, *fix.covariance_m2.diagonal(), *judged.truth_m]
    anchors = " ".join(map(str, fix.anchors))
    return (f"{judged.time_s:.6f}", judged.tag, *(f"{number:.6g}" for number in numbers), anchors)


def show(result: "FleetReport") -> None:
    """Show a run as a table."""
    from rich.table import Table

    table = Table("simulated", "", title=f"{result.method}, {result.tags} tag(s)", show_header=False)
    lines = (
        ("simulated time", f"{result.simulated_s:.1f} s in {result.wall_s:.1f} s ({result.speed:.1f} × real time)"),
        ("messages at tags", f"{result.messages} ({result.dropped} dropped)"),
        ("fixes judged", f"{result.fixes}"),
        ("updates", f"{result.updates_per_s:.1f} per second and tag"),
        ("first fix", _seconds(result.first_fix_s)),
        ("RMSE", _centimetres(result.rmse_m)),
        ("said by the fixes", _centimetres(result.sigma_m)),
        ("95 %", _centimetres(result.p95_m)),
        ("largest", _centimetres(result.max_m)),
    )
    for name, value in lines:
        table.add_row(name, value)
    for reason, count in result.drops.items():
        table.add_row(f"dropped: {reason}", str(count))
    console().print(table)


def _centimetres(value_m: float | None) -> str:
    return "–" if value_m is None else f"{100 * value_m:.2f} cm"


def _seconds(value_s: float | None) -> str:
    return "none" if value_s is None else f"{value_s:.3f} s after power-on"
