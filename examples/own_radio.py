"""A radio of your own: six anchors broadcast, a tag listens, and prints where it is.

`Anchor` and `Receiver` know no hardware. A program that drives any radio hands them the frames it receives with the
stamps of the radio's own 40-bit counter, and asks an anchor when its next frame is due. `OwnRadio` stands for your
hardware: a counter that nobody has set, and a position from which light takes its time. Replace its two methods by
your driver's, and `main` by your event loop. Programs that are to run as `skyless anchor` and `skyless tag` implement
`skyless.radio.interface.Radio` instead, which adds what a running site needs: restarts, lost connections, MQTT.
"""

import random
from math import dist

from skyless import Anchor, Receiver, Reception, lab_site
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_RATE_HZ, difference, wrap

STAMP_NOISE_S = 100e-12
"""A DW1000's stamps scatter by about as much."""
ASK_EVERY_S = 5e-3
"""An anchor is asked for its next transmission at least this often, also while it does not send."""


class OwnRadio:
    """Here simulated: a counter with its own beginning and rate, at a position in metres."""

    def __init__(self, position_m: tuple[float, float, float], draw: random.Random) -> None:
        self.position_m = position_m
        self._draw = draw
        self._start_ticks = draw.randrange(1 << 40)
        self._rate_hz = TICK_RATE_HZ * (1.0 + draw.uniform(-10e-6, 10e-6))

    def ticks(self, true_s: float) -> int:
        """What the counter shows, 40 bits. Your radio: its counter now."""
        return wrap(self._start_ticks + round(true_s * self._rate_hz))

    def due_s(self, tx_ticks: int, now_s: float) -> float:
        """When the counter will show ``tx_ticks``. Your radio waits for that by itself: a delayed transmission."""
        return now_s + difference(tx_ticks, self.ticks(now_s)) / self._rate_hz

    def reception(self, frame: bytes, sender: "OwnRadio", sent_s: float) -> Reception:
        """The frame of another radio with the own stamp. Your radio: what its interrupt gives."""
        flight_s = dist(self.position_m, sender.position_m) / SPEED_OF_LIGHT_MPS
        return Reception(frame, self.ticks(sent_s + flight_s + self._draw.gauss(0.0, STAMP_NOISE_S)))


def main() -> None:
    """Run six anchors and a tag for two seconds of true time."""
    draw, site = random.Random(7), lab_site()
    anchors = [(Anchor(site, one.id), OwnRadio((one.x_m, one.y_m, one.z_m), draw)) for one in site.anchors]
    tag, tag_radio = Receiver(), OwnRadio((2.0, 3.0, 0.0), draw)
    now_s, fix = 0.0, None
    while now_s < 2.0:
        asked = [machine.next_transmission_ticks(radio.ticks(now_s)) for machine, radio in anchors]
        due = [(anchors[i][1].due_s(ticks, now_s), i, ticks) for i, ticks in enumerate(asked) if ticks is not None]
        if not due or min(due)[0] > now_s + ASK_EVERY_S:
            now_s += ASK_EVERY_S
            continue
        now_s, sender, tx_ticks = min(due)
        machine, radio = anchors[sender]
        frame = machine.transmission(tx_ticks).frame  # made as late as possible, so that it holds the newest stamps
        for other, its_radio in anchors:
            if other is not machine:
                other.hear(its_radio.reception(frame, radio, now_s))
        fix = tag.hear(tag_radio.reception(frame, radio, now_s)) or fix
    if fix is None:
        print(f"no fix: {tag.reason}")
    else:
        x_m, y_m, _ = fix.position_m
        print(f"the tag is at ({x_m:.3f}, {y_m:.3f}) m, standard deviation {100 * fix.std_m:.1f} cm")


if __name__ == "__main__":
    main()
