"""Waiting in an event loop."""

import asyncio


async def until(condition, limit_s=20.0):
    """Wait for something that should come; a test that waits in vain fails."""
    async with asyncio.timeout(limit_s):
        while not condition():
            await asyncio.sleep(0.01)
