"""``skyless.simulate``: a site in the simulated world, its tags judged against the truth."""

import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final, TypeVar

import msgspec
from msgspec.structs import replace

from skyless.api.fixes import Fixes, FixRecorder
from skyless.api.inputs import AnySite, Progress, requirement_of, silent, site_of
from skyless.api.result import Result, cm
from skyless.arguments import (
    check_choice,
    check_kinds,
    check_number,
    check_whole,
    named_as_arguments,
    process_noise,
    sequence,
)
from skyless.errors import SkylessError
from skyless.evaluation.fleet import FleetReport, JudgedFix, report
from skyless.evaluation.fleet_run import end_s, run_fleet
from skyless.evaluation.scenarios import Request, Room, check_can_be_simulated, errors_words, fleet_of_any_size, room_of
from skyless.evaluation.statistics import dimensions
from skyless.method_names import DEFAULT_METHOD
from skyless.positioning.integrity import IntegrityRequirement
from skyless.simulation.impairments import AnchorBias, AnchorOutage, DelayError, Outage
from skyless.site.lab import ideal_lab_site, lab_site
from skyless.site.model import Site

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

_Fault = TypeVar("_Fault")

_SCENARIOS: Final = ("lab", "room")
_ARGUMENTS: Final = {
    "outage": "outages", "bias": "biases", "delay-error": "delay_errors", "silence": "silences",
}  # fmt: skip


class SimulationResult(Result, frozen=True, eq=False):
    """What a simulation came to."""

    site: Site
    seed: int
    settle_s: float
    noise_ps: float | None
    room: Room | None
    """Errors of positions and ranges that were drawn; None where all is exact."""
    report: FleetReport
    """Figures over one fix of each tag and superframe after ``settle_s``."""
    fixes: Fixes
    """All fixes, with the truth; ``fixes.judged`` are those of the report."""

    @property
    def tags(self) -> tuple[str, ...]:
        """Names of the tags."""
        return self.fixes.tags

    @property
    def summary(self) -> dict[str, Any]:
        """The object that ``skyless simulate --json`` writes, in SI units, but for the version."""
        settings = {
            "seed": self.seed, "noise_ps": self.noise_ps, "warmup_s": self.settle_s, "site": self.site.name,
            "errors_drawn": self.room,
        }  # fmt: skip
        return {**msgspec.to_builtins(self.report), **msgspec.to_builtins(settings)}

    def to_dataframe(self) -> "DataFrame":
        """See ``Fixes.to_dataframe``."""
        return self.fixes.to_dataframe()

    def plot(self, tag: str | None = None) -> "Figure":
        """Track, errors over time, their histograms and distribution of one tag, by default the first.

        Raises:
            SkylessError: there is no such tag.
        """
        from skyless.replays.plot import track_figure  # noqa: PLC0415 - Matplotlib is loaded where it draws

        rows = self.fixes.track(tag)
        return track_figure(rows, f"{self.site.name}, {tag or self.tags[0]}, simulated: {len(rows)} fixes")

    def _title(self) -> str:
        return f"{self.report.method} at site {self.site.name}, simulated, seed {self.seed}"

    def _facts(self) -> Iterator[tuple[str, str]]:
        found = self.report
        yield "tags", f"{found.tags}"
        yield "errors drawn", errors_words(self.site, self.room)
        yield "simulated time", f"{found.simulated_s:.1f} s"
        yield "fixes judged", f"{found.fixes}"
        yield "updates", f"{found.updates_per_s:.1f} per second and tag"
        if found.tags_without_fix:
            yield "tags without a fix", f"{found.tags_without_fix}"
        of_all = dimensions(planar=self.site.tags.height_m is not None)
        yield f"RMSE {of_all}", cm(found.rmse_m)
        yield f"predicted σ {of_all}", cm(found.sigma_m)
        yield f"95 % {of_all}", cm(found.p95_m)
        yield f"largest error {of_all}", cm(found.max_m)
        if found.levels is not None:
            yield "median protection level", cm(found.levels.hpl_m)


