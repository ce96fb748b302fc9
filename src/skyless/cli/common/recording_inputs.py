"""What ``skyless replay`` and ``skyless calibrate`` are given with a recording: from texts to values."""

from pathlib import Path

from skyless.cli.common.options import height_number, metres


def is_mcap(file: Path) -> bool:
    """Whether a file's content is an MCAP; one that cannot be opened, or would lose what is read here, is none."""
    from skyless.recordings.mcap.recording import is_mcap

    return is_mcap(file)


def lever_arm(text: str | None) -> tuple[float, float, float] | None:
    """The antenna in the body's frame in metres, None if it is not given. Raises SkylessError."""
    if text is None:
        return None
    x_m, y_m, z_m = metres("lever-arm", text, (3,))
    return x_m, y_m, z_m


def wished_height(text: str) -> float | str:
    """The tag's height in metres, or a word instead. Raises SkylessError."""
    from skyless.replays.inputs import HEIGHT_WORDS

    return text if text in HEIGHT_WORDS else height_number(text, "or truth, free or auto")
