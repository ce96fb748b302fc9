"""Tests that are coroutines have an event loop each; the DW1000's driver runs with a sanitizer."""

import asyncio
import inspect

import pytest


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem):
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    arguments = inspect.signature(pyfuncitem.obj).parameters
    asyncio.run(pyfuncitem.obj(**{name: pyfuncitem.funcargs[name] for name in arguments}))
    return True


@pytest.fixture(scope="session", autouse=True)
def sanitized_driver():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CC", "cc -fsanitize=undefined -fno-sanitize-recover=all")
        yield
