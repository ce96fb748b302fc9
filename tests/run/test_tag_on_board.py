"""``skyless tag --from-board``: what a board has computed reaches a broker's readers as any tag's fixes do."""

import asyncio
import json

import pytest
from serial_stage import ComputingBoard

from skyless.radio.serial import link as serial_link
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import FixMessage, TagHealth
from skyless.run.mqtt.topics import fix_topic, health_topic
from skyless.run.process import reader as read_messages
from support.board_tag import ANCHORS, StatusInC, fix_in_c
from support.mqtt_brokers import Embedded
from support.processes import SKYLESS, running_program
from support.waiting import running, until

pytestmark = pytest.mark.site

SITE = 3
"""As of ``support.board_tag``."""


async def test_fixes_states_and_alerts_of_a_board_are_published_and_written_as_lines(tmp_path):
    broker, fixes, healths = Embedded(tmp_path), [], []
    await broker.start()
    reader = Link(broker.address, "reader", site=SITE, kind="test")
    for topic, kind, found in (
        (fix_topic(SITE, "t1"), FixMessage, fixes),
        (health_topic(SITE, "tag", "t1"), TagHealth, healths),
    ):
        reader.subscribe(topic, read_messages(kind, found.append, int))
    try:
        async with running(reader.run()), ComputingBoard() as board:
            command = ("tag", "t1", "--radio", f"serial:{board.pty.name}", "--from-board", "--json", "--mqtt")
            pipe = {"stdout": asyncio.subprocess.PIPE}
            async with running_program(*SKYLESS, *command, str(broker.address), **pipe) as process:
                await until(lambda: reader.connected and board.tag.is_on, 60.0)
                board.report_all()
                await until(lambda: healths, 60.0)  # the link is made with the tag's site
                board.report(serial_link.FIX, fix_in_c(levels=2, is_verified=True).sent())
                board.report(serial_link.TAG_STATUS, bytes(StatusInC(SITE, 5, 0, 200, 150, 7, 2, 9)))
                await until(lambda: fixes and fixes[-1].alert == "detected-not-excluded")
                await until(lambda: healths[-1].fixes == 2 and healths[-1].counters)
                lines = [json.loads(await process.stdout.readline()) for _ in range(2)]
    finally:
        await broker.stop()
    fix, health = fixes[-1], healths[-1]
    assert [line["alert"] for line in lines] == ["none", "detected-not-excluded"]
    assert lines[0]["position_m"] == [4.0, 3.0, 1.2]
    assert lines[0]["hpl_m"] == pytest.approx(0.12)
    assert 0.0 < fix.gdop < 10.0
    assert (fix.anchors, fix.hpl_m) == (tuple(number for number, _ in ANCHORS), None)
    assert fix.latency_s == pytest.approx(0.00197)
    assert (fix.verified_until_s, fix.unverified) == (fix.time_s, 0.0)
    assert (health.method, health.fixes, health.receptions) == ("joint", 2, 218)
    counters = {name: count for name, count in health.counters.items() if name != "late-fix"}  # on a busy machine
    assert counters == {"overload": 7, "overload-superframe": 2, "dropped-on-board": 9}


@pytest.mark.parametrize(
    ("words", "right"),
    [
        (["--radio", "listener:/dev/a"], "with --from-board it should be a board, serial:PATH"),
        (["--radio", "serial:/dev/a", "--site-id", "5"], "--site-id is 5; it should be left out: the board computes"),
        (["--radio", "serial:/dev/a", "--site-id", "4"], "with the settings of skyless flash-config"),
    ],
)
def test_what_makes_no_sense_with_a_board_that_computes_is_refused(words, right, complaint):
    assert right in complaint("tag", "t1", "--from-board", "--mqtt", "none", *words)
