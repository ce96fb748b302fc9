"""``benchmarks/alarms.py`` in short: no alarm missed, raised twice or without a cause, nothing acknowledged lost."""

import math

import pytest

import alarms


@pytest.mark.parametrize("seed", [1, 2])
def test_every_crossing_silence_and_contact_is_raised_once_and_soon(seed, monkeypatch):
    monkeypatch.setattr(alarms, "COUNT", 6)
    monkeypatch.setattr(alarms, "RULES", tuple(_of_six(rule) for rule in alarms.RULES))
    world = alarms.World(100.0, seed)
    published, *_ = alarms.run(world, seed)
    counts, late_s = alarms.judge(world, published)
    assert counts["expected"] > 150
    assert (counts["missed"], counts["twice"], counts["without a cause"]) == (0, 0, 0)
    every = [value for values in late_s.values() for value in values]
    assert alarms.percentile(every, 0.99) <= 1.0


@pytest.mark.parametrize("seed", range(3))
def test_a_server_killed_at_random_raises_nothing_twice_and_loses_no_acknowledgement(seed, monkeypatch):
    monkeypatch.setattr(alarms, "COUNT", 4)
    world = alarms.World(100.0, seed)
    published, acknowledged, down, kept = alarms.run(world, seed, kill_every_s=5.0)
    counts, _ = alarms.judge(world, published, slack_s=9.0)
    assert len(down) > 3
    assert len(acknowledged) > 30
    assert counts["twice"] == 0
    assert alarms.lost(published, acknowledged, kept) == []
    assert math.isfinite(down[-1][1])


def _of_six(rule):
    return alarms.AlarmRule(**{key: getattr(rule, key) for key in rule.__struct_fields__} | {"tags": rule.tags[:6]})
