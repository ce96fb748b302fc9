"""What all tests share."""

import os
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("skyless", deadline=None)  # the first call of a kernel compiles it
settings.load_profile("skyless")


@pytest.fixture(scope="session")
def recordings() -> Path:
    """The folder of real recordings, which are not part of the project."""
    default = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("SKYLESS_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"no recordings at {folder}: set SKYLESS_DATA to their folder")
    return folder
