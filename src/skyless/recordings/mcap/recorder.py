"""From MQTT's messages to a recording: what is kept, and what is added so that Foxglove shows it."""

from collections import Counter
from typing import Final

import msgspec
from msgspec import Struct

from skyless.mqtt.messages import FixMessage, SiteMessage
from skyless.recordings.mcap import foxglove
from skyless.recordings.mcap.channels import FLOOR_PLAN, LASTING, decoder_of, place_of, schema_of
from skyless.recordings.mcap.file import McapFile
from skyless.recordings.mcap.recording import NS
from skyless.recordings.source import Drops
from skyless.site.model import GeoreferenceSite

SHOWN_HZ: Final = 20.0
"""How many poses of a tag are added for Foxglove in a second; the fixes themselves are all kept."""

SCENE_TOPIC: Final = "/site/scene"
MOST_TOPICS: Final = 10_000


class McapRecorder:
    """Writes what it is given into a recording."""

    def __init__(self, file: McapFile) -> None:
        self.file = file
        self.drops: Drops = Counter()
        self.kinds: Counter[str] = Counter()
        """Messages kept, by kind."""
        self._last: dict[str, bytes] = {}
        self._topics: set[str] = set()
        self._shown_s: dict[str, float] = {}
        self._georeference: GeoreferenceSite | None = None

    def take(self, topic: str, payload: bytes, unix_s: float) -> Struct | None:
        """Keep a message that came at a time, and return it; what is not of this version is counted and dropped."""
        place = place_of(topic)
        if place is None:
            self.drops["unknown-topic"] += 1
            return None
        if not payload or self._last.get(topic) == payload:
            return None
        if topic not in self._topics and len(self._topics) >= MOST_TOPICS:
            self.drops["too-many-topics"] += 1
            return None
        self._topics.add(topic)
        if place.kind in LASTING:
            self._last[topic] = payload
        log_ns = round(unix_s * NS)
        if place.payload is None:
            media_type = "image/png" if payload.startswith(b"\x89PNG") else "image/jpeg"
            self.file.attach(FLOOR_PLAN, media_type, payload, log_ns)
            return None
        try:
            message = decoder_of(place.payload).decode(payload)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            self.drops["malformed-message"] += 1
            return None
        self.kinds[place.kind] += 1
        self.file.add(topic, schema_of(place.payload), payload, log_ns)
        self._add_views(message, unix_s, log_ns)
        return message

    def _add_views(self, message: Struct, unix_s: float, log_ns: int) -> None:
        if isinstance(message, FixMessage):
            try:
                self._show(message, log_ns)
            except (ValueError, ArithmeticError):  # figures that no tag tells
                self.drops["impossible-fix"] += 1
        elif isinstance(message, SiteMessage):
            self._georeference = message.site.georeference
            self._add(SCENE_TOPIC, "foxglove.SceneUpdate", foxglove.scene(message.site, unix_s), log_ns)

    def _show(self, fix: FixMessage, log_ns: int) -> None:
        """Add what Foxglove shows, not more often than a person sees."""
        if abs(fix.unix_s - self._shown_s.get(fix.tag, -1.0)) < 1.0 / SHOWN_HZ:
            return
        self._shown_s[fix.tag] = fix.unix_s
        self._add(f"/tag/{fix.tag}/pose", "foxglove.PoseInFrame", foxglove.pose_in_frame(fix), log_ns)
        self._add(f"/tag/{fix.tag}/ellipse", "foxglove.SceneUpdate", foxglove.ellipse(fix), log_ns)
        if self._georeference is not None:
            location = foxglove.location_fix(fix, self._georeference)
            self._add(f"/tag/{fix.tag}/location", "foxglove.LocationFix", location, log_ns)

    def _add(self, topic: str, schema: str, payload: bytes, log_ns: int) -> None:
        self.file.add(topic, foxglove.foxglove_schema(schema), payload, log_ns)
