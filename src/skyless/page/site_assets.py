"""The assets of a site: kept by the broker, and in a file where the dashboard has one."""

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from skyless.core.errors import SkylessError
from skyless.core.whole_files import replace_files
from skyless.page._state import encode
from skyless.run.assets import BadAssetsError, assets_at, check_assets, read_assets, read_csv, write_csv
from skyless.run.mqtt.messages import Asset, AssetsMessage

_log = logging.getLogger("skyless.page")

SETTLE_S: Final = 3.0
"""A broker that has sent no assets for so long after a connection has none."""


class AssetsFile:
    """A table in CSV that is written again with every change."""

    def __init__(self, path: Path) -> None:
        """A file that does not exist is made with the first change. Raises SkylessError: it cannot be used."""
        self.path = path
        self.assets: tuple[Asset, ...] | None = None
        """Its content; None before it exists."""
        try:
            if path.exists():
                self.assets = read_csv(path.read_bytes())
            elif not path.parent.is_dir():
                raise SkylessError(f"--assets is {str(path)!r}; it should be a file in a folder that exists")
        except OSError as error:
            raise SkylessError(f"--assets is {str(path)!r}, which cannot be read: {error.strerror}") from None
        except BadAssetsError as error:
            raise SkylessError(f"{path}: {error}") from None

    def write(self, assets: tuple[Asset, ...], *, keep_old: bool) -> None:
        """Replace its content. With ``keep_old`` the former content stays beside it as ``….old``."""
        if assets == self.assets:
            return
        files = {self.path: write_csv(assets)}
        try:
            if keep_old and self.assets is not None:
                files[self.path.with_name(f"{self.path.name}.old")] = self.path.read_bytes()
            replace_files(files)
        except OSError as error:
            _log.warning("%s cannot be written: %s; the assets are at the broker", self.path, error.strerror)
        else:
            self.assets = assets


class SiteAssets:
    """The assets of the site that is shown. Each change is handed to ``broadcast`` for the open pages."""

    def __init__(self, broadcast: Callable[[str, bytes], None], file: AssetsFile | None = None) -> None:
        self._broadcast, self._file = broadcast, file
        self._site = ""
        self._publish: Callable[[AssetsMessage], None] = lambda _message: None
        self._kept: AssetsMessage | None = None
        """As the broker keeps them or they were stored here last; None where it has none."""
        self._stored: AssetsMessage | None = None  # stored here, and not come back from the broker yet
        self._fault: str | None = None  # why the assets that the broker keeps cannot be read
        self._is_first = True  # whether the next message is the first of the broker
        self._due_s: float | None = None  # when a broker that has sent none has none
        self.by_tag: Mapping[str, Asset] = {}
        """The assets of the site that is shown."""

    @property
    def assets(self) -> tuple[Asset, ...]:
        """The same in their order."""
        return tuple(self.by_tag.values())

    def attach(self, publish: Callable[[AssetsMessage], None]) -> None:
        """``publish`` gives a message to the broker, which keeps it."""
        self._publish = publish
        if self._stored is not None:
            publish(self._stored)

    def on_connection(self, connected: bool, now_s: float) -> None:
        """The broker sends what it has kept soon after a connection."""
        self._due_s = now_s + SETTLE_S if connected else None

    def on_site(self, name: str) -> None:
        """The name of the site that is shown is known."""
        self._site = name
        self._show()

    def on_message(self, payload: bytes) -> bool:
        """Assets from the broker. False where they are only an echo. Raises BadAssetsError."""
        try:
            message = read_assets(payload) if payload else None
        except BadAssetsError as error:
            self._fault = str(error)
            raise
        self._fault = None
        if self._stored is not None:
            if message == self._stored:
                self._stored = None
            return False  # the echo, or older than what was stored here and is on its way
        if message == self._kept:
            return False
        is_first, self._is_first = self._is_first, False
        self._kept = message
        self._show()
        self._write(keep_old=is_first)
        return True

    def store(self, assets: tuple[Asset, ...], site: str = "") -> None:
        """Replace all assets of the site of this name, by default of the one shown.

        Raises BadAssetsError; also where the broker keeps assets that cannot be read or are of another site.
        """
        check_assets(assets)
        if site and site != self._site:
            raise BadAssetsError(f"site is {site[:100]!r}; it should be {self._site[:100]!r}, which is shown now")
        if self._fault is not None:
            raise BadAssetsError(f"the assets that the broker keeps cannot be read: {self._fault}; clear their topic")
        if self._is_foreign:
            other = self._kept.site if self._kept is not None else ""
            raise BadAssetsError(
                f"the broker keeps the assets of the site {other[:100]!r}, which has the same number; clear their topic"
            )
        self._is_first = False
        self._kept = self._stored = AssetsMessage(assets, self._site)
        self._publish(self._stored)
        self._show()
        self._write(keep_old=False)

    def tick(self, now_s: float) -> None:
        """Give the broker the file's assets where it has none."""
        if self._due_s is None or now_s < self._due_s or not self._site:
            return
        self._due_s = None
        if self._kept is None and self._fault is None and self._file is not None and self._file.assets:
            self.store(self._file.assets)

    def message(self) -> bytes:
        """What a page is sent."""
        return encode("assets", {"assets": self.assets})

    @property
    def _is_foreign(self) -> bool:
        return self._kept is not None and bool(self._kept.assets) and self._kept.site not in ("", self._site)

    def _show(self) -> None:
        by_tag = {} if self._kept is None else assets_at(self._kept, self._site)
        if by_tag != self.by_tag:
            self.by_tag = by_tag
            self._broadcast("assets", self.message())

    def _write(self, *, keep_old: bool) -> None:
        if self._file is not None and not self._is_foreign and self._kept is not None:
            self._file.write(self.assets, keep_old=keep_old)
