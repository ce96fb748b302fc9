"""What the demo shows of alerts: a line that is always there for methods that give any, and counts at the end."""

import asyncio
import time
from types import SimpleNamespace

import msgspec
import pytest
from rich.console import Console

from skyless.cli.nodes.demo import ALERT_SHOWN_S, MAX_ALERTS, Screen, _either
from skyless.cli.watch import Watch
from skyless.core.integrity import Alert
from skyless.run.mqtt.messages import AnchorHealth, Counters, FixMessage, TagHealth

UNIT = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


class NoLink:
    def subscribe(self, topic, handler, qos=0):
        pass


@pytest.fixture
def stage():
    """A screen, and the watch that it shows: six anchors, of which the last has stopped."""
    watch = Watch(NoLink(), 7, planar=True)
    for number in range(1, 7):
        unix_s = time.time() - (60.0 if number == 6 else 0.0)
        watch._on_anchor(
            AnchorHealth(
                number, unix_s, 1.0, "anchor", 1, 0, True, 0.0, 0.0, 0.0, 1, 0, 1, 1, {}, {}, Counters(0, 0, 0)
            )
        )
    whole = SimpleNamespace(watch=watch, page="http://here", address=None, children=[])
    return Screen(whole, show=False), watch


def fix(tag, alert, anchors=(1, 2, 3, 4, 5)):
    made = FixMessage(
        tag, 1, time.time(), 0.0, (1.0, 2.0, 0.0), UNIT, None, None, 0.1, None, None, None, None, anchors, 0.0, 2, 0.0,
        "joint", True, 1e-3,
    )  # fmt: skip
    return msgspec.structs.replace(made, alert=alert)


def drawn(screen):
    """The line on a terminal of 80 columns."""
    console = Console(width=80, record=True, file=open("/dev/null", "w"))  # noqa: SIM115, PTH123
    for part in screen.alerts():
        console.print(part)
    return " ".join(console.export_text().split())


def test_methods_without_alerts_have_no_line(stage):
    screen, watch = stage
    watch._on_fix(fix("t1", None))
    assert screen.alerts() == []
    assert screen.summary()["alerts"] == {}
    assert "alerts" not in screen.closing()


def test_words_that_are_no_alerts_are_not_shown(stage):
    screen, watch = stage
    watch._on_fix(fix("t1", "none"))
    watch._on_fix(fix("t1", "\x1b[2Jboo"))
    assert drawn(screen) == "alerts: none now; none so far"


def test_the_line_is_there_before_there_is_an_alert_so_that_tables_do_not_jump(stage):
    screen, watch = stage
    watch._on_fix(fix("t1", "none"))
    assert drawn(screen) == "alerts: none now; none so far"


def test_alerts_of_the_newest_fixes_are_named_with_the_anchors_left_out_and_all_are_counted(stage):
    screen, watch = stage
    for _ in range(3):
        watch._on_fix(fix("t1", "unavailable"))
    watch.tags["t1"].alerted_s -= ALERT_SHOWN_S
    watch._on_fix(fix("t1", "none"))
    watch._on_fix(fix("t2", "detected-excluded", (1, 2, 3, 5)))
    watch._on_fix(fix("t2", "none"))  # it comes and goes with each message of the anchor
    assert drawn(screen) == (
        "alerts: t2 detected-excluded (without 4), 1 of 2 tags now; so far detected-excluded 1, unavailable 3"
    )
    watch.tags["t2"].alerted_s -= ALERT_SHOWN_S
    assert drawn(screen) == "alerts: none now; so far detected-excluded 1, unavailable 3"
    assert screen.summary()["alerts"] == {"detected-excluded": 1, "none": 2, "unavailable": 3}


@pytest.mark.parametrize("alert", [alert.value for alert in Alert if alert is not Alert.NONE])
def test_many_alerts_take_no_more_than_four_lines(stage, alert):
    screen, watch = stage
    for number in range(200):
        watch._on_fix(fix(f"t{number}", alert, (1, 2)))
    console = Console(width=80, record=True, file=open("/dev/null", "w"))  # noqa: SIM115, PTH123
    console.print(*screen.alerts())
    text = console.export_text()
    assert text.count(alert) == MAX_ALERTS + 1
    assert "200 of 200 tags now" in " ".join(text.split())
    assert text.count("\n") <= 4


def synchronisation(stage, **fields):
    """The table of anchors, all of which have these fields."""
    screen, watch = stage
    for number, health in list(watch.anchors.items()):
        watch.anchors[number] = msgspec.structs.replace(health, **fields)
    console = Console(width=100, record=True, file=open("/dev/null", "w"))  # noqa: SIM115, PTH123
    console.print(screen._anchors())
    return console.export_text()


def test_the_table_shows_clocks_where_there_is_a_master(stage):
    assert "clock sigma" in synchronisation(stage)
    text = synchronisation(stage, mode="free", master=None, term=None, rate_ppm=None)
    assert not any(word in text for word in ("rate ppm", "clock sigma"))


def test_an_anchor_that_has_stopped_has_no_role(stage):
    rows = {row.split()[1]: row.split()[3] for row in synchronisation(stage).splitlines() if row.startswith("│")}
    assert rows == {"1": "anchor", "2": "anchor", "3": "anchor", "4": "anchor", "5": "anchor", "6": "offline"}


def test_updates_per_second_of_a_tag_that_was_restarted(stage):
    _, watch = stage
    watch._on_fix(fix("t1", None))
    for unix_s, fixes in ((0.0, 10), (1.0, 510), (2.0, 300), (3.0, 800)):
        health = TagHealth(
            "t1", unix_s, unix_s, "joint", 0, fixes, 0.0, None, 0.1, None, None, {}, Counters(0, 0, 0), 0.0, 0, ()
        )
        watch._on_tag(health)
    assert watch.tags["t1"].updates_per_s == 500.0


def late_health(**counters):
    return TagHealth("t1", 1.0, 1.0, "joint", 0, 9, 9.0, None, 0.1, None, None, counters, Counters(0, 0, 0), 0.0, 0, ())


def test_what_was_too_old_is_named_where_there_was_any(stage):
    screen, watch = stage
    watch._on_fix(fix("t1", None))
    watch._on_tag(late_health(malformed=4))
    assert (screen.summary()["late_receptions"], screen.summary()["late_fixes"]) == (0, 0)
    assert "too slow" not in screen.closing() + screen._line()
    watch._on_tag(late_health(**{"late-reception": 250, "late-fix": 3, "malformed": 4}))
    assert (screen.summary()["late_receptions"], screen.summary()["late_fixes"]) == (250, 3)
    for text in (screen.closing(), screen._line()):
        assert "this computer is too slow: 250 receptions dropped and 3 fixes withheld as too old" in text


def test_a_part_of_the_demo_that_fails_ends_it():
    async def fail():
        raise RuntimeError("the part")

    async def run():
        site = asyncio.ensure_future(asyncio.sleep(60.0))
        try:
            await _either(site, fail())
        finally:
            site.cancel()

    with pytest.raises(RuntimeError, match="the part"):
        asyncio.run(run())
