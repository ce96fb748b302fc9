"""What the embedded broker is told."""

import json
from pathlib import Path
from typing import Final

from msgspec import Struct

from skyless.errors import SkylessError
from skyless.mqtt.address import PASSWORD_VARIABLE, MqttAddress

_MOST_PAYLOAD: Final = 8 * 1024 * 1024
_SEND_AGAIN: Final = "3s"
"""When a message that a dying subscriber was sent, and has not acknowledged, is sent again; 30 s by default."""
_MOST_STORED: Final = 4 * 1024**3


class BrokerSettings(Struct, frozen=True):
    """Where the embedded broker listens and stores; by default for this machine alone."""

    port: int | None = None
    """None: 1883, or the next one that is free."""
    listen: str = "127.0.0.1"
    data: Path | None = None
    """None: the user's data folder; a temporary one when that cannot be used or another broker has it."""
    user: str | None = None
    password: str | None = None
    certificate: Path | None = None
    key: Path | None = None
    """Certificate and private key in PEM form; with them it speaks TLS."""

    def check(self) -> None:
        """See that nobody is let in by mistake.

        Raises:
            SkylessError: saying which option is missing.
        """
        if (self.user is None) != (self.password is None):
            raise SkylessError(f"--user and a password in {PASSWORD_VARIABLE} belong together")
        if self.user is None and not MqttAddress(self.listen, 1).loopback:
            raise SkylessError(
                f"--listen is {self.listen!r}, where others can reach the broker; "
                f"it should come with --user and a password in {PASSWORD_VARIABLE}"
            )
        if (self.certificate is None) != (self.key is None):
            raise SkylessError("--certificate and --key belong together")
        for text in (self.user or "", self.password or ""):
            if not text.isprintable():
                raise SkylessError("the broker's user name and password should be printable characters")
        if (self.password or "").startswith("$2"):
            raise SkylessError("the broker's password should not begin with $2, which nats-server takes for a hash")

    def address(self, port: int) -> MqttAddress:
        """How this machine reaches it."""
        host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self.listen, self.listen)
        return MqttAddress(host, port, self.certificate is not None, self.user, self.password)


def configuration(settings: BrokerSettings, port: int, data: Path) -> str:
    """The file for nats-server, whose format takes JSON."""
    host = f"[{settings.listen}]" if ":" in settings.listen else settings.listen
    mqtt: dict[str, object] = {"listen": f"{host}:{port}", "ack_wait": _SEND_AGAIN}
    if settings.certificate is not None:
        mqtt["tls"] = {"cert_file": str(settings.certificate), "key_file": str(settings.key)}
    whole: dict[str, object] = {
        "server_name": "skyless",
        "listen": "127.0.0.1:-1",  # NATS itself, which nobody here speaks
        "max_payload": _MOST_PAYLOAD,
        "jetstream": {"store_dir": str(data), "max_file_store": _MOST_STORED},
        "log_file": str(data / "nats-server.log"),
        "logfile_size_limit": 1_000_000,
        "logfile_max_num": 2,
        "mqtt": mqtt,
    }
    if settings.user is not None:
        whole["authorization"] = {"user": settings.user, "password": settings.password}
    return json.dumps(whole, ensure_ascii=False, indent=1) + "\n"
