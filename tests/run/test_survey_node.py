"""The survey program without processes: stamps in, results out, a site file written, the watch begun."""

import asyncio
import json
import math
from functools import cache
from types import SimpleNamespace

import msgspec
import pytest
from msgspec.structs import replace
from node_stage import FakeLink

from skyless.core.air.beacon import decode
from skyless.core.any_anchor import new_anchor
from skyless.core.errors import SkylessError
from skyless.core.site import FloorPlanSite, ScheduleSite, UnplacedAnchor, site_digest
from skyless.run.anchor import StampLog
from skyless.run.mqtt import messages as mqtt
from skyless.run.mqtt import topics
from skyless.run.mqtt.address import MqttAddress
from skyless.run.survey import program as program_module
from skyless.run.survey.program import ADOPTION_S, NO_DATA_S, FindingsLog, LiveSurvey, SurveyNode, SurveySettings
from skyless.sim.impairments import AnchorDisplacement, CarrierModel, DelayError, lab_impairments
from skyless.sim.lab import lab_site
from skyless.sim.world import World
from skyless.site.file.check import image_size
from skyless.site.file.load import load_site
from skyless.site.survey.facts import Facts, Gauge, PairRanges, Survey, SurveyedAnchor, Tape
from skyless.site.survey.surveyed_site import FloorImage, is_record_of, read_record, record_path, save_survey
from support.full_disk import full_disk
from support.waiting import running

pytestmark = pytest.mark.site

POSITIONS_M = {1: (0.0, 0.0), 2: (6.0, 0.0), 3: (6.5, 4.0), 4: (6.0, 8.0), 5: (0.0, 8.0), 6: (-1.0, 3.5)}
SCHEDULE = ScheduleSite(mode="free")
SITE = replace(
    lab_site(),
    anchors=tuple(replace(one, x_m=POSITIONS_M[one.id][0], y_m=POSITIONS_M[one.id][1]) for one in lab_site().anchors),
    schedule=SCHEDULE,
)
FRESH = replace(SITE, anchors=(), unplaced=tuple(UnplacedAnchor(one.id) for one in SITE.anchors))
TEXT = "\n".join(
    ['name = "lab"', "id = 1", "[tags]", "height_m = 0.0", "[schedule]", 'mode = "free"']
    + [line for one in SITE.anchors for line in ("[[anchors]]", f"id = {one.id}")]
)
DELAY_TICKS = {anchor: 20 * anchor - 60 for anchor in POSITIONS_M}
PNG = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR" + (640).to_bytes(4, "big") + (480).to_bytes(4, "big")
BEGIN_S = 5000.0


class Collecting:
    """An anchor's machine that keeps the stamps of what it receives, as the anchor's program does."""

    def __init__(self, anchor, site):
        self.machine, self.log = new_anchor(site, anchor), StampLog(anchor, "run1")
        self.id, self.next_transmission_ticks = anchor, self.machine.next_transmission_ticks
        self.transmission = self.machine.transmission
        self.log.request(mqtt.RequestMessage("test", (), 60.0, True), 0.0)

    def hear(self, reception):
        self.machine.hear(reception)
        beacon = decode(reception.frame)
        self.log.add(beacon.anchor, beacon.tx_ticks, reception.rx_ticks, reception.carrier_phase_cycles)


def published(until_s, known=FRESH, **impairments):
    """What the anchors publish, which know this site: times since the beginning, and messages."""
    machines = {}

    def make(anchor):
        return machines.setdefault(anchor, Collecting(anchor, known))

    world = World(SITE, make, [], replace(lab_impairments(100.0), **impairments), 3)
    for _ in world.run(until_s):
        for machine in machines.values():
            message = machine.log.collect(world.now_s, 1e9 + 1000.0 * machine.id + world.now_s)  # hosts' clocks differ
            if message is not None:
                yield world.now_s, message


@cache
def messages():
    """Of anchors with delays, in 12 s."""
    errors = tuple(DelayError(anchor, float(ticks)) for anchor, ticks in DELAY_TICKS.items())
    return tuple(published(12.0, delay_errors=errors))


