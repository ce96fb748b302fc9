"""A client of paho, made for one connection to a broker and connected in the background."""

import asyncio
import secrets
import ssl
from threading import Thread

from msgspec import Struct
from paho.mqtt import client as paho
from paho.mqtt.enums import CallbackAPIVersion

from skyless.mqtt.address import MqttAddress


class Will(Struct, frozen=True):
    """What the broker publishes, retained and at QoS 1, when the client goes without a goodbye."""

    topic: str
    payload: bytes


class Introduction(Struct, frozen=True):
    """Who connects."""

    client: str
    """Its name; a new one where it is empty."""
    keepalive_s: int
    """The connection is given up when the broker has been silent for so long."""
    persistent: bool = False
    """The broker keeps subscriptions, and messages of QoS 1, for this name."""
    will: Will | None = None


def make_client(address: MqttAddress, tls: ssl.SSLContext | None, who: Introduction, timeout_s: float) -> paho.Client:
    """A client that neither bounds the messages in flight nor connects again; both is for a link to do."""
    client = paho.Client(
        CallbackAPIVersion.VERSION2,
        who.client or f"skyless-{secrets.token_hex(4)}",
        clean_session=not who.persistent,
        reconnect_on_failure=False,
    )
    client.connect_timeout = timeout_s
    client.max_inflight_messages_set(0)
    client.username_pw_set(address.user, address.password)
    if who.will is not None:
        client.will_set(who.will.topic, who.will.payload, qos=1, retain=True)
    if tls is not None:
        client.tls_set_context(tls)
        client.tls_insecure_set(not tls.check_hostname)  # else paho compares the names itself
    return client


async def connect(client: paho.Client, address: MqttAddress, keepalive_s: int) -> None:
    """Let paho connect, which blocks, in a thread that no one has to wait for, not even the end of the program.

    Raises:
        OSError: it cannot be reached.
    """
    loop = asyncio.get_running_loop()
    done: asyncio.Future[None] = loop.create_future()

    def finish(error: BaseException | None) -> None:
        if done.cancelled():
            _close(client)
        elif error is None:
            done.set_result(None)
        else:
            done.set_exception(error)

    def work() -> None:
        error: BaseException | None = None
        try:
            client.connect(address.host, address.port, keepalive_s)
        except Exception as caught:  # noqa: BLE001 - told where it is awaited
            error = caught
        try:
            loop.call_soon_threadsafe(finish, error)
        except RuntimeError:  # the event loop has ended meanwhile
            _close(client)

    Thread(target=work, name="MQTT connect", daemon=True).start()
    try:
        await done
    except asyncio.CancelledError:
        if not done.cancelled():  # it came about at the same moment
            _close(client)
        raise


def _close(client: paho.Client) -> None:
    sock = client.socket()
    if sock is not None:
        sock.close()
