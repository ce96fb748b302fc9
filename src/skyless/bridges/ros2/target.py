"""The target ``ros2://``: a site's fixes as topics of ROS 2 over Cyclone DDS, where ROS itself need not be installed.

    ros2://?domain=0&frame=site&namespace=skyless&tf=no

Names and qualities of service: https://design.ros2.org/articles/topic_and_service_names.html and REP 2011 (hashes of
types). The definitions of the types come from rosbags. A thread writes, because DDS may wait and a tag's program must
not. What it cannot keep up with is dropped, the oldest first.
"""

import asyncio
import os
import queue
import re
import threading
from functools import cache
from importlib import import_module
from typing import Any, Final

from skyless.bridges.ros2.messages import (
    FRAME_NAME,
    FRAME_RULE,
    NAMESPACE,
    SITE_FRAME,
    RosEncoder,
    RosMessage,
    RosSettings,
)
from skyless.bridges.target import BridgeContext, BridgedSite, Target, TargetUrl
from skyless.core.errors import SkylessError
from skyless.core.extras import what_to_install
from skyless.run.mqtt.messages import AnchorHealth, FixMessage, TagHealth

DEPTH: Final = 10
"""Messages of a topic that are kept for readers that have not confirmed them."""

_MAX_BLOCKING_NS: Final = 10_000_000

_SETTINGS: Final = (
    "<CycloneDDS><Domain Id='any'><Compatibility><IgnoreTypeInformation>1.15</IgnoreTypeInformation></Compatibility>"
    "</Domain></CycloneDDS>"
)
"""1.15 is Fast DDS's number among vendors, whose descriptions of types Cyclone DDS cannot read: without this, its
subscribers see the topics and get nothing."""


class DdsTypes:
    """Types of ROS 2's messages as Cyclone DDS announces them. Raises ImportError where a package is missing."""

    def __init__(self) -> None:
        self._idl: Any = import_module("cyclonedds.idl")
        self._kinds: Any = import_module("cyclonedds.idl.types")
        typesys = import_module("rosbags.typesys")
        self._node = import_module("rosbags.interfaces").Nodetype
        self._store: Any = typesys.get_typestore(typesys.Stores.ROS2_KILTED)
        self._made: dict[str, Any] = {}

    def hash(self, name: str) -> str:
        """What ROS since Iron compares to see that both ends mean the same (REP 2011)."""
        return str(self._store.hash_rihs01(name))

    def type(self, name: str) -> Any:  # noqa: ANN401 - a class whose fields only DDS sees
        """The type ``package/msg/Name``, which DDS knows as ``package::msg::dds_::Name_``."""
        if name not in self._made:
            fields = {field: self._field(*given) for field, given in self._store.get_msgdef(name).fields}
            package, kind, last = name.split("/")
            self._made[name] = self._idl.make_idl_struct(last, f"{package}.{kind}.dds_.{last}_", fields)
        return self._made[name]

    def _field(self, node: object, details: Any) -> Any:  # noqa: ANN401 - see above
        if node is self._node.NAME:
            return self.type(details)
        if node is self._node.BASE:
            plain = {"string": str, "bool": bool, "byte": self._kinds.uint8}
            return plain.get(details[0]) or getattr(self._kinds, details[0])
        inner = self._field(*details[0])
        return self._kinds.array[inner, details[1]] if node is self._node.ARRAY else self._kinds.sequence[inner]


class DdsPublisher:
    """A participant of a DDS domain; its methods may wait, for some milliseconds."""

    def __init__(self, text: str, domain: int) -> None:
        """``text`` is the target's address. Raises SkylessError: DDS is not installed, or cannot start."""
        try:
            self._dds: Any = import_module("cyclonedds")
            for name in ("core", "domain", "pub", "qos", "topic"):
                import_module(f"cyclonedds.{name}")
            self._types = DdsTypes()
        except ImportError as error:
            raise SkylessError(
                f"{what_to_install(error, f'the target {text!r}')}; it is made for x86-64 up to Python 3.13: elsewhere "
                "use jsonl+tcp: and the node examples/ros2/skyless_node.py"
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
        """Publish one. Lets the errors of DDS through."""
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
        digest = self._types.hash(message.type)
        hashed = self._dds.qos.Qos(policy.Userdata(data=f"typehash={digest};".encode()), base=quality)
        kind = self._types.type(message.type)
        topic = self._dds.topic.Topic(self._participant, f"rt{message.topic}", kind, qos=quality)
        return self._dds.pub.DataWriter(self._participant, topic, qos=hashed)


@cache
def _domain(number: int, given: str) -> Any:  # noqa: ANN401 - a Domain, where the package is
    """A domain with our settings, then those of CYCLONEDDS_URI. The cache keeps it: its settings would go with it."""
    return import_module("cyclonedds.domain").Domain(number, f"{_SETTINGS},{given}" if given else _SETTINGS)


_MAX_DOMAIN: Final = 232
"""Beyond it, ports would exceed 65535."""

_MAX_WAITING: Final = 500
_CLOSE_S: Final = 1.0
_NAMESPACE: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,31}(/[A-Za-z][A-Za-z0-9_]{0,31}){0,3}")