def simulate(
    *,
    site: AnySite | None = None,
    scenario: str | None = None,
    method: str = DEFAULT_METHOD,
    positions_m: Sequence[Sequence[float]] = (),
    paths_m: Sequence[Sequence[Sequence[float]]] = (),
    tags: int | None = None,
    speed_mps: float | None = None,
    qa: float | None = None,
    dynamics: str | None = None,
    noise_ps: float | None = None,
    fixes: int | None = None,
    duration_s: float | None = None,
    settle_s: float = 2.0,
    seed: int = 1,
    loss: float = 0.0,
    nlos: float = 0.0,
    nlos_mean_m: float = 1.0,
    biases: Sequence[AnchorBias] = (),
    outages: Sequence[AnchorOutage] = (),
    delay_errors: Sequence[DelayError] = (),
    silences: Sequence[Outage] = (),
    power_bias: bool = False,
    temperature: bool = False,
    integrity_risk: float | None = None,
    alert_limit_m: float | None = None,
    max_acceleration_mps2: float | None = None,
    progress: Progress | None = None,
) -> SimulationResult:
    """Run a site faster than real time and report the errors of its tags, as ``skyless simulate`` does.

    Args:
        site: A site, or the path of its file, instead of a scenario. Positions of anchors and ranges are wrong by
            chance as its accuracy states; ``skyless.site.model.EXACT`` is the accuracy of exact ones.
        scenario: ``lab`` (six anchors on the walls of 6 m × 8 m, 2-D), the default; ``room`` (the lab with the errors
            of real rooms).
        method: One of ``skyless.METHODS``.
        positions_m: Where tags lie still, (x, y) or (x, y, z) each; shape (k, 2) or (k, 3).
        paths_m: Paths of tags, each two points or more, walked once, or for ever if it ends where it begins.
        tags: How many tags walk about where neither positions nor paths are given; 1 by default.
        speed_mps: How fast tags walk; 1 by default.
        qa: Process noise that ``joint`` assumes, spectral density of the acceleration in m²/s³; 0.3 by default.
        dynamics: How tags move: ``walk`` (as people), ``robot`` or ``drone``, which sets the process noise instead.
        noise_ps: Noise of every TX and RX stamp, known to the filters; by default the site's own figures.
        fixes: Stop when every tag has this many judged fixes (one per superframe), or has had none for 60 s.
        duration_s: Stop after this simulated time; by default 60 s unless ``fixes`` is given.
        settle_s: Simulated time before which fixes are not judged.
        seed: Same seed, same fixes.
        loss: Probability that a message is lost, from 0 to below 1.
        nlos: Probability that a message reaches a tag late, by ``nlos_mean_m`` on average.
        nlos_mean_m: Mean delay of such a message in metres.
        biases: Anchors that tags receive late, ``AnchorBias`` of ``skyless.simulation.impairments``.
        outages: Anchors that stop and restart, ``AnchorOutage`` of the same module.
        delay_errors: Antenna delays that the site has wrong, ``DelayError``, one of an anchor at most.
        silences: When the tags' radios receive nothing, ``Outage``.
        power_bias: Give RX stamps the DW1000's bias by received power.
        temperature: Let the crystals warm up and swing.
        integrity_risk: Probability, for each fix, that the error exceeds its protection level (``joint``).
        alert_limit_m: Fixes with a higher level carry an alert (``joint``).
        max_acceleration_mps2: Largest acceleration that levels cover (``joint``).
        progress: Called now and then with the share done.

    Raises:
        SkylessError: one line that names the argument, its value and what it should be.
    """
    required = requirement_of(method, integrity_risk, alert_limit_m, max_acceleration_mps2)
    check_number("noise_ps", noise_ps, above=0.0)
    check_number("qa", qa, above=0.0)
    check_whole("fixes", fixes, least=1)
    check_number("duration_s", duration_s, above=0.0)
    check_number("settle_s", settle_s, least=0.0)
    positions_m = sequence("positions_m", positions_m, "points, (x, y) or (x, y, z) in metres each")
    paths_m = sequence("paths_m", paths_m, "paths, two or more points each")
    with named_as_arguments({}):
        noise = process_noise(qa, dynamics)
    _check_motion(positions_m, paths_m, tags, speed_mps, scenario)
    simulated = _site(site, scenario)
    at_rest = bool(len(positions_m)) and not len(paths_m)
    request = Request(
        site=simulated,
        room=room_of(simulated, seed, is_named_room=scenario == "room", at_rest=at_rest),
        method=method,
        seed=seed,
        noise_ps=noise_ps,
        positions_m=_points("positions_m", positions_m),
        paths_m=tuple(_points(f"paths_m[{number}]", path_m) for number, path_m in enumerate(paths_m)),
        tags=1 if tags is None else tags,
        speed_mps=1.0 if speed_mps is None else speed_mps,
        qa=noise or 0.3,
        integrity=required or IntegrityRequirement(),
        warmup_s=settle_s,
        most_fixes=fixes,
        loss=loss,
        nlos=nlos,
        nlos_mean_m=nlos_mean_m,
        power_bias=power_bias,
        temperature=temperature,
        biases=_faults("biases", biases, AnchorBias),
        outages=_faults("outages", outages, AnchorOutage),
        delay_errors=_faults("delay_errors", delay_errors, DelayError),
        silences=_faults("silences", silences, Outage),
    )
    until_s = end_s(duration_s, fixes)
    if settle_s >= until_s:
        raise SkylessError(f"settle_s is {settle_s:g}; it should be less than duration_s, which is {until_s:g}")
    with named_as_arguments(_ARGUMENTS):
        check_can_be_simulated(request.site, method)
        try:
            fleet = fleet_of_any_size(request)
        except ValueError as error:
            raise SkylessError(str(error)) from None
    recorder, judged_before = FixRecorder(tag_names(len(fleet.records))), [0] * len(fleet.records)

    def on_fix(made: JudgedFix) -> None:
        judged = fleet.records[made.tag].judged
        recorder.add(made.tag, made.time_s, made.fix, made.truth_m, judged=judged > judged_before[made.tag])
        judged_before[made.tag] = judged

    started_s = time.perf_counter()
    report_progress = progress or silent
    run_fleet(fleet, request, until_s, on_fix, report_progress)
    report_progress(1.0)
    found = report(fleet, method, started_s)
    return SimulationResult(request.site, seed, settle_s, noise_ps, request.room, found, recorder.fixes())


