"""Radios that run, all that they tell, and the fixes that come of it."""

import asyncio
import contextlib

from skyless.core.any_receiver import AnyReceiver


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


def fixes_of(heard, method="joint"):
    """All that a receiver says of each reception, to the last bit, and its counters."""
    receiver = AnyReceiver(method)
    return [_bits(fix) for fix in map(receiver.hear, heard)], receiver.counters


def _bits(fix):
    if fix is None:
        return None
    arrays = (fix.position_m, fix.covariance_m2, fix.velocity_mps, fix.velocity_covariance)
    rest = (fix.time_s, fix.std_m, fix.dops, fix.anchors, fix.chi2, fix.dof, fix.hpl_m, fix.vpl_m, fix.alert)
    return tuple(None if array is None else array.tobytes() for array in arrays), rest
