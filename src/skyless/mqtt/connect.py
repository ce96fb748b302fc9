"""Reaching a broker, and saying in words why it cannot be reached."""

import ssl

from skyless.errors import SkylessError
from skyless.mqtt.address import MqttAddress
from skyless.mqtt.connection import Connection, Reactions, RefusedError
from skyless.mqtt.paho_client import Introduction


async def open_connection(
    address: MqttAddress, tls: ssl.SSLContext | None, who: Introduction, react: Reactions | None = None
) -> Connection:
    """A connection that the broker has accepted.

    Raises:
        RefusedError: it does not want this client.
        OSError: it cannot be reached, or does not answer (TimeoutError).
    """
    connection = Connection(address, tls, who, react or Reactions())
    await connection.open()
    return connection


async def check_broker(address: MqttAddress, tls: ssl.SSLContext | None = None) -> None:
    """See whether a broker lets us in; ``tls`` takes the place of the address's own checks of its certificate.

    Raises:
        SkylessError: it does not, and why.
    """
    try:
        connection = await open_connection(address, tls or address.tls_context(), Introduction("", 60))
    except (OSError, RefusedError) as error:
        raise SkylessError(trouble_with(address, error)) from None
    await connection.leave()


def trouble_with(address: MqttAddress, error: OSError | RefusedError) -> str:
    """One line for people about a connection that does not come about."""
    if isinstance(error, RefusedError):
        hint = "; the password stands in SKYLESS_MQTT_PASSWORD or after the user's name" if "user" in str(error) else ""
        return f"the broker {address} refuses: {error}{hint}"
    if isinstance(error, ssl.SSLCertVerificationError):
        return (
            f"the certificate of the broker {address} is not trusted: {error.verify_message}; --mqtt-ca names another"
        )
    if isinstance(error, ssl.SSLError):
        return f"the broker {address} does not speak TLS as expected: {error.reason or error}"
    return f"the broker {address} cannot be reached: {error.strerror or error}"
