"""What makes an emulated board a tag by itself: its settings, its own position, and what it says of them.

It computes with ``Receiver``, whose C is the firmware's as well (``firmware/source/tag.c``), and has this computer's
clock. It says records only, and neither sleeps nor advertises.
"""

import time
from collections.abc import Callable
from typing import Final

from skyless.core.air.frame import Reception
from skyless.core.fix import Fix
from skyless.core.integrity import IntegrityRequirement
from skyless.core.tag.receiver import NOT_DROPS, Receiver
from skyless.radio.serial import link
from skyless.radio.serial.link import ANY_SITE, MODES, OUTPUTS, BoardSettings, pack, unpack
from skyless.radio.tag_reports import BODY_AT, fix_body, georeference_body, place_body, status_body
from skyless.run.fix_log import Lateness
from skyless.run.process import HEALTH_S
from skyless.run.rate_limit import RateLimit

_REPEAT_S: Final = 10.0
"""How often places of anchors and the georeference are repeated."""


class BoardTag:
    """The tag on a board; ``settings`` are those in use, ``flash`` those that it has after a start."""

    def __init__(self, report: Callable[[int, bytes], None], clock_s: Callable[[], float] = time.monotonic) -> None:
        """``report`` sends a record of a kind; ``clock_s()`` is the host's time, on the clock of receptions."""
        self._report, self._clock_s = report, clock_s
        self.flash = BoardSettings()
        self.begin(self.flash)

    def begin(self, settings: BoardSettings) -> None:
        """Work with these settings; nothing has been heard."""
        self._receiver = Receiver(
            site=None if settings.site == ANY_SITE else settings.site,
            qa=settings.qa_m2ps3,
            z_bounds_m=(settings.low_mm / 1000, settings.high_mm / 1000) if settings.has_bounds else None,
            integrity=IntegrityRequirement(settings.integrity_risk, settings.alert_limit_m or None),
        )
        self.settings = settings
        self._rate, self._lateness = RateLimit(settings.rate_hz or 1e6), Lateness()
        self._begun_s = self._clock_s()
        self._fixed_s = self._placed_s = -_REPEAT_S
        self._placed: tuple[int, ...] = ()
        """Anchors whose places were said last."""

    @property
    def is_on(self) -> bool:
        """Whether it computes; else the board is a radio for its host."""
        return MODES[self.settings.mode] == "tag"

    def execute(self, record: bytes) -> None:
        """Execute a command about settings; the time is known already."""
        if record[0] == link.SET_TAG_CONFIG:
            settings = unpack(record[link.SETTINGS_AT :])
            if settings is None or OUTPUTS[settings.output] != "records":
                self._report(link.REFUSED, bytes((link.SET_TAG_CONFIG, link.REFUSED_SETTING)))
                return
            self.begin(settings)
            if record[BODY_AT] & link.IN_FLASH:
                self.flash = settings
        if record[0] != link.SET_TIME:
            in_flash = link.IN_FLASH * (self.flash == self.settings)
            self._report(link.TAG_CONFIG, bytes((in_flash,)) + pack(self.settings))

    def hear(self, reception: Reception) -> None:
        """Process a frame; say where the tag is, if that is due."""
        now_s = self._clock_s()
        ended_s = now_s if reception.host_s is None else reception.host_s
        if not self._lateness.admits(ended_s, now_s) or (fix := self._receiver.hear(reception)) is None:
            return
        self._fixed_s = now_s
        if self._rate.is_due(ended_s):
            if fix.anchors != self._placed or now_s - self._placed_s > _REPEAT_S:
                self._say_places(fix, now_s)
            latency_s, serial = self._clock_s() - ended_s, self._receiver.counters["fixes"]
            who = self._receiver.site or 0, self.settings.tag
            self._report(link.FIX, fix_body(fix, time.time() - latency_s, reception.rx_ticks, latency_s, serial, *who))

    def _say_places(self, fix: Fix, now_s: float) -> None:
        self._placed, self._placed_s, heard = fix.anchors, now_s, self._receiver.heard_site
        for anchor, place_m in zip(fix.anchors, fix.anchors_m.tolist(), strict=True):
            self._report(link.ANCHOR_PLACE, place_body(anchor, place_m))
        if heard is not None and heard.georeference is not None:
            self._report(link.GEOREFERENCE, georeference_body(heard.georeference))

    def each_second(self) -> None:
        """Say what it has counted, and why there is no fix where there is none."""
        if self.is_on:
            receiver, counted, now_s = self._receiver, self._receiver.counters, self._clock_s()
            reason = receiver.reason if now_s - self._fixed_s > HEALTH_S else None
            dropped = sum(count for why, count in counted.items() if why not in NOT_DROPS)
            counts = counted["heard"], counted["fixes"], self._lateness.dropped, 0, dropped
            self._report(link.TAG_STATUS, status_body(receiver.site, reason, counts, now_s - self._begun_s))