def live_after(seconds, site=FRESH, facts=None, **options):
    live = LiveSurvey(site, facts or Facts(), **options)
    for t_s, message in messages():
        if t_s <= seconds:
            live.add_stamps(message, BEGIN_S + t_s)
    return live


def true_survey(anchors=tuple(POSITIONS_M)):
    """What a right survey finds."""
    found = tuple(
        SurveyedAnchor(
            one, True, *POSITIONS_M[one], 0.0, 0.01, delay_m=DELAY_TICKS[one] * 0.00469176 / 2.0, delay_std_m=0.01
        )
        if one in anchors
        else SurveyedAnchor(one, False, reason="too few ranges")
        for one in POSITIONS_M
    )
    return Survey(found, (), 0.03, 3, None, (), (), (), "true", None, ())


@pytest.fixture
def file(tmp_path):
    file = tmp_path / "lab.toml"
    file.write_text(TEXT, encoding="utf-8")
    return file


@pytest.mark.statistical
def test_ranges_come_of_the_stamps_that_anchors_publish():
    live = live_after(6.0)
    ranges = live.ranges()
    assert ranges.anchors == tuple(POSITIONS_M)
    assert len(ranges.pairs) == 15
    for pair in ranges.pairs:
        (xa, ya), (xb, yb) = POSITIONS_M[pair.a], POSITIONS_M[pair.b]
        expected_m = ((xa - xb) ** 2 + (ya - yb) ** 2) ** 0.5
        expected_m += (DELAY_TICKS[pair.a] + DELAY_TICKS[pair.b]) * 0.00469176 / 2.0
        std_m = (pair.std_m**2 + ranges.tx_std_m[pair.a] ** 2 + ranges.tx_std_m[pair.b] ** 2) ** 0.5
        assert abs(pair.range_m - expected_m) < 5.0 * std_m
        assert std_m < 0.003  # 3 cm in each of 300 superframes, as docs/survey.md says
    message = live.message(BEGIN_S + 6.0, 0.0, None)
    assert (message.anchors, message.missing) == (tuple(POSITIONS_M), ())
    assert message.state == "collecting"


def test_what_does_not_come_any_more_is_visible():
    live = live_after(3.0)
    live.add_result(true_survey(), live.ranges())
    assert live.message(BEGIN_S + 4.0, 0.0, None).state == "surveyed"
    message = live.message(BEGIN_S + 3.0 + NO_DATA_S + 1.0, 0.0, None)
    assert message.state == "no data"
    assert message.error == "no stamps have come from the anchors for 6 s"
    assert message.survey is not None
    assert live.message(BEGIN_S + 60.0, 0.0, None).missing == tuple(POSITIONS_M)
    assert LiveSurvey(FRESH, Facts()).message(0.0, 0.0, None).error == "no stamps have come from the anchors yet"


def test_stamps_of_strangers_are_dropped_and_a_restarted_counter_harms_no_range():
    live = LiveSurvey(FRESH, Facts())
    stranger = mqtt.StampsMessage(99, "x", 0.0, ((1, 5, 5),))
    for t_s, message in messages():
        shifted = tuple(replace(one, rx_ticks=(one.rx_ticks + 2**38) % 2**40) for one in message.stamps)
        restarted = message.anchor == 2 and t_s > 3.0
        live.add_stamps(stranger, BEGIN_S + t_s)
        if t_s > 6.0:
            break
        if not restarted:
            live.add_stamps(message, BEGIN_S + t_s)
        elif t_s > 3.5:  # its own stamps are of another counter; the others' of it would be as well: they miss it
            live.add_stamps(replace(message, run="run2", stamps=shifted), BEGIN_S + t_s)
    for pair in live.ranges().pairs:
        (xa, ya), (xb, yb) = POSITIONS_M[pair.a], POSITIONS_M[pair.b]
        assert abs(pair.range_m - ((xa - xb) ** 2 + (ya - yb) ** 2) ** 0.5) < 0.6


