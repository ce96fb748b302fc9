"""``skyless export``: a recording in another program's format."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from cyclopts import App

from skyless.cli.common import NO_FIX, JsonOptions, check_output, command, print_json, print_table, print_warnings
from skyless.core.errors import SkylessError

if TYPE_CHECKING:
    from skyless.bridges.rosbag import Bag

app = App(name="export", help_epilogue="Example: skyless export walk.mcap --to walk_bag")


@app.default
@command
def export(
    file: Path,
    /,
    *,
    to: Path,
    tag: str | None = None,
    frame: str = "site",
    transforms: bool = False,
    bag_version: Literal["9", "8"] = "9",
    output: JsonOptions,
) -> int:
    """Write a recording of skyless record as a bag of ROS 2: MCAP, for ros2 bag play, Foxglove, Rerun, PlotJuggler.

    Each tag gets the topics pose, velocity, fix (where the site file has a georeference) and truth (where it is
    simulated) below /skyless/TAG; anchors and health become /skyless/anchors and /diagnostics. Needs the extra ros2.

    Parameters
    ----------
    file
        The recording, an MCAP of skyless record.
    to
        Where fixes go: the bag, a new folder.
    tag
        Name of the only tag to write; by default all.
    frame
        Name of the site's frame in the messages.
    transforms
        Write a transform from that frame to each tag's, too (/tf).
    bag_version
        Of the bag's metadata: 9 for ROS 2 from Jazzy on, 8 for Humble and Iron.
    """
    from skyless.bridges.ros2 import FRAME_NAME, FRAME_RULE, RosSettings
    from skyless.bridges.rosbag import write_bag

    check_output("to", to, file)
    if not FRAME_NAME.fullmatch(frame):
        raise SkylessError(f"--frame is {frame!r}; it should be {FRAME_RULE}")
    settings = RosSettings(frame=frame, transforms=transforms)
    bag = write_bag(file, to, settings, tag, 8 if bag_version == "8" else 9)
    if output.json:
        print_json(bag)
    else:
        _show(bag)
    return 0 if bag.fixes else NO_FIX


def _show(bag: "Bag") -> None:
    rows = ((topic, bag.types[topic], str(count)) for topic, count in bag.topics.items())
    print_table(f"{bag.path}, {bag.end_s - bag.start_s:.1f} s", ("topic", "type", "messages"), rows)
    warnings = [f"not readable: {reason} {count}" for reason, count in bag.drops.items()]
    if not bag.finished:
        warnings.append(
            "the recording has no end: it was cut off, or is still being written; later messages are missing"
        )
    if bag.unusable:
        warnings.append(f"{bag.unusable} fixes were left out: their alert forbids their use, or they are not finite")
    if not bag.fixes:
        warnings.append("there is no fix in the bag")
    print_warnings(warnings)
