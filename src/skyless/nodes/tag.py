"""One tag as a program: its receiver on a radio, its fixes and health on MQTT."""

import time
from collections import Counter
from collections.abc import Callable

from msgspec import Struct

from skyless.air.reception import Reception
from skyless.methods import DEFAULT_METHOD
from skyless.nodes.hearing import Hearing
from skyless.nodes.latency import Latencies, PhaseBook
from skyless.nodes.pace import Pace
from skyless.outputs.messages import FixMessage, Matrix, Vector
from skyless.positioning.fix import Fix
from skyless.positioning.protection import IntegrityRequirement
from skyless.radios.radio import Gone, Hint, Radio, RadioEvent, Restarted
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


FixListener = Callable[[FixMessage], None]


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
        self.started_s = time.monotonic()
        self.unix_less_host_s = time.time() - time.monotonic()
        self.receptions = self.serial = self.restarts = 0
        self.first_fix_s: float | None = None
        self.last_fix_s: float | None = None
        """When the last fix was made, by the host's monotonic clock."""
        self.latencies = Latencies()
        self.phases = PhaseBook()
        self._publish, self._said, self._before = publish, said, before
        self._pace = Pace(settings.publish_hz)
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
        """Say where to look if it hears nothing of use; ``now_s`` is the host's monotonic clock."""
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
            self._before(self.receiver, reception, self.serial)
        self.receptions += 1
        fix = self.receiver.hear(reception)
        done_s = time.monotonic()
        ended_s = done_s if reception.host_s is None else reception.host_s
        self.phases.hear(reception.frame, ended_s, done_s, made_fix=fix is not None)
        if fix is None:
            return
        self.serial += 1
        self.last_fix_s = done_s
        self.latencies.add(done_s - ended_s)
        if self.first_fix_s is None:
            self.first_fix_s = done_s - self.started_s
        if self._pace.is_due(ended_s):
            self._publish(self._message(fix, ended_s, done_s))

    def _message(self, fix: Fix, ended_s: float, done_s: float) -> FixMessage:
        return fix_message(self.name, self.serial, fix, ended_s + self.unix_less_host_s, done_s - ended_s)


def fix_message(tag: str, serial: int, fix: Fix, unix_s: float, latency_s: float) -> FixMessage:
    """What a fix says on MQTT; ``unix_s`` is the end of its last frame."""
    dops = fix.dops
    moving = fix.velocity_mps is not None and fix.velocity_covariance is not None
    return FixMessage(
        tag=tag,
        serial=serial,
        unix_s=unix_s,
        time_s=fix.time_s,
        position_m=_vector(fix.position_m.tolist()),
        covariance_m2=_matrix(fix.covariance_m2.ravel().tolist()),
        velocity_mps=_vector(fix.velocity_mps.tolist()) if moving else None,  # type: ignore[union-attr]
        velocity_covariance=_matrix(fix.velocity_covariance.ravel().tolist()) if moving else None,  # type: ignore[union-attr]
        std_m=fix.std_m,
        gdop=dops.gdop,
        pdop=dops.pdop,
        hdop=dops.hdop,
        vdop=dops.vdop,
        anchors=fix.anchors,
        chi2=fix.chi2,
        dof=fix.dof,
        residual_rms_m=fix.residual_rms_m,
        method=fix.method,
        height_known=fix.height_known,
        latency_s=latency_s,
        hpl_m=fix.hpl_m,
        vpl_m=fix.vpl_m,
        integrity_risk=fix.integrity_risk,
        alert=None if fix.alert is None else fix.alert.value,
    )


def _vector(values: list[float]) -> Vector:
    x, y, z = values
    return x, y, z


def _matrix(values: list[float]) -> Matrix:
    xx, xy, xz, yx, yy, yz, zx, zy, zz = values
    return xx, xy, xz, yx, yy, yz, zx, zy, zz