class Stage:
    """The program with a fake link, a clock that the test sets, and a solver that knows the truth."""

    def __init__(self, monkeypatch, **settings):
        self.now_s, self.said, self.asked = BEGIN_S, [], []
        monkeypatch.setattr(program_module, "Link", FakeLink)
        monkeypatch.setattr(program_module, "time", SimpleNamespace(monotonic=lambda: self.now_s, time=lambda: 1e9))
        monkeypatch.setattr(program_module, "run_survey", self.solve)
        self.found = true_survey()
        self.node = SurveyNode(
            SurveySettings(1, **settings), lambda _: Facts(), MqttAddress("127.0.0.1", 1), self.said.append
        )
        self.link = self.node.link

    def solve(self, ranges, facts):
        self.asked.append((ranges, facts))
        if isinstance(self.found, Exception):
            raise self.found
        return self.found

    async def play(self, from_s=0.0, until_s=4.0):
        """What anchors publish in this time, and the program's work."""
        next_s = from_s
        for t_s, message in messages():
            if from_s < t_s <= until_s:
                self.now_s = BEGIN_S + t_s
                self.link.receive(topics.stamps_topic(1, "+"), message)
                if t_s >= next_s + 1.0:
                    next_s = t_s
                    await self.step()

    async def step(self):
        """Twice, so that a result that is begun is published, too."""
        self.node.update()
        for task in (self.node._solving, self.node._watching):
            if task is not None:
                await task
        self.now_s += 0.001


async def test_results_are_published_and_saved_and_anchors_get_their_placement(monkeypatch, tmp_path, file):
    site = load_site(file)
    stage = Stage(monkeypatch, site=site, file=file)
    facts = Facts(gauge=Gauge(1, 2, 4))
    plan = FloorPlanSite("", 12.0, -1.0, -2.0)
    stage.link.receive(topics.survey_facts_topic(1), mqtt.SurveyFactsMessage(facts, plan, "page"))
    stage.link.handlers[topics.floor_plan_topic(1)]("", PNG)
    await stage.play()
    message = stage.link.newest(mqtt.SurveyMessage)
    assert message.survey == true_survey()
    assert message.facts == facts
    assert message.file == str(file)
    assert stage.link.newest(mqtt.WatchMessage) is None  # anchors have no positions yet
    stage.link.receive(topics.site_topic(1), mqtt.SiteMessage(site, True, 0.0))
    stage.link.receive(topics.survey_save_topic(1), mqtt.SurveySaveMessage("page", message.serial))
    assert stage.link.newest(mqtt.SurveyMessage).error is None
    assert stage.link.newest(mqtt.SurveyMessage).saved_serial == message.serial

    saved, placement = load_site(file), stage.link.newest(mqtt.PlacementMessage)
    assert placement.site == saved
    assert placement.before == site_digest(site)
    assert [(one.x_m, one.y_m) for one in saved.anchors] == list(POSITIONS_M.values())
    usual = FRESH.unplaced[0].tx_antenna_delay_ticks
    assert [one.tx_antenna_delay_ticks - usual for one in saved.anchors] == list(DELAY_TICKS.values())
    assert (tmp_path / "lab.before-survey-1.toml").read_text(encoding="utf-8") == TEXT
    assert (tmp_path / saved.floor_plan.image).read_bytes() == PNG
    assert image_size(PNG) is not None
    assert (saved.floor_plan.width_m, saved.floor_plan.x_m, saved.floor_plan.y_m) == (12.0, -1.0, -2.0)
    record = read_record(record_path(file))
    assert is_record_of(record, saved)
    assert record.delay_changes_ticks == DELAY_TICKS

    # stamps from while anchors adopt it are not used; then the watch has all pairs
    count = len(stage.asked)
    await stage.play(4.0, 4.0 + 0.9 * ADOPTION_S)
    assert len(stage.asked) == count
    assert stage.node.live.ranges().pairs == ()
    await stage.play(6.0, 8.0)
    assert len(stage.asked) > count
    assert stage.link.newest(mqtt.WatchMessage).findings == ()


async def test_a_second_survey_names_the_sites_before_it(monkeypatch):
    stage = Stage(monkeypatch, site=SITE)
    first = replace(SITE, anchors=(replace(SITE.anchors[0], x_m=0.5), *SITE.anchors[1:]))
    stage.link.receive(topics.placement_topic(1), mqtt.PlacementMessage(0.0, site_digest(first), SITE, ("ab",)))
    await stage.play()
    stage.node.save()
    placement = stage.link.newest(mqtt.PlacementMessage)
    assert placement.before == site_digest(SITE)
    assert placement.earlier == (site_digest(first), "ab")
    assert stage.node.saved.written == ()  # there is no file


