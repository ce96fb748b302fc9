"""Radios that run, and all that they tell."""

import asyncio
import contextlib


class RadioEvents:
    """A radio that runs, and all that it has told."""

    def __init__(self, radio):
        self.radio, self.events = radio, []
        self.task = asyncio.ensure_future(radio.run(self.events.append))

    def of(self, kind):
        return [event for event in self.events if isinstance(event, kind)]

    async def until(self, kind, count=1):
        async with asyncio.timeout(30):
            while len(self.of(kind)) < count:
                await asyncio.sleep(0.002)
        return self.of(kind)[-1]

    async def stop(self):
        self.task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self.task


@contextlib.asynccontextmanager
async def radio_events(radio):
    node = RadioEvents(radio)
    try:
        yield node
    finally:
        await node.stop()
