"""A simulated site: no alarm missed, raised twice or without a cause, nothing acknowledged lost."""

import math

import alarm_world
import pytest
from msgspec.structs import replace


@pytest.mark.parametrize("seed", [1])
def test_every_crossing_silence_and_contact_is_raised_once_and_soon(seed, monkeypatch):
    monkeypatch.setattr(alarm_world, "COUNT", 6)
    monkeypatch.setattr(alarm_world, "RULES", tuple(replace(one, tags=one.tags[:6]) for one in alarm_world.RULES))
    world = alarm_world.World(100.0, seed)
    published, *_ = alarm_world.run(world, seed)
    counts, late_s = alarm_world.judge(world, published)
    assert counts["expected"] > 150
    assert (counts["missed"], counts["twice"], counts["without a cause"]) == (0, 0, 0)
    every = [value for values in late_s.values() for value in values]
    assert alarm_world.percentile(every, 0.99) <= 1.0


@pytest.mark.parametrize("seed", range(2))
def test_a_server_killed_at_random_raises_nothing_twice_and_loses_no_acknowledgement(seed, monkeypatch):
    monkeypatch.setattr(alarm_world, "COUNT", 4)
    world = alarm_world.World(100.0, seed)
    published, acknowledged, down, kept = alarm_world.run(world, seed, kill_every_s=5.0)
    counts, _ = alarm_world.judge(world, published, slack_s=9.0)
    assert len(down) > 3
    assert len(acknowledged) > 30
    assert counts["twice"] == 0
    assert alarm_world.lost(published, acknowledged, kept) == []
    assert math.isfinite(down[-1][1])
