"""A recording of a running site as a ROS 2 bag: a folder with an MCAP of CDR messages and ``metadata.yaml``.

It has the messages of the target ``ros2://`` for a running site, and the truth if known.
"""

import importlib
import secrets
import shutil
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, cast

from msgspec import Struct

from skyless.bridges.ros2 import RosEncoder, RosMessage, RosSettings, type_store
from skyless.bridges.target import bridged_site, is_usable
from skyless.core.errors import ConfigurationError, SkylessError, writing
from skyless.machine import extra_module
from skyless.run.mqtt.messages import AnchorHealth, FixMessage, SiteMessage, TagHealth, TruthMessage
from skyless.run.recordings.recording import NS, McapRecording, Recorded

if TYPE_CHECKING:
    from rosbags.interfaces import Connection, Qos
    from rosbags.rosbag2 import Writer

BagVersion = Literal[8, 9]
"""Version of the folder's metadata: 8 for Humble and Iron, 9 from Jazzy on."""

_KINDS: Final = {"site", "fix", "health", "truth"}
_KEPT: Final = 10
"""Depth of the queues of ``ros2 bag play``, as for ``ros2://``."""


class Bag(Struct, frozen=True):
    """Summary of a written bag."""

    path: str
    start_s: float
    end_s: float
    """Unix times of the first and last message."""
    topics: dict[str, int]
    """Messages on each."""
    types: dict[str, str]
    """Type of each topic."""
    fixes: int
    unusable: int
    """Fixes omitted because an alert forbids their use, or they are not finite."""
    drops: dict[str, int]
    """Unreadable parts of the recording."""
    finished: bool
    """False if the recording was cut off or is still being written."""


def write_bag(
    recording: str | PathLike[str],
    folder: str | PathLike[str],
    settings: RosSettings,
    tag: str | None = None,
    version: BagVersion = 9,
) -> Bag:
    """Write a recording of ``skyless record`` as a bag: the whole folder or nothing. ``tag``: only this one.

    Raises:
        ConfigurationError: the recording cannot be read, or the folder exists.
        SkylessError: it has no site; the folder cannot be written; the package rosbags is missing.
    """
    with McapRecording(recording) as source:
        site = source.site
        if site is None:
            raise SkylessError(f"{source.summary().path} holds no site; it should be a recording of skyless record")
        with writing(folder), _new_folder(Path(folder)) as scratch, _BagWriter(scratch, version) as writer:
            return _copy(source, site, writer, settings, tag, folder)


def _copy(
    source: McapRecording,
    site: SiteMessage,
    writer: "_BagWriter",
    settings: RosSettings,
    tag: str | None,
    folder: str | PathLike[str],
) -> Bag:
    encoder = RosEncoder(settings)
    anchors = encoder.on_site(bridged_site(site.site, simulated=site.simulated))
    fixes: Counter[bool] = Counter()
    start_s = end_s = 0.0
    for found in source.messages(_KINDS):
        start_s, end_s = start_s or found.time_s, found.time_s
        for message in anchors:
            writer.write(message, found.time_s)
        anchors = []
        if isinstance(found.message, FixMessage) and tag in (None, found.message.tag):
            fixes[is_usable(found.message)] += 1
        for message in _messages_of(found, encoder, tag):
            writer.write(message, found.time_s)
    summary = source.summary()
    drops = {reason: count for reason, count in summary.drops.items() if count}
    counts, types = writer.counts(), writer.types()
    return Bag(str(folder), start_s, end_s, counts, types, fixes[True], fixes[False], drops, summary.finished)


def _messages_of(found: Recorded, encoder: RosEncoder, tag: str | None) -> list[RosMessage]:
    """The ROS messages of one recorded message."""
    message = found.message
    if isinstance(message, SiteMessage):
        return encoder.on_site(bridged_site(message.site, simulated=message.simulated))
    if isinstance(message, FixMessage) and tag in (None, message.tag) and is_usable(message):
        return encoder.on_fix(message)
    if isinstance(message, AnchorHealth) or (isinstance(message, TagHealth) and tag in (None, message.tag)):
        return encoder.on_health(message)
    if isinstance(message, TruthMessage):
        wanted = [(name, motion) for name, motion in message.tags.items() if tag in (None, name)]
        return [one for name, motion in wanted for one in encoder.on_truth(name, message.unix_s, motion.position_m)]
    return []


@contextmanager
def _new_folder(folder: Path) -> Iterator[Path]:
    """A folder created in the block, which gets its final name if the block ends without an error."""
    if folder.exists():
        raise ConfigurationError(folder, "", None, "a new folder; this one exists and is not overwritten")
    outer = folder.with_name(f".{folder.name}.{secrets.token_hex(4)}")
    try:
        outer.mkdir(parents=True)
        yield outer / folder.name  # the bag's file is called as its folder
        (outer / folder.name).rename(folder)
    finally:
        shutil.rmtree(outer, ignore_errors=True)


class _BagWriter:
    """Writes messages into a bag; a topic starts with its first message."""

    def __init__(self, folder: Path, version: BagVersion) -> None:
        """Raises SkylessError if the package that writes bags is missing."""
        rosbag2 = extra_module("rosbags.rosbag2", "a bag of ROS 2")
        self._writer: Writer = rosbag2.Writer(folder, version=version, storage_plugin=rosbag2.StoragePlugin.MCAP)
        self._writer.set_compression(rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD)
        self._topics: dict[str, Connection] = {}

    def __enter__(self) -> "_BagWriter":
        self._writer.open()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self._writer.close()
        else:
            self._writer.abort()

    def write(self, message: RosMessage, time_s: float) -> None:
        """Write one message at a Unix time."""
        topic = self._topics.get(message.topic)
        if topic is None:
            topic = self._topics[message.topic] = self._writer.add_connection(
                message.topic,
                message.type,
                typestore=type_store(),
                offered_qos_profiles=[_quality(lasting=message.lasting)],
            )
        self._writer.write(topic, round(time_s * NS), message.data)

    def counts(self) -> dict[str, int]:
        """Messages on each topic."""
        return {name: self._writer.counts[topic.id] for name, topic in sorted(self._topics.items())}

    def types(self) -> dict[str, str]:
        """Type of each topic."""
        return {name: topic.msgtype for name, topic in sorted(self._topics.items())}


def _quality(*, lasting: bool) -> "Qos":
    """Quality of service of ``ros2 bag play`` for a topic, as for ``ros2://``."""
    of = importlib.import_module("rosbags.interfaces")
    never = of.QosTime(0, 0)
    return cast(
        "Qos",
        of.Qos(
            history=of.QosHistory.KEEP_LAST,
            depth=_KEPT,
            reliability=of.QosReliability.RELIABLE,
            durability=of.QosDurability.TRANSIENT_LOCAL if lasting else of.QosDurability.VOLATILE,
            deadline=never,
            lifespan=never,
            liveliness=of.QosLiveliness.AUTOMATIC,
            liveliness_lease_duration=never,
            avoid_ros_namespace_conventions=False,
        ),
    )
