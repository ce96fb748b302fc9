"""What all tests share."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from skyless.cli.common.progress import compile_with_counts
from skyless.core.kernels.processes import EVERY_PART, missing

settings.register_profile("skyless", deadline=None)  # the first call of a kernel compiles it
settings.load_profile("skyless")


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile all kernels once, before the workers: programs that start in tests then do not report it."""
    if not hasattr(session.config, "workerinput") and not session.config.option.collectonly:
        compile_with_counts(missing(EVERY_PART))


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Clients that need environments of their own run only when they are asked for: ``scripts/test clients``."""
    asked = any("clients" in argument for argument in config.args)
    return True if collection_path.name == "clients" and not asked else None


@pytest.fixture(scope="session", autouse=True)
def own_data_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What programs keep for their user (broker, recordings) stays out of the real user's folders."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_DATA_HOME", str(tmp_path_factory.mktemp("data")))
        patch.setenv("XDG_RUNTIME_DIR", str(tmp_path_factory.mktemp("run")))
        yield


@pytest.fixture(scope="session")
def recordings() -> Path:
    """The folder of real recordings, which are not part of the project."""
    default = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("SKYLESS_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"no recordings at {folder}: set SKYLESS_DATA to their folder")
    return folder
