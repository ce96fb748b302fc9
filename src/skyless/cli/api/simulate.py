"""``skyless.simulate``: tags in a simulated world, judged against the truth."""

import time
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
from msgspec.structs import replace

from skyless.arguments import python_function
from skyless.cli.api.fixes import FixesResult, FixRecorder
from skyless.cli.api.options import SimulateOptions
from skyless.cli.common import cm
from skyless.core.errors import SkylessError
from skyless.core.method_names import FILTERS
from skyless.core.site import Site
from skyless.run.masterless.smoothing import OwnReceiver
from skyless.sim.evaluation.fleet import AnyFleet, FleetReport, JudgedFix, report
from skyless.sim.evaluation.request import Conditions
from skyless.sim.evaluation.scenarios import (
    Request,
    Room,
    check_can_be_simulated,
    errors_words,
    fleet_of_any_size,
    room_of,
    run_fleet,
)
from skyless.sim.lab import ideal_lab_site, lab_site, paper_lab_site
from skyless.site.file.load import site_of


class SimulationResult(FixesResult, frozen=True, eq=False):
    """Result of a simulation."""

    request: Request
    """The simulated conditions."""
    report: FleetReport
    """Figures over one fix per tag and superframe after ``settle_s``."""

    @property
    def site(self) -> Site:
        """The simulated site."""
        return self.request.site

    @property
    def room(self) -> Room | None:
        """Drawn errors of positions and ranges; None if all are exact."""
        return self.request.room

    @property
    def summary(self) -> dict[str, Any]:
        """The object that ``skyless simulate --json`` writes, in SI units, without the version."""
        settings = {
            "seed": self.request.seed, "noise_ps": self.request.noise_ps, "warmup_s": self.request.settle_s,
            "site": self.site.name, "errors_drawn": self.room,
        }  # fmt: skip
        return {**msgspec.to_builtins(self.report), **msgspec.to_builtins(settings)}

    def _heading(self, tag: str, count: int) -> str:
        return f"{self.site.name}, {tag}, simulated: {count} fixes"

    def title(self) -> str:
        """Title of the simulation."""
        return f"{self.report.method} at site {self.site.name}, simulated, seed {self.request.seed}"

    def facts(self) -> Iterator[tuple[str, str]]:
        """The main figures: name, and value with its unit."""
        found = self.report
        yield "tags", f"{found.tags}"
        yield "errors drawn", errors_words(self.site, self.room)
        yield "simulated time", f"{found.simulated_s:.1f} s in {found.wall_s:.1f} s ({found.speed:.1f} × real time)"
        yield "messages at tags", f"{found.messages} ({found.dropped} dropped)"
        yield "fixes judged", f"{found.fixes}"
        yield "updates", f"{found.updates_per_s:.1f} per second and tag"
        if found.tags_without_fix:
            yield "tags without a fix", f"{found.tags_without_fix} of {found.tags}"
        yield "first fix", "none" if found.first_fix_s is None else f"{found.first_fix_s:.3f} s after power-on"
        of_all = "3-D" if self.site.tags.height_m is None else "2-D"
        yield f"RMSE {of_all}", cm(found.rmse_m)
        yield f"predicted σ {of_all}", cm(found.sigma_m)
        yield f"95 % {of_all}", cm(found.p95_m)
        yield f"largest error {of_all}", cm(found.max_m)
        if (levels := found.levels) is not None:
            alerts = ", ".join(f"{alert} {count}" for alert, count in levels.alerts.items() if alert != "none")
            yield "protection level", f"median {cm(levels.hpl_m)}, for {100 * levels.available:.1f} % of the fixes"
            yield "errors beyond it", f"{levels.misleading} (stated risk {levels.integrity_risk:g})"
            yield "alerts", alerts or "none"
        for reason, count in found.drops.items():
            yield f"dropped: {reason}", str(count)


class Simulation:
    """A simulation that is ready to run."""

    def __init__(self, asked: SimulateOptions) -> None:
        """Create the world and its tags. Raises SkylessError."""
        self._asked = asked
        site, is_room = _site(asked), asked.scenario == "room"
        at_rest, make = bool(asked.positions_m) and not asked.paths_m, asked.estimator
        self.request = Request(
            site,
            room=room_of(site, asked.seed, is_named_room=is_room, at_rest=at_rest),
            **{name: getattr(asked, name) for name in Conditions.__struct_fields__},
            new_receiver=None if make is None else lambda: OwnReceiver(make(), site),
        )
        check_can_be_simulated(site, asked.method)
        try:
            self.fleet: AnyFleet = fleet_of_any_size(self.request)
        except ValueError as error:
            raise SkylessError(str(error)) from None

    def run(self, on_fix: Callable[[JudgedFix], None] | None) -> FleetReport:
        """Run to the end; ``on_fix`` is called with every fix."""
        started_s = time.perf_counter()
        run_fleet(self.fleet, self.request, self._asked.until_s, on_fix, self.request.progress)
        self.request.progress(1.0)
        own = self._asked.estimator
        method = self.request.method if own is None else getattr(own, "__name__", "own")
        return report(self.fleet, method, started_s)

    @property
    def tags(self) -> tuple[str, ...]:
        """Names of the tags."""
        return tuple(f"tag{number}" for number in range(1, len(self.fleet.records) + 1))


def _site(asked: SimulateOptions) -> Site:
    if asked.site is not None:
        return site_of(asked.site)[0]
    if asked.scenario == "paper" or (asked.scenario is None and asked.method not in FILTERS):
        return paper_lab_site()
    return replace(lab_site(), name="room") if asked.scenario == "room" else ideal_lab_site()


def run_simulate(asked: SimulateOptions) -> SimulationResult:
    """Run a site faster than real time and report the errors of its tags, as ``skyless simulate`` does."""
    simulation = Simulation(asked)
    records = simulation.fleet.records
    recorder, judged_before = FixRecorder(simulation.tags), [0] * len(records)

    def on_fix(made: JudgedFix) -> None:
        judged = records[made.tag].judged
        recorder.add(made.tag, made.time_s, made.fix, made.truth_m, judged=judged > judged_before[made.tag])
        judged_before[made.tag] = judged

    found = simulation.run(on_fix)
    return SimulationResult(simulation.request, found, fixes=recorder.fixes())


simulate = python_function(SimulateOptions, run_simulate)
