"""The checks of ``skyless doctor``: a host, its boards and their clocks."""

import ctypes
import getpass
import math
import os
import struct
import sys
import time
from collections import Counter
from collections.abc import Collection
from pathlib import Path
from typing import Final, Literal

from msgspec import Struct

from skyless.core.air.frame import Malformed, Reception
from skyless.core.any_receiver import decode_any
from skyless.core.site import NoiseSite
from skyless.core.tag.receiver import TagReceiver
from skyless.core.ticks import TICK_S, continued
from skyless.radio.interface import NOTABLE_SHARE, Gone, Hint, RadioEvent
from skyless.radio.serial.link import Hello
from skyless.radio.serial.serial_radio import SPOILT_SHARE, SerialRadio, spoilt_line
from skyless.run.mqtt.messages import FixMessage
from skyless.run.tag import TagNode, TagSettings

Result = Literal["failed", "warning", "not checked", "ok"]


class Check(Struct, frozen=True):
    """The result of one check."""

    name: str
    result: Result
    finding: str
    """One sentence."""
    advice: str = ""
    """Next step; empty if none is needed."""


def sentence(words: str) -> str:
    """Capitalise the first letter and add a full stop."""
    return f"{words[0].upper()}{words[1:]}."


def judged(name: str, value: float, warn: float, fail: float, finding: str, advice: str) -> Check:
    """Judge a value of which less is better; ``warn`` and ``fail`` are its limits."""
    result: Result = "failed" if value > fail else "warning" if value > warn else "ok"
    return Check(name, result, finding, "" if result == "ok" else advice)


def residuals_check(name: str, words: str, fixes: Collection[FixMessage]) -> Check:
    """Check that the residuals of fixes match the site's noise figures. ``words`` precede the finding."""
    ratio = sum(fix.chi2 for fix in fixes) / max(sum(fix.dof for fix in fixes), 1)
    finding = f"{words}; squared residuals are {ratio:.2f} of what the site's noise figures let expect."
    return judged(name, ratio, 2.0, 10.0, finding, "Survey the anchors again, and look for what stands in the way.")


# Stability of counters, from two counters' stamps of the same frames: a check of the site's noise figures.

_TIMES_S: Final = (0.5, 4.0)
_MIN_SAMPLES: Final = 30
_STEP_TICKS: Final = round(0.05 / TICK_S)
"""Shortest interval between a pair's stamps; others are ignored."""
_MAX_PAIRS: Final = 1000
_MAX_GAP_S: Final = 8.0  # half a turn of the counters
_TOO_NOISY: Final = 1.5
"""Limit for measured over assumed deviation. As pairs share counters, six anchors and 25 s give this ratio a standard
deviation of 0.15.
"""


class CounterPairs:
    """Stamps of frames by the counters of sender and receiver, for each pair of them."""

    def __init__(self) -> None:
        self._pairs: dict[tuple[str, int], list[tuple[int, int]]] = {}
        self._added_s: dict[tuple[str, int], float] = {}

    def add(self, receiver: str, sender: int, tx_ticks: int, rx_ticks: int, now_s: float) -> None:
        """Add a frame, in order of time. A pair starts again after a long gap or a restart of either counter."""
        pair = receiver, sender
        if pair not in self._pairs and len(self._pairs) >= _MAX_PAIRS:
            return
        stamps = self._pairs.setdefault(pair, [])
        gap_s, self._added_s[pair] = now_s - self._added_s.get(pair, now_s), now_s
        if gap_s > _MAX_GAP_S:
            stamps.clear()
        if stamps:
            last_tx, last_rx = stamps[-1]
            elapsed = (rx_ticks - last_rx) % (1 << 40)
            if elapsed < _STEP_TICKS:
                return
            sent_ticks = continued(tx_ticks, last_tx, elapsed)
            if sent_ticks is None:
                stamps.clear()
            else:
                tx_ticks, rx_ticks = sent_ticks, last_rx + elapsed
        stamps.append((tx_ticks, rx_ticks))

    def deviation(self, tau_s: float) -> tuple[float, int]:
        """Allan deviation of two counters against each other over all pairs, and the number of samples.

        From differences of mean frequencies over neighbouring times of at least ``tau_s``: σ² = ⟨(y₂ − y₁)²⟩ / 2.
        """
        total, count = 0.0, 0
        for stamps in self._pairs.values():
            start, before = stamps[0], None
            for stamp in stamps:
                elapsed = stamp[1] - start[1]
                if elapsed * TICK_S >= tau_s:
                    rate = (stamp[0] - start[0] - elapsed) / elapsed
                    if before is not None:
                        total, count = total + (rate - before) ** 2, count + 1
                    start, before = stamp, rate
        return (math.sqrt(total / (2.0 * count)) if count else math.nan), count


