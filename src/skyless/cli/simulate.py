"""``skyless simulate``: a site in the simulated world, judged against the truth."""

import csv
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, TextIO

from cyclopts import App, Parameter
from cyclopts.validators import Number

from skyless.cli.common.options import (
    IntegrityRisk,
    NotNegative,
    Picoseconds,
    Positive,
    finite_numbers,
    integrity_of,
    open_for_writing,
    spare_inputs,
)
from skyless.cli.common.output import print_json
from skyless.cli.common.progress import progress_bar, status
from skyless.cli.simulate_input import ROOM, bias_of, delay_errors_of, outage_of, path_of, silence_of, site_of
from skyless.cli.simulate_output import COLUMNS, row_of, show
from skyless.errors import SkylessError
from skyless.method_names import DEFAULT_METHOD

if TYPE_CHECKING:
    from skyless.evaluation.fleet import Fleet, FleetReport
    from skyless.evaluation.scenarios import Request

_Share = Annotated[float, Parameter(validator=Number(gte=0, lt=1))]

_USUAL_S: Final = 60.0
"""A run without goal lasts so long."""

_PATIENCE_S: Final = 60.0
"""Simulated time that a run whose goal is fixes waits for one."""

app = App(
    name="simulate",
    help_epilogue=(
        "Example: skyless simulate --scenario lab --method joint --noise-ps 100 --position 3,4 --fixes 3000 --seed 7"
    ),
)


