"""Alarms of a simulated site (``tests/run/alarm_world.py``): missed, twice, without a cause; how late; their cost.

    python benchmarks/alarms.py [--seconds 1400] [--seed 1]

Then the same with a page's server that is killed at random moments, and the processor time of a fix.
"""

import argparse
import random
import sys
import time
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "tests" / "run"))

import alarm_world as world
from msgspec.structs import replace

from skyless.core.site import AlarmRule


def cost_us(tags: int = 500, hz: float = 20.0, seconds: float = 10.0) -> float:
    """Microseconds of CPU that the engine takes for each fix, with rules of all kinds, tags 2 m apart."""
    server = world.Server({}, 0.0)
    rules = (
        *world.RULES,
        AlarmRule("level", "protection-level", limit=1.0),
        AlarmRule("all", "near", limit=1.9),
        AlarmRule("quiet", "silent", after_s=5.0),
    )
    server.engine.set_rules(rules)
    rng = random.Random(1)
    fixes = [
        world.fix_of(f"t{k}", world.UNIX_S, 2.0 * (k % 25) + rng.gauss(0, 0.02), 2.0 * (k // 25)) for k in range(tags)
    ]
    begin_s = time.process_time()
    for step in range(int(seconds * hz)):
        at_s = step / hz
        for fix in fixes:
            server.table.add_fix(replace(fix, unix_s=world.UNIX_S + at_s), at_s)
            server.engine.on_fix(fix.tag)
        server.engine.tick(at_s, world.UNIX_S + at_s)
    return (time.process_time() - begin_s) / (seconds * hz * tags) * 1e6


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=1400.0)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    made = world.World(asked.seconds, asked.seed)
    published, *_ = world.run(made, asked.seed)
    counts, late_s = world.judge(made, published)
    print(f"{len(made.fixes)} simulated fixes in {asked.seconds:g} s: {dict(counts)}")
    late_s = {**late_s, "all": [late for some in late_s.values() for late in some]}
    for rule, values in late_s.items():
        p50_s, p99_s = (world.percentile(values, share) for share in (0.5, 0.99))
        print(f"  {rule}: {len(values)} alarms, late by p50 {p50_s:.2f}, p99 {p99_s:.2f}, at most {max(values):.2f} s")
    published, acknowledged, down, kept = world.run(made, asked.seed, kill_every_s=15.0)
    counts, _ = world.judge(made, published, slack_s=9.0)
    lost = len(world.lost(published, acknowledged, kept))
    print(f"killed {len(down)} times: {counts['twice']} raised twice, {lost} of {len(acknowledged)} acknowledged lost")
    print(f"  {counts['missed']} of {counts['expected']} not raised, as no server ran or an earlier one had not ended")
    fast, slow = cost_us(seconds=asked.seconds / 140.0), cost_us(hz=1.0, seconds=max(asked.seconds / 24.0, 1.0))
    print(f"cost: {fast:.2f} us of CPU a fix (500 tags at 20 Hz), {slow:.2f} us (at 1 Hz)")


if __name__ == "__main__":
    main()