async def test_what_cannot_be_saved_is_said_and_changes_nothing(monkeypatch, file):
    stage = Stage(monkeypatch, site=load_site(file), file=file)

    def refused(serial):
        stage.link.receive(topics.survey_save_topic(1), mqtt.SurveySaveMessage("page", serial))
        assert stage.link.newest(mqtt.PlacementMessage) is None
        return stage.link.newest(mqtt.SurveyMessage).error

    assert "result 1 is not there" in refused(1)
    stage.found = true_survey(())
    await stage.play(0.0, 3.0)
    assert "determines no anchor" in refused(stage.node.live.serial)
    stage.found = true_survey()
    await stage.play(3.0, 6.0)
    stage.link.receive(topics.site_topic(1), mqtt.SiteMessage(SITE, True, 0.0))
    assert "another site" in refused(stage.node.live.serial)
    stage.link.receive(topics.site_topic(1), mqtt.SiteMessage(load_site(file), True, 0.0))
    file.write_text(TEXT.replace('mode = "free"', 'mode = "free"\nrate_hz = 20.0'), encoding="utf-8")
    changed = file.read_text(encoding="utf-8")
    assert "has been changed" in refused(stage.node.live.serial)
    assert file.read_text(encoding="utf-8") == changed
    file.write_text("nonsense", encoding="utf-8")
    assert str(file) in refused(stage.node.live.serial)


async def test_a_solver_that_fails_is_reported_and_asked_again(monkeypatch):
    stage = Stage(monkeypatch, site=SITE)
    for until_s, error in ((3.0, SkylessError("too few ranges")), (6.0, ZeroDivisionError("no"))):
        stage.found = error
        await stage.play(until_s - 3.0, until_s)
        stage.now_s += 1.0
        await stage.step()
        assert str(error.args[0]) in stage.link.newest(mqtt.SurveyMessage).error
        assert stage.node.live.serial == 0
    stage.found = true_survey()
    await stage.play(7.0, 10.0)
    assert stage.link.newest(mqtt.SurveyMessage).error is None


async def test_the_site_on_mqtt_does_where_there_is_no_file_and_bad_messages_are_counted(monkeypatch):
    stage = Stage(monkeypatch)
    await stage.step()
    assert stage.node.live is None
    with pytest.raises(SkylessError, match="not known"):
        stage.node.save()
    stage.link.receive(topics.site_topic(1), mqtt.SiteMessage(SITE, True, 0.0))
    await stage.play(0.0, 2.0)
    assert stage.node.live.serial > 0
    other = replace(SITE, anchors=(replace(SITE.anchors[0], x_m=0.5), *SITE.anchors[1:]))
    stage.link.receive(topics.site_topic(1), mqtt.SiteMessage(other, True, 0.0))
    assert stage.node.live.site == other
    assert stage.node.live.serial == 0
    for topic in (topics.survey_facts_topic(1), topics.survey_save_topic(1), topics.site_topic(1)):
        stage.link.handlers[topic](topic, json.dumps({"x": 1}).encode())
    assert stage.node.problems == 3


async def test_what_is_retained_and_the_lease_end_with_the_program(monkeypatch):
    stage = Stage(monkeypatch, site=SITE)
    async with running(stage.node.run()):
        for callback in stage.link.on_state:
            callback(True)
        assert stage.link.newest(mqtt.RequestMessage).stamps
        await asyncio.sleep(0.01)
    cleared = {topic for topic, message, options in stage.link.published if message == b"" and options["retain"]}
    assert cleared == {topics.survey_topic(1), topics.watch_topic(1)}
    assert not stage.link.newest(mqtt.RequestMessage).stamps


async def test_one_that_gathers_computes_and_publishes_nothing_but_its_request(monkeypatch):
    stage = Stage(monkeypatch, site=SITE, serves=False)
    await stage.play(0.0, 3.0)
    assert not stage.asked
    assert len(stage.node.live.ranges().pairs) == 15
    assert {type(message) for _, message, _ in stage.link.published} <= {mqtt.RequestMessage}


