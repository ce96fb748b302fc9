"""Publishes messages of ROS 2 by Cyclone DDS, in the way in which ROS 2 would.

Names and qualities of service: https://design.ros2.org/articles/topic_and_service_names.html and REP 2011 (hashes of
types).
"""

from importlib import import_module
from typing import Any, Final

from skyless.bridges.ros2.messages import RosMessage
from skyless.bridges.ros2.raw_writer import RawWriter
from skyless.errors import SkylessError

DEPTH: Final = 10
"""Messages of a topic that are kept for readers that have not confirmed them."""

_MAX_BLOCKING_NS: Final = 10_000_000


class DdsPublisher:
    """A participant of a DDS domain; its methods may wait, for some milliseconds."""

    def __init__(self, text: str, domain: int) -> None:
        """``text`` is the target's address. Raises SkylessError: DDS is not installed, or cannot start."""
        try:
            self._dds: Any = import_module("cyclonedds")
            for name in ("core", "domain", "qos", "topic"):
                import_module(f"cyclonedds.{name}")
            self._types: dict[str, Any] = import_module("skyless.bridges.ros2.idl").TYPES
        except ImportError:
            raise SkylessError(
                f"the target {text!r} needs the package cyclonedds: pip install 'skyless[ros2]' brings it on x86-64 up "
                "to Python 3.13; elsewhere use jsonl+tcp: and the node examples/ros2/skyless_node.py"
            ) from None
        try:
            self._participant = self._dds.domain.DomainParticipant(domain)
        except self._dds.core.DDSException as error:
            raise SkylessError(f"the target {text!r} cannot start DDS in domain {domain}: {error}") from None
        self._writers: dict[str, RawWriter] = {}

    def write(self, message: RosMessage) -> None:
        """Publish one. Raises whatever DDS raises."""
        writer = self._writers.get(message.topic)
        if writer is None:
            writer = self._writers[message.topic] = self._writer(message)
        writer.write(message.data)

    def _writer(self, message: RosMessage) -> RawWriter:
        policy = self._dds.qos.Policy
        quality = self._dds.qos.Qos(
            policy.Reliability.Reliable(max_blocking_time=_MAX_BLOCKING_NS),
            policy.Durability.TransientLocal if message.lasting else policy.Durability.Volatile,
            policy.History.KeepLast(depth=DEPTH),
            policy.DataRepresentation(use_cdrv0_representation=True),
            policy.Userdata(data=f"typehash={message.type.digest};".encode()),  # where ROS looks for the type's hash
        )
        return RawWriter(self._participant, f"rt{message.topic}", self._types[message.type.name], quality)