def assumed_deviation(noise: NoiseSite, tau_s: float) -> float:
    """Allan deviation of two counters that the site's filters assume, with stamps: σ² = 2·(w²/τ + r²·τ/3) + 3·s²/τ²."""
    stamp2 = (noise.tx_stamp_ps**2 + noise.rx_stamp_ps**2) * 1e-24
    crystals = noise.white_fm**2 / tau_s + noise.random_walk_fm**2 * tau_s / 3.0
    return math.sqrt(2.0 * crystals + 3.0 * stamp2 / tau_s**2)


def counters_check(pairs: CounterPairs, noise: NoiseSite, name: str) -> Check:
    """Check that the counters are as stable as the filters assume, over a short and a long time."""
    measured = [pairs.deviation(tau_s) for tau_s in _TIMES_S]
    samples = min(count for _, count in measured)
    if samples < _MIN_SAMPLES:
        finding = f"Too few stamps: {samples} samples of the {_MIN_SAMPLES} needed."
        return Check(name, "not checked", finding, "Listen for longer with --duration.")
    short, long_ = (one / assumed_deviation(noise, tau_s) for (one, _), tau_s in zip(measured, _TIMES_S, strict=True))
    finding = "Counters differ by {:.2f} of what the site's noise figures allow over {:g} s, and by {:.2f} over {:g} s."
    finding = finding.format(short, _TIMES_S[0], long_, _TIMES_S[1])
    if max(short, long_) <= _TOO_NOISY:
        return Check(name, "ok", finding)
    if long_ >= short:
        advice = f"Set random_walk_fm in [noise] of the site file to {noise.random_walk_fm * long_:.1g}"
    else:
        advice = f"Set tx_stamp_ps and rx_stamp_ps in [noise] of the site file {short:.1f} times as large"
    return Check(name, "warning", finding, f"{advice}, unless a board was moved or is warming up.")


