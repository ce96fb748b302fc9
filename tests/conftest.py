"""What all tests share."""

import asyncio
import contextlib
import inspect
import math
import os
import signal
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from support.tiers import LONG, TIERS, UnitTests, file_tiers

settings.register_profile("skyless", deadline=None, derandomize=True)  # a first call compiles; a run repeats itself
settings.load_profile("skyless")


UNIT_TESTS = UnitTests()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--tiers", default="", help=f"run only the tests of these tiers: {', '.join(TIERS)}")


def pytest_configure(config: pytest.Config) -> None:
    for ending in (signal.SIGINT, signal.SIGHUP):
        if signal.getsignal(ending) is signal.SIG_IGN:  # as under nohup: programs would inherit it, and never end
            signal.signal(ending, signal.default_int_handler if ending is signal.SIGINT else signal.SIG_DFL)
    for name, meaning in TIERS.items():
        config.addinivalue_line("markers", f"{name}: {meaning}")
    if set(_tiers(config)) - set(TIERS):
        raise pytest.UsageError(f"--tiers is {config.option.tiers}; it should be some of {', '.join(TIERS)}")


def _tiers(config: pytest.Config) -> list[str]:
    return [tier for tier in config.option.tiers.split(",") if tier]


def _tier(item: pytest.Item) -> str:
    return next((mark.name for mark in item.iter_markers() if mark.name in TIERS), "unit")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Clients that need environments of their own run only when they are asked for: ``scripts/test clients``.

    A file is not even imported if all its tests are of another tier than those asked for.
    """
    if collection_path.name == "clients":
        return True if not any("clients" in argument for argument in config.args) else None
    if not _tiers(config) or collection_path.suffix != ".py":
        return None
    return True if file_tiers(collection_path.read_text(encoding="utf-8")).isdisjoint(_tiers(config)) else None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if tiers := _tiers(config):
        config.hook.pytest_deselected(items=[item for item in items if _tier(item) not in tiers])
        items[:] = [item for item in items if _tier(item) in tiers]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    with UNIT_TESTS.running(item.nodeid) if _tier(item) == "unit" else contextlib.nullcontext():
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    with UNIT_TESTS.called(item.user_properties) if _tier(item) == "unit" else contextlib.nullcontext():
        return (yield)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    reports = terminalreporter.stats.get("passed", [])
    long = [(took_s, one.nodeid) for one in reports for name, took_s in one.user_properties if name == LONG]
    for took_s, name in sorted(long, reverse=True):
        terminalreporter.write_line(f"{took_s:.1f} s of the processor, too long for a unit test: {name}")


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Tests that are coroutines have an event loop each."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    arguments = inspect.signature(pyfuncitem.obj).parameters
    asyncio.run(pyfuncitem.obj(**{name: pyfuncitem.funcargs[name] for name in arguments}))
    return True


@pytest.fixture(scope="session", autouse=True)
def own_data_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What programs keep for their user (broker, recordings) stays out of the real user's folders."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_DATA_HOME", str(tmp_path_factory.mktemp("data")))
        patch.setenv("XDG_RUNTIME_DIR", str(tmp_path_factory.mktemp("run")))
        yield


@pytest.fixture(scope="session", autouse=True)
def no_progress() -> Iterator[None]:
    """What commands write on standard error does not depend on how fast the machine is."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("skyless.cli.common._LINE_S", math.inf)
        yield


@pytest.fixture
def complaint(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """What a command says of a mistake: one line, and nothing else."""
    from skyless.cli.main import main

    def said_by(*arguments: object) -> str:
        capsys.readouterr()
        code = main([*map(str, arguments)])
        out, err = capsys.readouterr()
        assert (code, out, err.count("\n")) == (2, "", 1), err
        assert err.startswith("skyless: ")
        return err

    return said_by


@pytest.fixture
def taken() -> Iterator[int]:
    """A port where another program listens."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        yield other.getsockname()[1]


@pytest.fixture(scope="session")
def recordings() -> Path:
    """The folder of real recordings, which are not part of the project."""
    default = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("SKYLESS_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"no recordings at {folder}: set SKYLESS_DATA to their folder")
    return folder
