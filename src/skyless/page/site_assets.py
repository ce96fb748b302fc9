"""The assets of a site, retained by the broker, and kept in a file if the dashboard has one."""

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from skyless.core.errors import SkylessError
from skyless.files import replace_files
from skyless.page.events import Kept
from skyless.page.state import encode
from skyless.run.assets import assets_at, check_assets, read_assets, read_csv, write_csv
from skyless.run.mqtt.messages import Asset, AssetsMessage, WrongMessageError

_NONE: Final = AssetsMessage(())
_log = logging.getLogger("skyless.page")

SETTLE_S: Final = 3.0
"""A broker that has sent no assets for this long after connecting has none."""


class AssetsFile:
    """A CSV table that is rewritten with every change."""

    def __init__(self, path: Path) -> None:
        """A missing file is created with the first change. Raises SkylessError if it cannot be used."""
        self.path = path
        self.assets: tuple[Asset, ...] = ()
        """Content of the file."""
        self._is_of_before = path.exists()
        try:
            if self._is_of_before:
                self.assets = read_csv(path.read_bytes())
            elif not path.parent.is_dir():
                raise SkylessError(f"--assets is {str(path)!r}; it should be a file in a folder that exists")
        except OSError as error:
            raise SkylessError(f"--assets is {str(path)!r}, which cannot be read: {error.strerror}") from None
        except WrongMessageError as error:
            raise SkylessError(f"{path}: {error}") from None

    def write(self, assets: tuple[Asset, ...]) -> None:
        """Replace the content. The content at the start is kept beside it as ``….old``."""
        if assets == self.assets:
            return
        try:
            files = {self.path: write_csv(assets)}
            if self._is_of_before:
                files[self.path.with_name(f"{self.path.name}.old")] = self.path.read_bytes()
            replace_files(files)
        except OSError as error:
            _log.warning("%s cannot be written: %s; the assets are at the broker", self.path, error.strerror)
        else:
            self.assets, self._is_of_before = assets, False


class SiteAssets:
    """The assets of the site shown. Each change is passed to ``broadcast`` for the open pages."""

    def __init__(self, broadcast: Callable[[str, bytes], None], file: AssetsFile | None = None) -> None:
        self._broadcast, self._file = broadcast, file
        self._site = ""
        self.kept = Kept(_NONE, read_assets)
        self._due_s: float | None = None  # time when a broker that has sent no assets counts as having none
        self.by_tag: Mapping[str, Asset] = {}
        """The assets of the site shown, by tag."""

    @property
    def message(self) -> AssetsMessage:
        """The assets with the site's name."""
        return AssetsMessage(tuple(self.by_tag.values()), self._site)

    def encoded(self) -> bytes:
        """Message for pages."""
        return encode("assets", {"assets": self.message.assets})

    def on_connection(self, connected: bool, now_s: float) -> None:
        """The broker has been connected or disconnected; it sends retained assets soon after connecting."""
        self._due_s = now_s + SETTLE_S if connected else None

    def on_site(self, name: str) -> None:
        """Use the name of the site shown."""
        self._site = name
        self._show()

    def on_message(self, payload: bytes) -> None:
        """Process assets from the broker. Raises WrongMessageError."""
        if self.kept.receive(payload):
            self._show()
        if payload:
            self._due_s = None

    def store(self, assets: tuple[Asset, ...], site: str = "") -> None:
        """Replace all assets; ``site``: name of the requesting page's site. Raises WrongMessageError."""
        check_assets(assets)
        self.kept.check_store(site, self._site)
        kept = self.kept.message
        if kept.assets and kept.site not in ("", self._site):
            raise WrongMessageError(
                f"the broker keeps assets of the site {kept.site[:100]!r}, which has this number; clear their topic"
            )
        self._due_s = None
        self.kept.store(AssetsMessage(assets, self._site))
        self._show()

    def tick(self, now_s: float) -> None:
        """Give the broker the file's assets if it has none."""
        if self._due_s is not None and now_s >= self._due_s and self._site:
            self._due_s = None
            has_none = self.kept.message == _NONE and self.kept.fault is None
            if has_none and self._file is not None and self._file.assets:
                self.store(self._file.assets)

    def _show(self) -> None:
        kept = self.kept.message
        by_tag = assets_at(kept, self._site)
        if by_tag != self.by_tag:
            self.by_tag = by_tag
            self._broadcast("assets", self.encoded())
        if self._file is not None and self._site and kept != _NONE and kept.site in ("", self._site):
            self._file.write(self.message.assets)
