"""Open a recording of any kind: what a tag of another system received, or what ``skyless record`` wrote of a site."""

from collections.abc import Mapping
from os import PathLike

from skyless.air.masterless_packets import Point
from skyless.errors import ConfigurationError
from skyless.recordings.foreign import formats
from skyless.recordings.mcap.recording import McapRecording, is_mcap


def open_recording(
    path: str | PathLike[str],
    format_name: str | None = None,
    listener: str | None = None,
    anchors_m: Mapping[int, Point] | None = None,
) -> formats.Recording | McapRecording:
    """Open a recording of a named format, or of the one that its first bytes show.

    An MCAP gives an ``McapRecording``, whose methods give fixes, truth and raw receptions by time; any other format a
    ``Recording``, to be iterated over once. Close either, or use ``with``.

    Args:
        path: The recording; those of other systems also gzip.
        format_name: Name of the format of another system.
        listener: Chooses one receiver where a recording of another system holds several.
        anchors_m: Positions that replace all that the anchors of a recording of DL-TDoA state.

    Raises:
        ConfigurationError: the file cannot be opened, its format is not known, or an argument makes no sense.
    """
    if format_name is not None or not is_mcap(path):
        return formats.open_recording(path, format_name, listener, anchors_m)
    if listener is not None:
        raise ConfigurationError(path, "listener", listener, "left out: recordings of a site give each tag by its name")
    if anchors_m is not None:
        raise ConfigurationError(path, "anchors_m", "given", "left out: recordings of a site hold their anchors")
    return McapRecording(path)
