"""``skyless replay`` of a recording of a running site."""

import csv
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec import Struct

from skyless.cli.common.options import known_method, open_for_writing
from skyless.cli.common.output import print_json
from skyless.cli.common.progress import progress_bar, status
from skyless.cli.replay_output import COLUMNS, draw_track, row_of, show
from skyless.errors import SkylessError
from skyless.method_names import DEFAULT_METHOD

if TYPE_CHECKING:
    from skyless.positioning.integrity import IntegrityRequirement
    from skyless.replay.site import Replayed, SiteReplay, TagReport


class Options(Struct, frozen=True):
    """What the command line asks for."""

    tag: str | None
    method: str | None
    integrity: "IntegrityRequirement | None"
    """Other than what was asked of the tag."""
    settle_s: float | None
    above_m: float | None
    site: Path | None
    fixes: Path | None
    plot: Path | None
    json: bool


def is_mcap(file: Path) -> bool:
    """Whether a file's content is an MCAP; one that cannot be opened is none."""
    from skyless.recordings.mcap.recording import MAGIC

    try:
        with file.open("rb") as stream:
            return stream.read(len(MAGIC)) == MAGIC
    except OSError:
        return False


def see_that_they_are_left_out(options: Mapping[str, object], reason: str) -> None:
    """Options that this kind of recording has no use for. Raises SkylessError."""
    for name, value in options.items():
        if value is not None:
            raise SkylessError(f"{name} is {str(value)!r}; it should be left out: {reason}")


def replay_site(file: Path, options: Options) -> None:
    """Replay all tags of a recording, or one. Raises SkylessError."""
    from skyless.recordings.mcap.recording import McapRecording
    from skyless.replay.site import SiteReplay
    from skyless.site.load import load_site

    if options.method is not None:
        known_method(options.method)
    with McapRecording(file) as recording:
        tags = None if options.tag is None else (options.tag,)
        settle_s = 2.0 if options.settle_s is None else options.settle_s
        wanted = None if options.site is None else load_site(options.site)
        run = SiteReplay(recording, tags, options.method, settle_s, options.above_m, wanted, options.integrity)
        if options.plot is not None and len(run.tags) > 1:
            raise SkylessError(f"--plot draws one tag; choose it with --tag, one of {', '.join(run.tags)}")
        summary = recording.summary()
        span_s = (summary.end_s or 0.0) - (summary.start_s or 0.0)
        reports = _run(run, span_s, options)
    if options.plot is not None:
        draw_track(options.plot, run.judges[reports[0].tag], reports[0])
    if options.json:
        print_json(_json(reports))
    else:
        for report in reports:
            show(report, "from the site", {}, _more(report))


def _run(run: "SiteReplay", span_s: float, options: Options) -> "list[TagReport]":
    from skyless.evaluation.compile_ahead import compile_kernels

    with status("loading the kernels; the first start compiles them, which takes some ten seconds"):
        compile_kernels(options.method or DEFAULT_METHOD)
    with ExitStack() as stack:
        bar = stack.enter_context(progress_bar("replaying", span_s))
        on_fix = None if options.fixes is None else _fix_writer(stack, options.fixes)
        return run.run(on_fix, bar.reach)


def _fix_writer(stack: ExitStack, path: Path) -> "Callable[[str, Replayed], None]":
    """The table of the other replays with the tag's name at the end of each row; ``t_s`` is Unix time."""
    writer = csv.writer(stack.enter_context(open_for_writing(path)))
    writer.writerow((*COLUMNS, "tag"))

    def write(tag: str, made: "Replayed") -> None:
        writer.writerow((f"{made.unix_s:.6f}", *row_of(made.fix)[1:], tag))

    return write


def _json(reports: "Sequence[TagReport]") -> dict[str, object]:
    """One tag's report as that of any other recording; of several, their sums and the reports by tag."""
    import msgspec

    if len(reports) == 1:
        return {**msgspec.to_builtins(reports[0]), "height_note": "from the site"}
    compared = [report.identical for report in reports if report.identical is not None]
    return {
        "format": reports[0].format,
        "receptions": sum(report.receptions for report in reports),
        "fixes": sum(report.fixes for report in reports),
        "dropped": sum(report.dropped for report in reports),
        "identical": {
            "compared": sum(one.compared for one in compared),
            "different": sum(one.different for one in compared),
        }
        if compared
        else None,
        "wall_s": reports[0].wall_s,
        "tags": {report.tag: msgspec.to_builtins(report) for report in reports},
    }


def _more(report: "TagReport") -> list[tuple[str, str]]:
    """What only such a replay tells."""
    found = report.identical
    if found is None:
        same = "–"
    elif found.compared == 0:
        same = "nothing to compare"
    elif found.different == 0:
        same = f"identical, all {found.compared} of them"
    else:
        same = f"{found.different} of {found.compared} differ"
    begun = "as the tag was" if report.cold_starts == 0 else f"{report.cold_starts} of {report.segments} cold"
    return [
        ("tag", report.tag),
        ("recorded fixes", same),
        ("beginnings", begun),
    ]