async def test_a_result_that_was_begun_before_it_was_saved_is_dropped(monkeypatch):
    """Its delays are those against the site before: with them, every delay would be corrected twice."""
    stage = Stage(monkeypatch, site=SITE)
    await stage.play()
    live, serial = stage.node.live, stage.node.live.serial
    begun = asyncio.ensure_future(stage.node._make_result(live))
    await asyncio.sleep(0)
    stage.node.save()
    await begun
    assert live.serial == serial
    assert live.result(serial) is None
    with pytest.raises(SkylessError, match="not there"):
        stage.node.save()


@pytest.mark.parametrize("step_s", [-30.0, -3600.0, 30.0, 3600.0])
def test_ranges_go_on_when_the_clock_of_an_anchors_host_is_set(step_s):
    live = LiveSurvey(SITE, Facts())
    for round_number in range(8):  # the same stamps again and again, 100 s in all
        for t_s, message in messages():
            set_s = step_s if message.anchor == 2 and round_number > 0 else 0.0
            again = replace(message, run=str(round_number), unix_s=message.unix_s + 13.0 * round_number + set_s)
            live.add_stamps(again, BEGIN_S + 13.0 * round_number + t_s)
        if round_number == 5:  # a minute after the clock was set
            before = {(one.a, one.b): one.exchanges for one in live.ranges().pairs}
    after = {(one.a, one.b): one.exchanges for one in live.ranges().pairs}
    assert min(after[pair] - before[pair] for pair in after) > 500


@pytest.mark.parametrize(
    "facts",
    [
        Facts(tapes=(Tape(1, 2, -3.0),)),
        Facts(tapes=(Tape(1, 2, 1e300),)),
        Facts(points={1: (1e200, 0.0, None)}),
        Facts(pair_std_m=-1.0),
        Facts(heights_m=dict.fromkeys(range(10_001), 1.0)),
        Facts(gauge=Gauge(1, 1)),
    ],
)
async def test_facts_that_cannot_be_computed_with_are_counted_and_ignored(monkeypatch, facts):
    stage = Stage(monkeypatch, site=SITE)
    stage.link.receive(topics.survey_facts_topic(1), mqtt.SurveyFactsMessage(facts))
    await stage.play(0.0, 2.0)
    assert stage.node.problems == 1
    assert stage.link.newest(mqtt.SurveyMessage).facts == Facts()


async def test_numbers_that_are_no_stamps_spoil_nothing(monkeypatch):
    stage = Stage(monkeypatch, site=SITE)
    await stage.play(0.0, 2.0)
    wrong = [[2, 1 << 64, -5], [2, -(1 << 63), 1 << 40], [1, 5, 5], [77, 5, 5]]
    for unix_s in (0.0, 1e300, -1e300):
        body = {"anchor": 1, "run": "run1", "unix_s": unix_s, "stamps": wrong}
        stage.link.handlers[topics.stamps_topic(1, "+")]("", json.dumps(body).encode())
    await stage.play(2.0, 8.0)
    assert len(stage.asked[-1][0].pairs) == 15


async def test_of_two_programs_at_one_site_the_later_one_waits_until_the_other_has_ended(monkeypatch):
    stage = Stage(monkeypatch, site=SITE)
    await stage.play(0.0, 2.0)
    own = stage.link.newest(mqtt.SurveyMessage)
    for unix_s in (1.0, 2.0):  # a later one, which waits itself
        stage.link.receive(topics.survey_topic(1), replace(own, by=own.by + "0", unix_s=unix_s))
    stage.link.receive(topics.survey_topic(1), replace(own, by="0", unix_s=1.0))  # one that the broker has kept
    await stage.play(2.0, 3.0)
    assert not stage.node._waits()
    stage.link.receive(topics.survey_topic(1), replace(own, by="0", unix_s=2.0))
    count = len(stage.link.published)
    await stage.play(3.0, 5.0)
    stage.link.receive(topics.survey_save_topic(1), mqtt.SurveySaveMessage("page", stage.node.live.serial))
    assert len(stage.link.published) == count
    stage.now_s += 31.0
    await stage.step()
    assert isinstance(stage.link.published[-1][1], mqtt.SurveyMessage | mqtt.WatchMessage)
    assert sum("another survey program" in line for line in stage.said) == 1


