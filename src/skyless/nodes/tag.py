"""One tag as a program: its receiver on a radio, its fixes and health on MQTT."""

import time
from collections import Counter
from collections.abc import Callable

from msgspec import Struct

from skyless.air.reception import Reception
from skyless.method_names import DEFAULT_METHOD
from skyless.nodes.fix_log import FixListener, FixLog
from skyless.nodes.hearing import Hearing
from skyless.nodes.latency import PhaseLog
from skyless.positioning.integrity import IntegrityRequirement
from skyless.radios.interface import Gone, Hint, Radio, RadioEvent, Restarted
from skyless.receiver import NOT_DROPS, Receiver


class TagSettings(Struct, frozen=True):
    """How a tag computes and what it tells."""

    method: str = DEFAULT_METHOD
    qa: float = 0.3
    site: int | None = None
    """The only site to listen to; None for the first that is heard."""
    z_bounds_m: tuple[float, float] | None = None
    integrity: IntegrityRequirement = IntegrityRequirement()
    publish_hz: float = 50.0
    """Fixes a second on MQTT at most; all of them count."""


class TagNode:
    """Runs ``Receiver`` on a radio. ``publish`` is given the fixes that are to be published."""

    def __init__(
        self,
        settings: TagSettings,
        radio: Radio,
        publish: FixListener,
        said: Callable[[str], None],
        before: Callable[[Receiver, Reception, int], None] | None = None,
    ) -> None:
        """``before`` is called with receiver, reception and the number of fixes so far before each reception."""
        self.settings, self.radio = settings, radio
        self.name = radio.name
        self.receiver = self.new_receiver()
        self.receptions = self.restarts = 0
        self.book = FixLog(self.name, publish, settings.publish_hz)
        self.phases = PhaseLog()
        self._said, self._before = said, before
        self._hearing = Hearing(f"tag {self.name}", said, radio.advice)

    def new_receiver(self) -> Receiver:
        """A receiver that knows nothing yet."""
        asked = self.settings
        return Receiver(
            asked.method, site=asked.site, qa=asked.qa, z_bounds_m=asked.z_bounds_m, integrity=asked.integrity
        )

    @property
    def drops(self) -> Counter[str]:
        """What could not be used, by reason."""
        heard = self.receiver.counters.items()
        return Counter({reason: count for reason, count in heard if reason not in NOT_DROPS}) + self.radio.counters

    def look(self, now_s: float) -> None:
        """Log where to look if it hears nothing of use; ``now_s`` is the host's monotonic clock."""
        self._hearing.look(now_s, self.receptions, self.receiver.counters["heard"], self.drops)

    async def run(self) -> None:
        """Listen until cancelled."""
        await self.radio.run(self.hear)

    def hear(self, event: RadioEvent) -> None:
        """Take what the radio tells."""
        if isinstance(event, Reception):
            self._receive(event)
        elif isinstance(event, Restarted):
            self.restarts += 1
            self._hearing.begin()
            self._said(f"tag {self.name}: listening" + (" again" if self.restarts > 1 else ""))
            if self.receptions:
                self.receiver = self.new_receiver()
        elif isinstance(event, Gone):
            self._hearing.end()
            self._said(f"tag {self.name}: {event.reason}; still looking for it")
        elif isinstance(event, Hint):
            self._said(f"tag {self.name}: {event.text}")

    def _receive(self, reception: Reception) -> None:
        if self._before is not None:
            self._before(self.receiver, reception, self.book.serial)
        self.receptions += 1
        fix = self.receiver.hear(reception)
        done_s = time.monotonic()
        ended_s = done_s if reception.host_s is None else reception.host_s
        self.phases.hear(reception.frame, ended_s, done_s, made_fix=fix is not None)
        if fix is not None:
            self.book.take(fix, ended_s, done_s)
