"""``docs/mqtt.md``: every topic is in it, with an example that its struct reads, and a row in the table."""

import inspect
import json
import re
from pathlib import Path

import msgspec
import pytest

from skyless.run.mqtt import messages, topics
from skyless.run.mqtt.address import ACCESS

TEXT = Path(__file__).parents[2].joinpath("docs", "mqtt.md").read_text(encoding="utf-8")
EXAMPLES = dict(re.findall(r"### `(\S+)`\n(?:(?!###).)*?```json\n(.*?)```", TEXT, re.DOTALL))

SITE, TAG = "<site>", "<tag>"
STRUCTS = {
    topics.site_topic(SITE): messages.SiteMessage,
    topics.fix_topic(SITE, TAG): messages.FixMessage,
    topics.status_topic(SITE, "<kind>", "<name>"): messages.StatusMessage,
    topics.health_topic(SITE, "tag", TAG): messages.TagHealth,
    topics.health_topic(SITE, "anchor", "<id>"): messages.AnchorHealth,
    topics.health_topic(SITE, "ether", "<name>"): messages.EtherHealth,
    topics.receptions_topic(SITE, TAG): messages.ReceptionsMessage,
    topics.request_topic(SITE): messages.RequestMessage,
    topics.truth_topic(SITE): messages.TruthMessage,
    topics.zones_topic(SITE): messages.ZonesMessage,
    topics.zone_event_topic(SITE, "<zone>"): messages.ZoneEvent,
    topics.tag_zones_topic(SITE, TAG): messages.TagZones,
    topics.tag_position_topic(SITE, TAG): messages.TagPosition,
    topics.stamps_topic(SITE, "<id>"): messages.StampsMessage,
    topics.survey_topic(SITE): messages.SurveyMessage,
    topics.survey_facts_topic(SITE): messages.SurveyFactsMessage,
    topics.survey_save_topic(SITE): messages.SurveySaveMessage,
    topics.placement_topic(SITE): messages.PlacementMessage,
    topics.watch_topic(SITE): messages.WatchMessage,
    topics.assets_topic(SITE): messages.AssetsMessage,
    topics.alarm_rules_topic(SITE): messages.AlarmRulesMessage,
    topics.alarm_topic(SITE, "<rule>", "<subject>"): messages.AlarmMessage,
    topics.acknowledge_topic(SITE, "<rule>", "<subject>"): messages.AcknowledgeMessage,
}


@pytest.mark.parametrize("topic", STRUCTS)
def test_an_example_is_what_the_struct_holds(topic):
    """The struct reads it, and holds all of it: no key is misspelt."""
    example = EXAMPLES[topic]
    value = msgspec.json.decode(example, type=STRUCTS[topic])
    assert holds(json.loads(msgspec.json.encode(value)), json.loads(example))


def holds(whole, part):
    if isinstance(part, dict):
        return all(key in whole and holds(whole[key], value) for key, value in part.items())
    if isinstance(part, list):
        return all(holds(*pair) for pair in zip(whole, part, strict=True))
    return whole == part


def test_examples_are_of_known_topics():
    assert EXAMPLES.keys() == STRUCTS.keys()


def test_the_table_has_every_topic():
    rows = dict(re.findall(r"^\| `(\S+)` \| (.*?) \|", TEXT, re.MULTILINE))
    named = {
        topic.removeprefix(topics.site_topic(SITE).removesuffix("site")): struct for topic, struct in STRUCTS.items()
    }
    assert rows.keys() - {"floor_plan", "floor_plan/<floor>"} == named.keys()
    assert all(rows[topic] == f"`{struct.__name__}`" for topic, struct in named.items())


def test_no_topic_is_forgotten():
    functions = {name for name, value in vars(topics).items() if isinstance(value, topics.Topic)}
    source = inspect.getsource(inspect.getmodule(test_no_topic_is_forgotten))
    assert {name for name in functions if f"topics.{name}(" not in source} == {
        "floor_plan_topic",
        "plan_of_floor_topic",
    }


def test_readers_ignore_fields_that_they_do_not_know():
    example = json.loads(EXAMPLES[topics.fix_topic(SITE, TAG)]) | {"later": 1}
    assert msgspec.convert(example, messages.FixMessage).tag == "tag1"


def test_the_table_of_roles_is_that_of_the_broker():
    def cell(filters):
        return ", ".join(f"`{name.removeprefix('skyless/v1/+/')}`" for name in filters) or "nothing"

    rows = re.findall(r"^\| \*\*(\w+)\*\* \| .*? \| (.*?) \| (.*?) \|$", TEXT, re.MULTILINE)
    assert rows == [(str(role), cell(access.publish), cell(access.subscribe)) for role, access in ACCESS.items()]
