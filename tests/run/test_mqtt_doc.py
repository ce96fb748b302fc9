"""``docs/mqtt.md``: every topic is in it, with an example that its struct reads, and a row in the table."""

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
NAMES = {
    "tag": (TAG,),
    "anchor": ("<id>",),
    "zone": ("<zone>",),
    "alarm": ("<rule>", "<subject>"),
    "+": ("<kind>", "<name>"),
}
"""Names in topics, by their first level."""
STRUCTS = {
    one(SITE, *NAMES.get(one.levels.partition("/")[0], ())): one.payload
    for one in vars(topics).values()
    if isinstance(one, topics.Topic) and one.payload is not None
} | {
    topics.health_topic(SITE, "tag", TAG): messages.TagHealth,
    topics.health_topic(SITE, "anchor", "<id>"): messages.AnchorHealth,
    topics.health_topic(SITE, "ether", "<name>"): messages.EtherHealth,
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


def test_readers_ignore_fields_that_they_do_not_know():
    example = json.loads(EXAMPLES[topics.fix_topic(SITE, TAG)]) | {"later": 1}
    assert msgspec.convert(example, messages.FixMessage).tag == "tag1"


def test_the_table_of_roles_is_that_of_the_broker():
    def cell(filters):
        return ", ".join(f"`{name.removeprefix('skyless/v1/+/')}`" for name in filters) or "nothing"

    rows = re.findall(r"^\| \*\*(\w+)\*\* \| .*? \| (.*?) \| (.*?) \|$", TEXT, re.MULTILINE)
    assert rows == [(str(role), cell(access.publish), cell(access.subscribe)) for role, access in ACCESS.items()]
