"""Where the programs keep what they write."""

import os
import tempfile
import time
from pathlib import Path


def data_folder() -> Path:
    """``skyless`` in the user's data folder (XDG), or a temporary folder where that cannot be written."""
    shared = os.environ.get("XDG_DATA_HOME")
    try:
        home = Path(shared) if shared and Path(shared).is_absolute() else Path("~/.local/share").expanduser()
        folder = home / "skyless"
        if home == Path("/.local/share"):
            raise PermissionError("HOME is empty")
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK | os.X_OK):
            raise PermissionError("it cannot be written")
    except (OSError, RuntimeError):  # RuntimeError: a user without a home
        folder = Path(tempfile.gettempdir()) / f"skyless-{os.getuid()}"
        folder.mkdir(mode=0o700, exist_ok=True)
    return folder


def recordings_folder() -> Path:
    """Folder of the recordings that the page shows; it is made."""
    folder = data_folder() / "recordings"
    folder.mkdir(exist_ok=True)
    return folder


def new_recording(folder: Path, kind: str) -> Path:
    """Name for a recording that begins now."""
    return folder / f"{kind}-{time.strftime('%Y%m%d-%H%M%S')}.mcap"