def tag_names(count: int) -> tuple[str, ...]:
    """Names of simulated tags, tag1 the first."""
    return tuple(f"tag{number}" for number in range(1, count + 1))


def _site(site: AnySite | None, scenario: str | None) -> Site:
    if site is not None:
        if scenario is not None:
            raise SkylessError("give either scenario or site, not both")
        return site_of(site)[0]
    if scenario is not None:
        check_choice("scenario", scenario, _SCENARIOS)
    return replace(lab_site(), name="room") if scenario == "room" else ideal_lab_site()


def _check_motion(
    positions_m: Sequence[Sequence[float]],
    paths_m: Sequence[Sequence[Sequence[float]]],
    tags: int | None,
    speed_mps: float | None,
    scenario: str | None,
) -> None:
    if len(positions_m) and not len(paths_m) and (tags is not None or speed_mps is not None):
        raise SkylessError("positions_m is for tags that lie still, tags and speed_mps for tags that walk; give either")
    if len(paths_m) and tags is not None:
        raise SkylessError("paths_m has a path for each tag, tags is a number of tags that walk about; give either")
    if scenario == "room" and speed_mps is not None and not len(paths_m):
        raise SkylessError(
            "speed_mps is for tags that walk from point to point; those of the scenario room accelerate at random, "
            "or give paths_m"
        )


def _points(name: str, points_m: object) -> tuple[tuple[float, ...], ...]:
    right = "points, (x, y) or (x, y, z) in metres each"
    points = sequence(name, points_m, right)
    return tuple(sequence(f"{name}[{number}]", point_m, "(x, y) or (x, y, z)") for number, point_m in enumerate(points))


def _faults(name: str, values: object, kind: type[_Fault]) -> tuple[_Fault, ...]:
    faults = sequence(name, values, f"values of {kind.__name__}")
    check_kinds(name, faults, kind)
    return faults
