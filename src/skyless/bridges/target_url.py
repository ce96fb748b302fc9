"""The address of a target: ``SCHEME://HOST:PORT?KEY=VALUE`` or ``SCHEME:PATH?KEY=VALUE``."""

import re
from collections.abc import Sequence
from math import isfinite
from typing import Final
from urllib.parse import parse_qsl, unquote, urlsplit

from skyless.errors import SkylessError
from skyless.mqtt.address import hide_password

TAG_NAME: Final = re.compile(r"[A-Za-z0-9_-]{1,32}")
"""Names that tags may have."""

_HOST: Final = "//HOST:PORT"
_USER: Final = "USER@"
_PATH: Final = "PATH"
"""Parts of an address, as messages name them."""


class TargetUrl:
    """One address; each part is checked when it is read, and ``check_all_read`` refuses what nobody reads."""

    def __init__(self, text: str) -> None:
        """Raises SkylessError."""
        self.text = hide_password(text)
        """As it was given, for messages: without a password."""
        scheme, colon, _ = text.partition(":")
        try:
            parts = urlsplit(text)
            self._port = parts.port
        except ValueError:
            raise self.wrong("a port between 1 and 65535 after the host") from None
        if not colon or not scheme:
            raise self.wrong("SCHEME://HOST:PORT or SCHEME:PATH, as nmea+tcp://:10110")
        self.scheme = scheme.lower()
        self._netloc, self._host, self._path = parts.netloc, parts.hostname or "", unquote(parts.path)
        if self._port == 0:
            raise self.wrong("a port between 1 and 65535 after the host")
        if parts.fragment:
            raise self.wrong("without #")
        pairs = parse_qsl(parts.query, keep_blank_values=True)
        self._options = dict(pairs)
        if len(self._options) < len(pairs):
            raise self.wrong("each key once")
        self._parts: set[str] = set()
        """That have been read, and which keys."""
        self._read: set[str] = set()

    def host(self, default: str = "127.0.0.1") -> str:
        """The host, ``default`` where none is given."""
        self._parts.add(_HOST)
        return self._host or default

    def port(self, default: int) -> int:
        """The port, ``default`` where none is given."""
        return self._port or default

    def netloc(self) -> str:
        """``USER:PASSWORD@HOST:PORT``, as it was given; empty where there is none."""
        self._parts |= {_HOST, _USER}
        return self._netloc

    def path(self) -> str:
        """Of a port or a link; empty where there is none."""
        self._parts.add(_PATH)
        return self._path

    def text_option(self, key: str, default: str = "") -> str:
        """The value of a key, as it is."""
        self._read.add(key)
        return self._options.get(key, default)

    def number(self, key: str, default: float, least: float, most: float) -> float:
        """A number within limits. Raises SkylessError."""
        text = self.text_option(key)
        try:
            value = float(text) if key in self._options else default
        except ValueError:
            value = float("nan")
        if not isfinite(value) or not least <= value <= most:
            raise self._wrong_value(key, f"a number from {least:g} to {most:g}")
        return value

    def whole_number(self, key: str, default: int, least: int, most: int) -> int:
        """A number without a fraction, within limits. Raises SkylessError."""
        value = self.number(key, default, least, most)
        if value % 1:
            raise self._wrong_value(key, f"a whole number from {least} to {most}")
        return int(value)

    def has(self, key: str) -> bool:
        """Whether a key is given, even without a value."""
        self._read.add(key)
        return key in self._options

    def choice(self, key: str, names: Sequence[str], default: str) -> str:
        """One of several words. Raises SkylessError."""
        value = self.text_option(key, default)
        if value not in names:
            raise self._wrong_value(key, f"{', '.join(names[:-1])} or {names[-1]}")
        return value

    def tag(self) -> str | None:
        """The only tag that is wanted; None for all. Raises SkylessError."""
        name = self.text_option("tag")
        if "tag" in self._options and not TAG_NAME.fullmatch(name):
            raise self._wrong_value("tag", "a tag's name: 1 to 32 letters, digits, - or _")
        return name or None

    def check_all_read(self) -> None:
        """Refuse parts and keys that nobody has read. Raises SkylessError."""
        given = {
            _HOST: bool(self._host) or self._port is not None,
            _USER: "@" in self._netloc,
            _PATH: self._path not in ("", "/"),
        }
        if not self._parts.issuperset(part for part, is_given in given.items() if is_given):
            raise self.wrong(f"{self.scheme}:{''.join(part for part in (_HOST, _PATH) if part in self._parts)}")
        for key in self._options:
            if key not in self._read:
                known = ", ".join(sorted(self._read))
                raise SkylessError(f"the target {self.text!r} has {key!r}; its keys are {known}")

    def wrong(self, expected: str) -> SkylessError:
        """What to raise where the address cannot be used."""
        return SkylessError(f"the target is {self.text!r}; it should be {expected}")

    def _wrong_value(self, key: str, expected: str) -> SkylessError:
        given = f"{key}={self._options[key]}" if key in self._options else f"no {key}="
        return SkylessError(f"the target {self.text!r} has {given}; it should be {expected}")
