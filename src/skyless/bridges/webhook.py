"""``webhook+https://HOST/PATH``: posts changes of alarms as JSON, signed if a secret is given.

The signature is HMAC-SHA256 of the timestamp, a dot and the body (docs/howto/alarms.md).
"""

import hmac
import http.client
import ssl
import time
from functools import partial
from typing import Final
from urllib.parse import quote

import msgspec

from skyless.bridges._deliveries import TIMEOUT_S, AlarmTarget, Delivery, Open, RefusedError, read_secret
from skyless.bridges.target import BridgeContext, TargetUrl
from skyless.core.version import installed_version
from skyless.run.mqtt.address import is_loopback

TIMESTAMP_HEADER: Final = "Skyless-Timestamp"
SIGNATURE_HEADER: Final = "Skyless-Signature"
KEY_HEADER: Final = "Idempotency-Key"

_TRY_AGAIN: Final = frozenset({408, 425, 429})


class Webhook(AlarmTarget):
    """Posts to one address."""

    def __init__(self, url: TargetUrl, context: BridgeContext) -> None:
        super().__init__(url.text, context.log, frozenset({"raised", "ended", "acknowledged"}))
        self._host = url.host("")
        if not self._host:
            raise url.wrong(f"{url.scheme}://HOST/PATH")
        is_tls = url.scheme == "webhook+https"
        self._port = url.port(443 if is_tls else 80)
        https = partial(http.client.HTTPSConnection, context=ssl.create_default_context())
        self._connection = https if is_tls else http.client.HTTPConnection
        self._path = quote(url.path() or "/", safe="/:@!$&'()*+,;=~?%")
        name = url.text_option("secret_file")
        self._secret = read_secret(url.text, "secret_file", name).encode() if name else None
        if not is_tls and not is_loopback(self._host):
            context.log(f"{url.text}: alarms leave this computer unencrypted; webhook+https: encrypts")

    def attempt(self, delivery: Delivery, on_open: Open) -> None:
        """Post once."""
        site = self.site
        where = None if site is None else {"id": site.id, "name": site.name, "simulated": site.simulated}
        body = msgspec.json.encode({"type": delivery.what, "alarm": delivery.alarm, "site": where})
        stamp = f"{time.time():.0f}"
        headers = {
            "Content-Type": "application/json",
            "User-Agent": f"skyless/{installed_version()}",
            KEY_HEADER: quote(delivery.key, safe="/~+._-"),
            TIMESTAMP_HEADER: stamp,
        }
        if self._secret is not None:
            headers[SIGNATURE_HEADER] = hmac.new(self._secret, f"{stamp}.".encode() + body, "sha256").hexdigest()
        connection = self._connection(self._host, self._port, timeout=TIMEOUT_S)
        try:
            connection.connect()
            on_open(connection.sock)
            connection.request("POST", self._path, body, headers)
            answer = connection.getresponse()
        finally:
            connection.close()
        if 200 <= answer.status < 300:
            return
        fault = f"{answer.status} {answer.reason}"[:100]
        if answer.status >= 500 or answer.status in _TRY_AGAIN:
            raise ConnectionError(fault)
        raise RefusedError(fault)


make_target: Final = Webhook
