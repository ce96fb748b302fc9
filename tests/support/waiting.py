"""Waiting, in an event loop and without."""

import asyncio
import contextlib
import time


def came(value, limit_s=60.0):
    """What a function returns, as soon as it is true; without an event loop."""
    end_s = time.monotonic() + limit_s
    while not (found := value()):
        assert time.monotonic() < end_s, f"not within {limit_s:g} s"
        time.sleep(0.02)
    return found


async def until(condition, limit_s=20.0):
    """Wait for something that should come; a test that waits in vain fails."""
    async with asyncio.timeout(limit_s):
        while not condition():
            await asyncio.sleep(0.01)


@contextlib.asynccontextmanager
async def running(*work):
    """Coroutines that run in the block, and are cancelled at its end."""
    tasks = [asyncio.ensure_future(one) for one in work]
    await asyncio.sleep(0)
    try:
        yield tasks
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