@app.default
def simulate(
    *,
    scenario: str | None = None,
    site: Path | None = None,
    method: str = DEFAULT_METHOD,
    position: list[str] | None = None,
    waypoints: list[str] | None = None,
    tags: Annotated[int, Parameter(validator=Number(gte=1, lte=10_000))] | None = None,
    speed: Annotated[float, Parameter(validator=Number(gt=0, lte=1000))] | None = None,
    qa: Positive = 0.3,
    integrity_risk: IntegrityRisk | None = None,
    alert_limit_m: Positive | None = None,
    max_acceleration: NotNegative | None = None,
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
    delay_error: list[str] | None = None,
    deaf: list[str] | None = None,
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
        A named site: lab (six anchors on the walls of 6 m × 8 m, 2-D), the default; room (the lab as real rooms are:
        anchors 2 cm off per axis, ranges 5 cm off, and more with the distance, tags with random acceleration).
    site
        A site file instead of a named one.
    method
        literal, literal-delayed, weighted, bracketed or joint.
        Fixes of all but joint hold at the master's message that they refer to, but are judged when made.
    position
        Where a tag lies still, x,y or x,y,z in metres; may be given several times.
    waypoints
        A tag's path, "x,y;x,y;..." with or without z, walked once, or for ever if it ends where it begins; repeatable.
    tags
        How many tags walk about where neither --position nor --waypoints is given; 1 by default.
    speed
        How fast tags walk, in m/s; 1 by default. In the room only for --waypoints.
    qa
        Agility that joint assumes, m²/s³.
    integrity_risk
        Probability, for each fix, that the error exceeds its protection level (joint); 1e-4 by default.
    alert_limit_m
        Fixes with a higher protection level than so many metres carry an alert (joint).
    max_acceleration
        The largest acceleration of the tags in m/s², for protection levels that cover their hardest turns (joint).
    noise_ps
        Noise of every TX and RX stamp in picoseconds, known to the filters; by default the site's own figures.
    fixes
        Stop when every tag has so many judged fixes (one per superframe), or waits for one for 60 s in vain.
    duration
        Stop after so many simulated seconds; by default 60 unless --fixes is given.
    warmup
        Simulated seconds before which fixes are not judged; less than the run lasts.
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
    delay_error
        ANCHOR:TX_NS:RX_NS: by how much this anchor's antenna delays are longer than its site file says.
    deaf
        FROM_S or FROM_S:TO_S: the tags' radios hear nothing from then on, or for that time.
    power_bias
        Give RX stamps the DW1000's bias by received power.
    temperature
        Let the crystals warm up and swing.
    fixes_csv
        Write every fix with its truth into this file.
    json
        Write one JSON object instead of the table.
    """
    from skyless.evaluation.scenarios import Request, Room

    spare_inputs("fixes-csv", fixes_csv, site)
    if position and not waypoints and (tags is not None or speed is not None):
        raise SkylessError("--position is for tags that lie still, --tags and --speed for tags that walk; give either")
    if waypoints and tags is not None:
        raise SkylessError("--waypoints is the path of one tag, --tags a number of tags that walk about; give either")
    if scenario == ROOM and speed is not None and not waypoints:
        raise SkylessError(
            "--speed is for tags that walk from point to point; those of --scenario room accelerate at "
            "random, or give --waypoints"
        )
    request = Request(
        site=site_of(scenario, site),
        method=method,
        seed=seed,
        noise_ps=noise_ps,
        positions_m=tuple(finite_numbers("position", text, (2, 3)) for text in position or ()),
        paths_m=tuple(path_of(text) for text in waypoints or ()),
        tags=1 if tags is None else tags,
        speed_mps=1.0 if speed is None else speed,
        qa=qa,
        integrity=integrity_of(integrity_risk, alert_limit_m, max_acceleration, method),
        warmup_s=warmup,
        most_fixes=fixes,
        loss=loss,
        nlos=nlos,
        nlos_mean_m=nlos_mean,
        power_bias=power_bias,
        temperature=temperature,
        biases=tuple(bias_of(text) for text in bias or ()),
        outages=tuple(outage_of(text) for text in outage or ()),
        delay_errors=delay_errors_of(delay_error or []),
        silences=tuple(silence_of(text) for text in deaf or ()),
        room=Room() if scenario == ROOM else None,
    )
    until_s = duration if duration is not None else (math.inf if fixes is not None else _USUAL_S)
    if warmup >= until_s:
        raise SkylessError(f"--warmup is {warmup:g}; a run of {until_s:g} s (--duration) ends before any fix is judged")
    result = _run(request, until_s, fixes_csv)
    if json:
        import msgspec

        settings = {"seed": seed, "noise_ps": noise_ps, "warmup_s": warmup, "site": request.site.name}
        print_json({**msgspec.to_builtins(result), **settings})
    else:
        show(result)


def _run(request: "Request", until_s: float, fixes_csv: Path | None) -> "FleetReport":
    from skyless.evaluation.compile_ahead import compile_kernels
    from skyless.evaluation.fleet import report
    from skyless.evaluation.scenarios import fleet_of

    try:
        fleet = fleet_of(request)
    except ValueError as error:
        raise SkylessError(str(error)) from None
    with status("loading the kernels; the first start compiles them, which takes some ten seconds"):
        compile_kernels(request.method)
    started_s = time.perf_counter()
    if fixes_csv is None:
        _pass_time(fleet, request, until_s, None)
    else:
        with open_for_writing(fixes_csv) as file:
            _pass_time(fleet, request, until_s, file)
    return report(fleet, request.method, started_s)


def _pass_time(fleet: "Fleet", request: "Request", until_s: float, file: TextIO | None) -> None:
    """Let the world run in steps, so that the bar moves and the goal is seen."""
    writer = None if file is None else csv.writer(file)
    if writer is not None:
        writer.writerow(COLUMNS)
    fixes = request.most_fixes
    with progress_bar("simulating", fixes if fixes is not None else until_s) as bar:
        now_s = 0.0
        while now_s < until_s and not _enough(fleet, request, now_s):
            now_s = min(now_s + 0.25, until_s)
            for judged in fleet.run(now_s):
                if writer is not None:
                    writer.writerow(row_of(judged))
            bar.reach(fleet.errors.count / len(fleet.records) if fixes is not None else now_s)


def _enough(fleet: "Fleet", request: "Request", now_s: float) -> bool:
    """Whether all tags have their fixes, or those that have not wait in vain, with nothing planned to come back."""
    fixes = request.most_fixes
    if fixes is None:
        return False
    returns_s = [planned.outage.on_s for planned in request.outages] + [silence.on_s for silence in request.silences]
    planned_s = max(filter(math.isfinite, returns_s), default=0.0)
    last_s = (0.0 if tag.last is None else tag.last.time_s for tag in fleet.records if tag.judged < fixes)
    return all(now_s - max(tag_s, planned_s) > _PATIENCE_S for tag_s in last_s)
