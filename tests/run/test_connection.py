"""A connection to what only plays the broker."""

import asyncio
import contextlib

import pytest

from skyless.core.errors import SkylessError
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.connection import Introduction, check_broker, open_connection

pytestmark = pytest.mark.site


@contextlib.asynccontextmanager
async def player(answer):
    """Where something gives one answer, whoever comes, and then listens without a word."""

    async def serve(reader, writer):
        writer.write(answer)
        while await reader.read(65_536):
            pass
        writer.close()

    async with await asyncio.start_server(serve, "127.0.0.1", 0) as server:
        yield MqttAddress("127.0.0.1", server.sockets[0].getsockname()[1])


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        (1, "answer is not MQTT"),
        (2, "refuses: Client identifier not valid"),
        (3, "refuses: Server unavailable"),
        (4, "refuses: wrong user name or password; the address has no user: it should be USER@HOST"),
        (5, "refuses: wrong user name or password, or no permission; the address has no user"),
        (99, "refuses: "),
    ],
)
async def test_each_refusal_of_the_standard_is_reported(code, reason):
    """MQTT 3.1.1, table 3.1."""
    async with player(bytes((0x20, 2, 0, code))) as address:
        with pytest.raises(SkylessError, match=reason):
            await check_broker(address)


async def test_a_number_that_still_flies_is_not_given_again():
    async with player(b"\x20\x02\x00\x00") as address:
        connection = await open_connection(address, None, Introduction("me", 60))
        first = connection.publish("a", b"", 1, retain=False)
        connection._client._last_mid = 0xFFFF - 5  # as if that many had been sent since
        numbers = [connection.publish("a", b"", 1, retain=False) for _ in range(10)]
        assert first not in numbers
        assert len(set(numbers)) == len(numbers)
        connection.abort("enough")
