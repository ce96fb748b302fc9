"""Publishes messages of ROS 2 by Cyclone DDS, in the way in which ROS 2 would.

Names and qualities of service: https://design.ros2.org/articles/topic_and_service_names.html and REP 2011 (hashes of
types).
"""

import os
from functools import cache
from importlib import import_module
from typing import Any, Final

from skyless.bridges.ros2.messages import RosMessage
from skyless.errors import SkylessError

DEPTH: Final = 10
"""Messages of a topic that are kept for readers that have not confirmed them."""

_MAX_BLOCKING_NS: Final = 10_000_000

_SETTINGS: Final = (
    "<CycloneDDS><Domain Id='any'><Compatibility><IgnoreTypeInformation>1.15</IgnoreTypeInformation></Compatibility>"
    "</Domain></CycloneDDS>"
)
"""1.15 is Fast DDS's number among vendors, whose descriptions of types Cyclone DDS cannot read: without this, its
subscribers see the topics and get nothing."""


class DdsPublisher:
    """A participant of a DDS domain; its methods may wait, for some milliseconds."""

    def __init__(self, text: str, domain: int) -> None:
        """``text`` is the target's address. Raises SkylessError: DDS is not installed, or cannot start."""
        try:
            self._dds: Any = import_module("cyclonedds")
            for name in ("core", "domain", "pub", "qos", "topic"):
                import_module(f"cyclonedds.{name}")
            self._types: dict[str, Any] = import_module("skyless.bridges.ros2.idl").TYPES
        except ImportError:
            raise SkylessError(
                f"the target {text!r} needs the package cyclonedds: pip install '.[ros2]' in a copy of Skyless's "
                "repository brings it on x86-64 up to Python 3.13; elsewhere use jsonl+tcp: and the node "
                "examples/ros2/skyless_node.py"
            ) from None
        given = os.environ.get("CYCLONEDDS_URI", "")
        try:
            _domain(domain, given)
            self._participant = self._dds.domain.DomainParticipant(domain)
        except (self._dds.core.DDSException, UnicodeError) as error:
            hint = f"; CYCLONEDDS_URI is {given!r}" if given else ""
            raise SkylessError(f"the target {text!r} cannot start DDS in domain {domain}: {error}{hint}") from None
        self._writers: dict[str, Any] = {}

    def write(self, message: RosMessage) -> None:
        """Publish one. Raises whatever DDS raises."""
        writer = self._writers.get(message.topic)
        if writer is None:
            writer = self._writers[message.topic] = self._writer(message)
        writer.write(writer.data_type.deserialize(message.data))

    def close(self) -> None:
        """Leave the domain, so that subscribers need not wait until they miss us. Nothing can be written any more."""
        self._writers.clear()
        del self._participant  # Cyclone's objects end when nothing refers to them

    def _writer(self, message: RosMessage) -> Any:  # noqa: ANN401 - a DataWriter, where the package is
        policy = self._dds.qos.Policy
        quality = self._dds.qos.Qos(
            policy.Reliability.Reliable(max_blocking_time=_MAX_BLOCKING_NS),
            policy.Durability.TransientLocal if message.lasting else policy.Durability.Volatile,
            policy.History.KeepLast(depth=DEPTH),
            policy.DataRepresentation(use_cdrv0_representation=True),
        )
        # ROS reads the type's hash from the writer.
        hashed = self._dds.qos.Qos(policy.Userdata(data=f"typehash={message.type.digest};".encode()), base=quality)
        kind = self._types[message.type.name]
        topic = self._dds.topic.Topic(self._participant, f"rt{message.topic}", kind, qos=quality)
        return self._dds.pub.DataWriter(self._participant, topic, qos=hashed)


@cache
def _domain(number: int, given: str) -> Any:  # noqa: ANN401 - a Domain, where the package is
    """A domain with our settings, then those of CYCLONEDDS_URI. The cache keeps it: its settings would go with it."""
    return import_module("cyclonedds.domain").Domain(number, f"{_SETTINGS},{given}" if given else _SETTINGS)