def make_target(url: TargetUrl, context: BridgeContext) -> Target:
    """The target of an address. Raises SkylessError."""
    frame, namespace = url.text_option("frame", SITE_FRAME), url.text_option("namespace", NAMESPACE)
    if not FRAME_NAME.fullmatch(frame):
        raise url.wrong(f"with frame= {FRAME_RULE}")
    if not _NAMESPACE.fullmatch(namespace):
        raise url.wrong("with namespace= as topics of ROS begin: letters, digits and _, not a digit first")
    transforms = url.choice("tf", ("no", "yes"), "no") == "yes"
    domain = url.whole_number("domain", 0, 0, _MAX_DOMAIN)
    if not url.text_option("domain"):
        domain = _usual_domain(url.text)
    url.check_all_read()
    settings = RosSettings(frame=frame, namespace=namespace, transforms=transforms)
    return Ros2Target(url.text, DdsPublisher(url.text, domain), settings, context)


def _usual_domain(target: str) -> int:
    """As programs of ROS choose it. Raises SkylessError."""
    text = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not text.isdecimal() or int(text) > _MAX_DOMAIN:
        raise SkylessError(
            f"the target {target!r} uses the domain of ROS_DOMAIN_ID, which is {text!r}; it should be a whole number "
            f"from 0 to {_MAX_DOMAIN}"
        )
    return int(text)


class Ros2Target(Target):
    """Publishes poses, velocities, positions on the Earth, anchors and diagnostics."""

    def __init__(self, text: str, publisher: DdsPublisher, settings: RosSettings, context: BridgeContext) -> None:
        super().__init__(text)
        self._publisher, self._encoder, self._log = publisher, RosEncoder(settings), context.log
        self._waiting: queue.Queue[list[RosMessage] | None] = queue.Queue(_MAX_WAITING)
        self._troubles: set[str] = set()
        self._knows_no_earth = False
        """Whether it was logged that the site does not know where it is."""

    def on_site(self, site: BridgedSite) -> None:
        """Publish its anchors."""
        if site.georeference is None and not self._knows_no_earth:
            self._knows_no_earth = True
            self._log(f"{self.text}: no topic fix (NavSatFix), as the site file has no [georeference]")
        self._give(self._encoder.on_site(site))

    def on_fix(self, fix: FixMessage) -> None:
        """Publish it."""
        self._give(self._encoder.on_fix(fix))

    def on_no_fix(self, tag: str, unix_s: float, reason: str) -> None:  # noqa: ARG002 - NavSatFix has no text
        """Publish that there is none; the reason is in the diagnostics."""
        self._give(self._encoder.on_no_fix(tag, unix_s))

    def on_health(self, health: TagHealth | AnchorHealth) -> None:
        """Publish it as diagnostics."""
        self._give(self._encoder.on_health(health))

    async def run(self) -> None:
        """Publish until cancelled."""
        thread = threading.Thread(target=self._publish_all, daemon=True)
        thread.start()
        try:
            await asyncio.Event().wait()
        finally:
            self._give(None)
            await asyncio.to_thread(thread.join, _CLOSE_S)

    def _give(self, messages: list[RosMessage] | None) -> None:
        """Let the thread write them; where too many wait, the oldest are dropped."""
        while True:
            try:
                self._waiting.put_nowait(messages)
            except queue.Full:
                try:
                    self.dropped["slow-dds"] += len(self._waiting.get_nowait() or ())
                except queue.Empty:
                    continue
            else:
                return

    def _publish_all(self) -> None:
        while (messages := self._waiting.get()) is not None:
            for message in messages:
                try:
                    self._publisher.write(message)
                except Exception as error:  # noqa: BLE001 - whatever it is, later messages may go
                    self.dropped["not-sent"] += 1
                    if message.topic not in self._troubles:
                        self._troubles.add(message.topic)
                        self._log(f"{self.text}: {message.topic} cannot be published: {error}")
        self._publisher.close()
