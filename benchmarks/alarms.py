"""What alarms cost of the processor: ``python benchmarks/alarms.py [--seconds 10]``.

Whether they are missed, raised twice, without a cause or late is judged by ``tests/run/test_alarm_world.py``.
"""

import argparse
import random
import sys
import time
from pathlib import Path

sys.path.extend(str(Path(__file__).parents[1] / "tests" / folder) for folder in (".", "run"))

from alarm_site import Site
from test_alarm_world import RULES

from skyless.core.site import AlarmRule


def cost_us(seconds: float, hz: float, tags: int = 500) -> float:
    """Microseconds of CPU for each fix, its zones included, with rules of all kinds and tags 2 m apart."""
    more = (
        AlarmRule("level", "protection-level", limit=1.0),
        AlarmRule("all", "near", limit=1.9),
        AlarmRule("quiet", "silent", after_s=5.0),
    )
    site, rng = Site(*RULES, *more), random.Random(1)
    places = {f"t{k}": (2.0 * (k % 25) + rng.gauss(0, 0.02), 2.0 * (k // 25), 1.0) for k in range(tags)}
    steps = max(1, round(seconds * hz))
    begin_s = time.process_time()
    for _ in range(steps):
        site.now_s += 1.0 / hz
        for tag, place in places.items():
            site.send(tag, place)
        site.tick()
    return (time.process_time() - begin_s) / (steps * tags) * 1e6


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0)
    asked = parser.parse_args()
    fast, slow = cost_us(asked.seconds, 20.0), cost_us(6.0 * asked.seconds, 1.0)
    print(f"cost: {fast:.2f} us of CPU a fix (500 tags at 20 Hz), {slow:.2f} us (at 1 Hz)")


if __name__ == "__main__":
    main()
