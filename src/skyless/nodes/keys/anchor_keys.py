"""Key chains of a site in the program of its anchors: read from a folder, and again whenever its files change."""

import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from skyless.authentication.chain import Chain, ChainRing
from skyless.authentication.key_files import SEEDS_VARIABLE, SiteKeys, parse_seeds, read_keys
from skyless.errors import SkylessError
from skyless.nodes.keys.faults import Log

KEYS_S: Final = 3.0
"""Interval at which files are looked at."""

_DAY_S: Final = 86_400.0
_LITTLE_LEFT_S: Final = 60.0 * _DAY_S


class AnchorKeys:
    """Chains of one site, which the anchors of a process share."""

    def __init__(self, folder: Path, site: int, log: Log, environment: Mapping[str, str] = os.environ) -> None:
        """Read them.

        Raises:
            SkylessError: they cannot be used.
        """
        self._folder, self._site, self._log = folder, site, log
        self._seeds = parse_seeds(environment.get(SEEDS_VARIABLE, ""))
        self._seen = self._state()
        self._trouble = ""
        self._warned_day: int | None = None
        self._use(read_keys(folder, site, self._seeds))

    def update(self) -> bool:
        """Read the files again if they have changed; whether there are other chains from now on.

        Files that cannot be used, as while they are copied, are logged once, and what was read before stays in use.
        """
        state = self._state()
        if state == self._seen:
            return False
        self._seen, before = state, self.chains
        try:
            keys = read_keys(self._folder, self._site, self._seeds)
        except SkylessError as error:
            if str(error) != self._trouble:
                self._trouble = str(error)
                self._log(f"keys: the former ones stay in use: {error}")
            return False
        self._trouble = ""
        self._use(keys)
        return self.chains != before

    def _use(self, keys: SiteKeys) -> None:
        self.chains: tuple[Chain, ...] = keys.chains
        self._ring = ChainRing(keys.chains)
        newest = keys.chains[-1]
        waiting = [serial for serial in keys.without_seed if serial > newest.serial]
        if waiting:
            self._log(f"keys: chain {waiting[-1]} has no seed in {self._folder}; chain {newest.serial} stays in use")

    def present(self, unix_s: float) -> int | None:
        """Serial number of the chain that counts at a Unix time."""
        timing = self._ring.timing
        keys = None if timing is None else self._ring.at(timing.interval_at(unix_s))
        return None if keys is None else keys.chain.serial

    @property
    def ends_s(self) -> float:
        """Unix time at which the last chain ends."""
        return max(chain.timing.start_s(chain.end) for chain in self.chains)

    def warn(self, unix_s: float) -> None:
        """Log once a day when little is left of the last chain."""
        left_s = self.ends_s - unix_s
        day = int(left_s // _DAY_S)
        if left_s > _LITTLE_LEFT_S or day == self._warned_day:
            return
        self._warned_day = day
        until = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(self.ends_s))
        days = f"in {day} days" if day else "within a day"
        what = f"ends {days} ({until})" if left_s > 0.0 else f"has ended ({until})"
        self._log(f"keys: the last key chain {what}: skyless site keys rotate makes another one")

    def _state(self) -> tuple[tuple[str, int, int, int], ...]:
        """What shows that a file has changed."""
        try:
            with os.scandir(self._folder) as entries:
                known = [(entry.name, entry.stat()) for entry in entries if entry.name.endswith((".public", ".seed"))]
        except OSError:
            return ()
        return tuple(sorted((name, one.st_mtime_ns, one.st_size, one.st_mode) for name, one in known))
