"""Tests that are coroutines."""

import asyncio
import functools


def in_loop(test):
    """Run a coroutine of a test in an event loop of its own."""

    @functools.wraps(test)
    def run(*arguments, **fixtures):
        asyncio.run(test(*arguments, **fixtures))

    return run
