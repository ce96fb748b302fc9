"""``skyless calibrate``: the errors of antenna delays from a tag at known positions."""

from typing import Final

from cyclopts import App
from msgspec.structs import replace

from skyless.cli.common import (
    command,
    console,
    print_facts,
    print_json,
    progress_bar,
    write_file,
    write_picture,
)
from skyless.cli.survey import Output, report
from skyless.core.errors import SkylessError
from skyless.research.calibration.options import CalibrateOptions

app = App(
    name="calibrate",
    help_epilogue="Example: skyless calibrate stay.mcap --at 3,4,1.2 --site site.toml --out calibrated.toml",
)

_ONLY_A_TABLE: Final = (
    "it should be a table, .csv: a site file holds antenna delays, which only a recording of skyless record can correct"
)


@app.default
@command
def calibrate(asked: CalibrateOptions, *, output: Output) -> int:
    """Find the errors of antenna delays from a tag at known positions (--at, --truth); the anchors' positions are kept.

    In a recording of skyless record the ranges between the anchors take part. In a recording of another system the tag
    shows by how much each anchor seems late, which skyless replay then takes off.

    Ends with exit code 1 if no delay is determined.
    """
    output.check_files(asked.site, asked.file, asked.truth)
    from skyless.cli.api.calibrate import biases_of_other, delays_of_site
    from skyless.cli.api.survey import SurveyResult
    from skyless.run.recordings.recording import is_mcap

    is_of_site = is_mcap(asked.file)
    if output.out is not None and output.out.suffix.lower() != ".csv" and not is_of_site:
        raise SkylessError(f"--out is {str(output.out)!r}; {_ONLY_A_TABLE}")
    with progress_bar("calibrating") as reach:
        asked = replace(asked, progress=reach)
        found = delays_of_site(asked, output.on_count) if is_of_site else biases_of_other(asked)
    if isinstance(found, SurveyResult):
        return report(found, output)
    if output.out is not None:
        write_file(output.out, found.corrected_file().encode())
    if output.plot is not None:
        write_picture(output.plot, found.plot())
    if output.json:
        print_json({**found.summary, "written": output.out})
        return 0
    print_facts(found.title(), found.facts())
    if output.out is not None:
        console().print(f"wrote {output.out}", markup=False)
    return 0