@pytest.mark.parametrize("failing", [1, 2, 3, 4])
def test_where_not_all_files_can_be_written_none_is(tmp_path, monkeypatch, failing, file):
    """The image of the floor, the site's file before, the survey's record, and the site's file."""
    written = full_disk(monkeypatch, failing)
    floor = FloorImage(FloorPlanSite("floor.png", 12.0, -1.0, -2.0), PNG)
    with pytest.raises(SkylessError, match="No space left"):
        save_survey(file, true_survey(), PairRanges((), tuple(POSITIONS_M)), 0.0, floor)
    assert len(written) == failing
    assert [path.name for path in tmp_path.iterdir()] == ["lab.toml"]
    assert file.read_text(encoding="utf-8") == TEXT


async def test_a_finding_is_logged_once_although_its_size_wavers():
    said, again = [], []
    node = SurveyNode(SurveySettings(1), lambda _: Facts(), MqttAddress("127.0.0.1", 1), said.append)
    node._next_publish_s = math.inf
    found = []
    node.live = SimpleNamespace(
        state=lambda _: "no data",
        watch_message=lambda *_: mqtt.WatchMessage(0.0, "watching", tuple(found), 15),
        restart_ranges=lambda: again.append(None),
        advance_watch=lambda _: None,
    )

    for size_m in (0.31, 0.32, 0.31, 0.32, 0.9):
        found[:] = [mqtt.WatchFinding("moved", (4,), size_m, 0.01, 0.0, f"anchor 4 has moved by about {size_m:g} m")]
        node.update()
    found.clear()
    node.update()
    assert said == [
        "watch: anchor 4 has moved by about 0.31 m",
        "watch: anchor 4 has moved by about 0.9 m",
        "watch: over: anchor 4 has moved by about 0.9 m",
    ]
    assert len(again) == 1


def test_what_phases_show_is_found_beside_what_stamps_show():
    """An anchor that moves by 5 mm, by the messages of all; the ranges stay of use."""
    live, shown, moved = LiveSurvey(SITE, Facts()), [], AnchorDisplacement(3, x_m=0.005, from_s=14.0)
    for t_s, message in published(24.0, SITE, carrier=CarrierModel(), anchor_displacements=(moved,)):
        live.add_stamps(msgspec.json.decode(msgspec.json.encode(message), type=mqtt.StampsMessage), BEGIN_S + t_s)
        live.advance_watch(BEGIN_S + t_s)
        shown.append(live.watch_message(BEGIN_S + t_s, 1e9 + t_s))
    (finding,) = shown[-1].findings
    assert (finding.kind, finding.anchors) == ("check", (3,))
    assert finding.sentence == (
        "anchor 3 moved or turned by about 5 mm (or 18, 28, 41 …), by the phases of its carrier"
    )
    assert 1e9 + 12.0 <= finding.since_unix_s <= 1e9 + 16.0
    assert all(one.anchors == (3,) for message in shown for one in message.findings)
    lines, begins_again = FindingsLog().update(shown[-1].findings)
    assert lines == [finding.sentence]
    assert not begins_again


def test_ranges_count_from_the_delays_of_the_file_although_the_anchors_run_with_others():
    node = SurveyNode(SurveySettings(1, FRESH), lambda _: Facts(), MqttAddress("127.0.0.1", 1), lambda _: None)
    node.live = live_after(3.0)
    node.live.ranger.finish()
    before = {(pair.a, pair.b): pair.range_m for pair in node.live.ranges().pairs}
    more = replace(FRESH, unplaced=tuple(replace(one, tx_antenna_delay_ticks=16536) for one in FRESH.unplaced))
    node._on_site(mqtt.SiteMessage(more, simulated=True, unix_s=0.0))
    # With smaller delays ranges are longer, by 50 ticks of each anchor.
    for pair in node.live.ranges().without_delays(node.delays_m).pairs:
        assert pair.range_m - before[pair.a, pair.b] == pytest.approx(100 * 0.00469176, abs=1e-5)
