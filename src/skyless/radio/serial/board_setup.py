"""Asks a board for its settings and changes them, at whatever rate its port works."""

import asyncio
from collections.abc import Sequence
from typing import Final

from skyless.core.errors import SkylessError
from skyless.radio.interface import Gone, RadioEvent
from skyless.radio.serial.link import TagConfig
from skyless.radio.serial.serial_radio import Computing, SerialRadio

_ANSWER_S: Final = 1.5
"""A board answers in milliseconds, also one that has to erase a page of its flash."""


async def set_up(path: str, bauds: Sequence[int], computing: Computing) -> TagConfig:
    """The settings of the board at a port, after the changes that are asked for, if any.

    Raises:
        SkylessError: the port cannot be opened, no board answers, or it is none that computes, or refuses.
    """
    for baud in bauds:
        radio, events = SerialRadio(path, baud, "", computing=computing), asyncio.Queue[RadioEvent]()
        running = asyncio.ensure_future(radio.run(events.put_nowait))
        try:
            event = await asyncio.wait_for(events.get(), _ANSWER_S)
        except TimeoutError:
            continue
        finally:
            config = radio.tag_config
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)
        if isinstance(event, Gone) or config is None:
            raise SkylessError(event.reason if isinstance(event, Gone) else f"the board at {path} says no settings")
        return config
    rates = ", ".join(map(str, bauds))
    raise SkylessError(f"no board of Skyless answers at {path}, at {rates} baud: another port, or other firmware?")
