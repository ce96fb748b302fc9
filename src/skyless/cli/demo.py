"""``skyless demo``: a site and walking tags in real time, in the terminal."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Final

from cyclopts import App, Parameter
from cyclopts.validators import Number

from skyless.cli.options import Picoseconds, Positive
from skyless.cli.output import console, print_json
from skyless.cli.progress import status

if TYPE_CHECKING:
    from rich.console import RenderableType

    from skyless.experiments.fleet import Fleet, FleetReport

_REDRAW_S: Final = 0.25
_STEP_S: Final = 0.02

app = App(name="demo", help_epilogue="Example: skyless demo --duration 10 --json")


@app.default
def demo(
    *,
    duration: Positive | None = None,
    tags: Annotated[int, Parameter(validator=Number(gte=1, lte=50))] = 3,
    speed: Annotated[float, Parameter(validator=Number(gt=0, lte=10))] = 1.0,
    noise_ps: Picoseconds = 100.0,
    seed: Annotated[int, Parameter(validator=Number(gte=0))] = 1,
    json: bool = False,
) -> None:
    """Show the lab with walking tags in real time; Ctrl-C stops.

    Six anchors on the walls of 6 m × 8 m broadcast, the tags only listen. Radios, clocks and motion are simulated, the
    anchors' and tags' programs are the real ones.

    Parameters
    ----------
    duration
        Seconds to run; by default until Ctrl-C.
    tags
        How many tags walk.
    speed
        How fast they walk in m/s.
    noise_ps
        Noise of every TX and RX stamp in picoseconds.
    seed
        Same seed, same radio world.
    json
        Write one JSON object at the end instead of the tables.
    """
    from skyless.experiments.fleet import report

    fleet = _fleet(tags, speed, noise_ps, seed)
    started_s = time.perf_counter()
    with _screen(fleet, show=not json) as redraw:
        try:
            _in_real_time(fleet, duration, redraw)
        except KeyboardInterrupt:
            print("stopped", file=sys.stderr)
    result = report(fleet, "tracker", started_s)
    if json:
        print_json(_summary(result))
    elif not sys.stdout.isatty():
        console().print(_tags(fleet))
    if not json:
        console().print(_closing(result), soft_wrap=True)


def _fleet(tags: int, speed: float, noise_ps: float, seed: int) -> "Fleet":
    from skyless.experiments.fleet import Fleet, FleetSettings
    from skyless.experiments.scenarios import patrols
    from skyless.experiments.warm import compile_kernels
    from skyless.simulation.scenario import lab_impairments
    from skyless.site.lab import lab_site

    with status("loading the kernels; the first start compiles them, which takes some ten seconds"):
        compile_kernels()
    site = lab_site(noise_ps)
    paths = patrols(site, tags, speed)
    return Fleet(site, paths, lab_impairments(noise_ps), seed, FleetSettings(warmup_s=1.0))


def _in_real_time(fleet: "Fleet", duration: float | None, redraw: "Redraw") -> None:
    """Let the world keep pace with the wall clock."""
    begin_s = time.monotonic()
    until_s = float("inf") if duration is None else duration
    now_s = 0.0
    while now_s < until_s:
        now_s = min(time.monotonic() - begin_s, until_s)
        for _ in fleet.run(now_s):
            pass
        redraw.reach(now_s)
        ahead_s = now_s + _STEP_S - (time.monotonic() - begin_s)
        if ahead_s > 0.0 and now_s < until_s:
            time.sleep(ahead_s)


class Redraw:
    """Draws the tables a few times a second, or never."""

    def __init__(self, fleet: "Fleet") -> None:
        self._fleet = fleet
        self._next_s = 0.0
        self.draw = self._nothing

    def _nothing(self, picture: "RenderableType") -> None:
        pass

    def reach(self, now_s: float) -> None:
        """Draw if it is time."""
        if self.draw != self._nothing and now_s >= self._next_s:
            self._next_s = now_s + _REDRAW_S
            self.draw(_picture(self._fleet, now_s))


@contextmanager
def _screen(fleet: "Fleet", *, show: bool) -> "Iterator[Redraw]":
    redraw = Redraw(fleet)
    if not (show and sys.stdout.isatty()):
        yield redraw
        return
    from rich.live import Live

    with Live(console=console(), auto_refresh=False) as live:
        redraw.draw = lambda picture: live.update(picture, refresh=True)
        yield redraw


def _picture(fleet: "Fleet", now_s: float) -> "RenderableType":
    from rich.console import Group

    line = f"lab, {now_s:.1f} s, {fleet.world.tally.transmissions} beacons on the air; Ctrl-C stops"
    return Group(line, _tags(fleet), _anchors(fleet))


def _tags(fleet: "Fleet") -> "RenderableType":
    from rich.table import Table

    columns = ("tag", "x m", "y m", "m/s", "error cm", "sigma cm", "fixes/s", "anchors", "lost")
    table = Table(*columns, title="tags (radio world simulated)")
    now_s = fleet.world.now_s
    for number, record in enumerate(fleet.records, start=1):
        if record.last is None or record.first_fix_s is None:
            table.add_row(str(number), *("–",) * 7, str(fleet.receivers[number - 1].reason))
            continue
        fix, error = record.last.fix, record.last.error_m
        velocity = fix.velocity_mps
        table.add_row(
            str(number),
            f"{fix.position_m[0]:.3f}",
            f"{fix.position_m[1]:.3f}",
            "–" if velocity is None else f"{float(velocity @ velocity) ** 0.5:.2f}",
            f"{100 * float(error @ error) ** 0.5:.1f}",
            f"{100 * fix.std_m:.1f}",
            f"{record.fixes / max(now_s - record.first_fix_s, 1e-9):.0f}",
            str(len(fix.anchors)),
            str(record.messages - record.fixes),
        )
    return table


def _anchors(fleet: "Fleet") -> "RenderableType":
    from rich.table import Table

    table = Table("anchor", "role", "beacons heard", "rate ppm", "clock sigma cm", "sent", title="synchronisation")
    for anchor in fleet.anchors.values():
        state = anchor.synchronisation
        measured = ("–", "–") if anchor.is_master else (f"{state.rate_ppm:+.4f}", f"{100 * state.offset_std_m:.2f}")
        role = "master" if anchor.is_master else "anchor"
        heard, sent = str(anchor.counters["heard"]), str(anchor.counters["sent"])
        table.add_row(str(anchor.id), role, heard, *measured, sent)
    return table


def _summary(result: "FleetReport") -> dict[str, object]:
    return {
        "tags": result.tags,
        "fixes": result.fixes,
        "rmse_m": result.rmse_m,
        "max_m": result.max_m,
        "updates_per_s": result.updates_per_s,
        "p95_m": result.p95_m,
        "sigma_m": result.sigma_m,
        "messages": result.messages,
        "dropped": result.dropped,
        "first_fix_s": result.first_fix_s,
        "duration_s": result.simulated_s,
    }


def _closing(result: "FleetReport") -> str:
    if result.rmse_m is None or result.max_m is None:
        return "no fix was made"
    return (
        f"{result.tags} tags, {result.messages} messages in {result.simulated_s:.1f} s: "
        f"RMSE {100 * result.rmse_m:.1f} cm, largest error {100 * result.max_m:.1f} cm, "
        f"{result.updates_per_s:.0f} updates per second and tag"
    )