class BoardProbe:
    """Listens with one board."""

    def __init__(self, radio: SerialRadio, site: int | None) -> None:
        """``site`` is the number of the site to listen to; None for the first that is heard."""
        self.radio = radio
        self._troubles: dict[str, None] = {}  # each once, in order
        self._hello: Hello | None = None
        self._spoilt_share = 0.0
        self._heard: Counter[int] = Counter()
        self._fixes: list[FixMessage] = []
        self._pairs = CounterPairs()
        self._node = TagNode(TagSettings(site=site), radio, self._fixes.append, lambda _: None, self._note)

    async def run(self) -> None:
        """Listen until cancelled."""
        await self.radio.run(self._on_event)

    def _on_event(self, event: RadioEvent) -> None:
        self._hello = self.radio.hello or self._hello
        self._spoilt_share = self.radio.spoilt_share or self._spoilt_share
        if isinstance(event, Gone | Hint):
            self._troubles[event.reason if isinstance(event, Gone) else event.text] = None
        self._node.on_event(event)

    def _note(self, _receiver: TagReceiver, reception: Reception) -> None:
        beacon = decode_any(reception.frame)
        if not isinstance(beacon, Malformed):
            self._heard[beacon.anchor] += 1
            self._pairs.add(self.radio.name, beacon.anchor, beacon.tx_ticks, reception.rx_ticks, time.monotonic())

    def checks(self, noise: NoiseSite) -> tuple[Check, ...]:
        """Evaluate what was received."""
        name, hello, troubles = f"board {self.radio.name}", self._hello, "; ".join(self._troubles)
        if hello is None:
            advice = (
                "See its cable, the path of its port, its baud rate (serial:PATH@BAUD), and whether it has firmware."
            )
            return (Check(name, "failed", sentence(troubles or "the port could not be opened yet"), advice),)
        version = ".".join(map(str, hello.firmware))
        abilities = "can send" if hello.can_transmit else "only listens"
        finding = f"Firmware {version}, version {hello.major}.{hello.minor} of the serial link; it {abilities}."
        spoilt = self._spoilt_share
        is_spoilt = spoilt >= NOTABLE_SHARE
        result: Result = "failed" if spoilt >= SPOILT_SHARE else "warning" if troubles or is_spoilt else "ok"
        board = Check(name, result, finding, troubles or (spoilt_line(self.radio.name, spoilt) if is_spoilt else ""))
        if is_spoilt:  # what the remaining frames seem to say of the site would be wrong
            return board, Check(f"{name}, reception", "not checked", "The line spoils too much.", "Fix the line first.")
        return board, self._reception(f"{name}, reception"), counters_check(self._pairs, noise, f"{name}, clock")

    def _reception(self, name: str) -> Check:
        if not self._heard:
            advice = "See whether anchors of the site are on the air, and the board's antenna is free."
            return Check(name, "failed", "It has received no beacon.", advice)
        drops = sum(self._node.drops.values())
        finding = f"{sum(self._heard.values())} beacons of {len(self._heard)} anchors, {drops} frames dropped"
        if not self._fixes:
            finding = f"{finding}, no fix: {self._node.reason}."
            return Check(name, "warning", finding, "Listen for longer, or elsewhere.")
        return residuals_check(name, f"{finding}, {len(self._fixes)} fixes", self._fixes)


_PORTS: Final = ("ttyACM*", "ttyUSB*")
_TIMEX: Final = "@Illl"
"""First fields of Linux's ``struct timex``: modes, offset, freq, maxerror."""
_TIME_ERROR: Final = 5


def port_checks(devices: Path = Path("/dev")) -> tuple[Check, ...]:
    """Check which serial ports exist, and whether this user may open them."""
    ports = [port for pattern in _PORTS for port in sorted(devices.glob(pattern))]
    if not ports:
        finding = "There is no serial port (ttyACM*, ttyUSB*) on this computer."
        return (Check("serial ports", "not checked", finding, "Plug a board in, if this computer should have one."),)
    return tuple(_port(port) for port in ports)


def _port(port: Path) -> Check:
    if os.access(port, os.R_OK | os.W_OK):
        return Check(f"port {port.name}", "ok", f"{port} may be opened.")
    try:
        group, user = port.group(), getpass.getuser()
    except (OSError, KeyError):
        group, user = "dialout", "USER"
    advice = f"Type: sudo usermod -aG {group} {user}; then log in again."
    return Check(f"port {port.name}", "failed", f"{port} may not be opened by this user.", advice)


def clock_check() -> Check:
    """Check whether the system reports that its clock is being synchronised (``adjtimex``)."""
    if not sys.platform.startswith("linux"):
        return Check("clock", "not checked", "This system does not say whether its clock is synchronised.")
    timex = ctypes.create_string_buffer(512)  # more than it has
    state = ctypes.CDLL(None, use_errno=True).adjtimex(timex)
    if state < 0:
        return Check("clock", "not checked", f"adjtimex: {os.strerror(ctypes.get_errno())}.")
    if state == _TIME_ERROR:
        advice = "Start NTP or chrony: timedatectl set-ntp true. In a container the host's clock counts."
        return Check("clock", "warning", "The system says that nothing synchronises its clock.", advice)
    _, _, _, max_error_us = struct.unpack_from(_TIMEX, timex)
    finding = f"The clock is synchronised; the system states an error of at most {max_error_us * 1e-3:.1f} ms."
    return Check("clock", "ok", finding)
