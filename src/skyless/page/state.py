"""The state of the site for pages, gathered from messages, and the parts that are new to each page. No I/O."""

import math
from collections import Counter
from collections.abc import Callable, Collection, Iterable
from functools import partial
from itertools import islice
from typing import Annotated, Any, Final, Generic, NamedTuple, TypeVar

import msgspec
from msgspec import Meta, Struct
from msgspec.structs import replace
from starlette.exceptions import HTTPException

from skyless.run.mqtt.messages import (
    AnchorHealth,
    EtherHealth,
    FixMessage,
    StatusMessage,
    SurveyFactsMessage,
    SurveyMessage,
    SurveySaveMessage,
    TagHealth,
    TruthBuffer,
    TruthMessage,
    Vector,
    WatchMessage,
    WrongMessageError,
    read_message,
)
from skyless.run.mqtt.topics import survey_topic, watch_topic
from skyless.run.survey.checked_facts import BadFactsError, check_facts

EXPIRY_S: Final = 600.0
"""Fixes and health messages older than this are dropped."""

MAX_CLOCK_ERROR_S: Final = 0.5
"""The time of a fix by its tag's clock is replaced if it is wrong by more than this."""

MAX_ROWS: Final = 2_000
"""Maximum number of tags sent to a page. With more, tags on its map and tags that it names or searches are sent."""

MAX_HEALTHS: Final = 200
"""With more tags, or anchors, a page gets only the health of those that it names."""

_MAX_NAMED: Final = 200

_MAX_ENCODED: Final = 16
_Request = TypeVar("_Request", bound=Struct)
_KINDS: Final[dict[type, str]] = {AnchorHealth: "anchors", TagHealth: "tags", EtherHealth: "ether"}

CHOICE_S: Final = 0.5
"""Interval at which the tags for a page are chosen again."""

UNHEARD_S: Final = 10.0
"""A tag without a fix for this long is no longer on the map, as in ``page/clock.js``."""

SILENT_S: Final = 3.5
"""A node that reports once a second and has been silent for this long is offline, even if its status says online."""


class PageRequest(Struct, frozen=True):
    """A page's request: what it shows."""

    view: tuple[float, float, float, float] | None = None
    """The visible part of the site, least x and y and largest x and y in m. None means all of it."""
    find: Annotated[str, Meta(max_length=200)] = ""
    """Searched part of tags' names."""
    tags: Annotated[tuple[str, ...], Meta(max_length=_MAX_NAMED)] = ()
    """Selected tags and those in the visible part of a list, whose health is also sent."""
    anchors: Annotated[tuple[str, ...], Meta(max_length=_MAX_NAMED)] = ()
    rows: Annotated[int, Meta(ge=1)] = MAX_ROWS
    """Number of tags that the browser can draw in time."""


def read_request(text: str, kind: type[_Request]) -> _Request | None:
    """Decode a page's request; None for a text of another kind."""
    try:
        return msgspec.json.decode(text, type=kind)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return None


class Sent:
    """The part of the state that a page already has, so that it gets only new data."""

    def __init__(self) -> None:
        self.wanted = PageRequest()
        self.fixes = 0  # serial of the last fix
        self.tags: dict[str, None] | None = None  # tags sent; None: all
        self.inside = 0  # number of tags in its view
        self.chosen_s = float("-inf")  # time when its tags were chosen
        self.healths: int | None = None  # serial of the last health, None before the first message
        self.named: dict[str, set[str]] = {"tags": set(), "anchors": set(), "ether": set()}
        """By kind, names whose health was sent on request."""
        self.statuses = 0  # serial of the last status
        self.conditions: dict[str, str] = {}  # of anchors


class _Tag:
    """The last fix of a tag, and its row once requested."""

    __slots__ = ("ended_unix_s", "fix", "received_s", "row", "serial")

    def __init__(self, fix: FixMessage, serial: int, received_s: float, ended_unix_s: float) -> None:
        self.fix, self.serial, self.received_s, self.ended_unix_s = fix, serial, received_s, ended_unix_s
        self.row: list[Any] | None = None


class _Health(NamedTuple):
    """The last health of a node."""

    serial: int
    received_s: float
    health: TagHealth | AnchorHealth | EtherHealth


class SiteState:
    """The newest fix, health and status by name."""

    def __init__(self) -> None:
        self.serial = 0  # counts fixes; a reader with the state at one serial requests those since
        self.statuses: dict[tuple[str, str], StatusMessage] = {}  # by kind and name
        self.now_s = self.unix_s = 0.0
        """Times of the next messages, by the clock of ``expire`` and by Unix time; set by the owner."""
        self.dropped: Counter[str] = Counter()  # wrong messages by kind
        self._tags: dict[str, _Tag] = {}
        self._truths = TruthBuffer()
        self._healths: dict[str, dict[str, _Health]] = {kind: {} for kind in _KINDS.values()}  # by kind and name
        self._health_serial = 0
        self._status_serial = 0
        self._status_serials: dict[tuple[str, str], int] = {}
        self._leaders: set[str] = set()  # anchors that lead the site's time
        self._conditions: dict[str, str] = {}  # of anchors
        self._waiting: list[str] = []  # tags that report and have no position yet
        self._encoded: dict[tuple[int, int], bytes] = {}

    def add_fix(self, fix: FixMessage, now_s: float, unix_s: float) -> None:
        """Add a fix. ``now_s``: time of arrival, by the clock of ``expire``.

        ``unix_s``: end of the fix's last frame, by the owner's wall clock.
        """
        self.serial += 1
        self._tags[fix.tag] = _Tag(fix, self.serial, now_s, unix_s)

    def add_truth(self, truth: TruthMessage) -> None:
        """Add true positions of simulated tags."""
        self._truths.add(truth)

    def add_status(self, status: StatusMessage) -> None:
        """Update whether a node is online."""
        key = status.kind, status.name
        self._status_serial += 1
        self.statuses[key], self._status_serials[key] = status, self._status_serial

    def add_health(self, name: str, health: TagHealth | AnchorHealth | EtherHealth, now_s: float) -> None:
        """Update a node's health."""
        self._health_serial += 1
        self._healths[_KINDS[type(health)]][name] = _Health(self._health_serial, now_s, health)
        if isinstance(health, AnchorHealth):
            (self._leaders.add if health.role == "master" else self._leaders.discard)(name)

    def expire(self, now_s: float) -> None:
        """Drop fixes and health messages older than ``EXPIRY_S``."""
        self._encoded.clear()
        for name in [name for name, tag in self._tags.items() if now_s - tag.received_s > EXPIRY_S]:
            del self._tags[name]
        for healths in self._healths.values():
            for name in [name for name, known in healths.items() if now_s - known.received_s > EXPIRY_S]:
                del healths[name]

    def fixes_since(self, now_s: float, longest_s: float, serial: int = 0) -> list[tuple[FixMessage, float]]:
        """The newest fix of each tag after a serial and within the last ``longest_s``.

        Each comes with the end time of its last frame, as ``unix_s``.
        """
        newer = [tag for tag in self._tags.values() if tag.serial > serial and now_s - tag.received_s <= longest_s]
        return [(tag.fix, tag.ended_unix_s) for tag in newer]

    @property
    def tags(self) -> Collection[str]:
        """Names of the tags with a kept fix."""
        return self._tags.keys()

    # Fixes

    def state_since(self, serial: int) -> bytes:
        """The ``state`` message with all tags that have a newer fix. Readers at the same serial share its bytes."""
        key = serial, self.serial
        if key not in self._encoded:
            if len(self._encoded) >= _MAX_ENCODED:
                self._encoded.clear()
            self._encoded[key] = encode("state", {"unix_s": round(self.unix_s, 3), "tags": self.rows_since(serial)})
        return self._encoded[key]

    def rows_since(self, serial: int) -> list[list[Any]]:
        """Rows of the ``state`` message, with fields in the order of ``page/tracks.js``."""
        return [self._row(tag) for tag in self._tags.values() if tag.serial > serial]

    def _row(self, tag: _Tag) -> list[Any]:
        if tag.row is None:
            tag.row = _row(tag.fix, self._truths.at(tag.fix.tag, tag.fix.unix_s), tag.ended_unix_s)
        return tag.row

    def new_state(self, sent: Sent) -> bytes | None:
        """The ``state`` message with what is new to a page, or None if nothing is.

        At a large site the page gets a part of the tags; ``left`` are those that no longer belong to that part, ``of``
        is the number of all tags, and ``inside`` the number in the page's view.
        """
        if len(self._tags) <= sent.wanted.rows:
            if sent.fixes == self.serial and sent.tags is None:
                return None
            since, sent.fixes = 0 if sent.tags is not None else sent.fixes, self.serial
            sent.tags = None
            return self.state_since(since)
        before = sent.tags if sent.tags is not None else dict.fromkeys(self._tags if sent.fixes else ())
        if sent.tags is None or self.now_s - sent.chosen_s >= CHOICE_S:
            sent.chosen_s = self.now_s
            sent.tags = self._choose(sent, before)
        chosen = {name: self._tags[name] for name in sent.tags if name in self._tags}
        rows = [self._row(tag) for name, tag in chosen.items() if tag.serial > sent.fixes or name not in before]
        left = [name for name in before if name not in sent.tags] if before is not sent.tags else []
        sent.fixes = self.serial
        if not rows and not left:
            return None
        fields = {"tags": rows, "left": left, "of": len(self._tags), "inside": sent.inside}
        return encode("state", {"unix_s": round(self.unix_s, 3), **fields})

    def _choose(self, sent: Sent, before: dict[str, None]) -> dict[str, None]:
        """Choose tags for a page: those that it names, searches, and has in view, first the already sent ones."""
        wanted, text = sent.wanted, sent.wanted.find.lower()
        x1, y1, x2, y2 = wanted.view or (-math.inf, -math.inf, math.inf, math.inf)
        inside = []
        for name, tag in self._tags.items():
            x, y, _ = tag.fix.position_m
            if x1 <= x <= x2 and y1 <= y <= y2 and self.now_s - tag.received_s < UNHEARD_S:
                inside.append(name)
        sent.inside = len(inside)
        named = [name for name in wanted.tags if name in self._tags]
        found = [name for name in self._tags if text in name.lower()] if text else []
        names = dict.fromkeys([*named, *found, *(name for name in inside if name in before), *inside])
        return dict.fromkeys(list(names)[: wanted.rows])

    # Healths and statuses

    @property
    def conditions(self) -> dict[str, str]:
        """The condition of each anchor, by name, as of the last ``judge``."""
        return self._conditions

    def judge(self, now_s: float, *, blind: bool) -> None:
        """Update the condition of each anchor: ``good``, ``warn`` (not synchronised) or ``bad`` (offline).

        While ``blind``, when messages may be missing, silence does not make an anchor ``bad``.
        """
        self._waiting = list(islice((name for name in self._healths["tags"] if name not in self._tags), MAX_HEALTHS))
        found = {}
        for name, known in self._healths["anchors"].items():
            if isinstance(known.health, AnchorHealth):
                health = known.health
                found[name] = "good" if health.synchronised or health.role == "master" else "warn"
                if now_s - known.received_s > SILENT_S and not (blind and self._conditions.get(name) != "bad"):
                    found[name] = "bad"
        for (kind, name), status in self.statuses.items():
            if kind == "anchor" and not status.online:
                found[name] = "bad"
        self._conditions = found

    def new_health(self, sent: Sent) -> bytes:
        """The ``health`` message with what is new to a page. The first one is ``whole``.

        With many tags or anchors it contains only the health of those that the page names, and of leading anchors.
        ``ages``: since each arrived; ``waiting``: tags that report but have no position yet.
        """
        whole, since = sent.healths is None, sent.healths or 0
        named = {"tags": {*sent.wanted.tags}, "anchors": {*sent.wanted.anchors, *self._leaders}}
        new: dict[str, list[Any]] = {}
        ages: dict[str, dict[str, float]] = {}
        for kind, healths in self._healths.items():
            names: Iterable[str] = healths
            if len(healths) > MAX_HEALTHS:
                names = [name for name in named[kind] if name in healths]
            fresh = [n for n in names if healths[n].serial > since or n in named.get(kind, set()) - sent.named[kind]]
            new[kind] = [healths[name].health for name in fresh]
            ages[kind] = {name: round(self.now_s - healths[name].received_s, 2) for name in fresh}
        nodes = []
        if sent.statuses < self._status_serial:
            nodes = [self.statuses[key] for key, serial in self._status_serials.items() if serial > sent.statuses]
        if len(self.statuses) > MAX_HEALTHS:  # if there are many, pages list only the other programs
            nodes = [node for node in nodes if node.kind not in {"tag", "anchor"}]
        changed = {name: kind for name, kind in self._conditions.items() if sent.conditions.get(name) != kind}
        changed |= dict.fromkeys(sent.conditions.keys() - self._conditions.keys(), "unknown")
        sent.healths, sent.named = self._health_serial, named | {"ether": set()}
        sent.statuses, sent.conditions = self._status_serial, self._conditions
        return encode(
            "health",
            {
                "whole": whole,
                "anchors": new["anchors"],
                "tags": new["tags"],
                "ether": new["ether"][-1] if new["ether"] else None,
                "nodes": nodes,
                "conditions": changed,
                "waiting": self._waiting,
                "dropped": self.dropped,
                "ages": ages,
            },
        )


def encode(kind: str, fields: dict[str, Any]) -> bytes:
    """Encode a message to a page."""
    return msgspec.json.encode({"type": kind, **fields})


def error_m(fix: FixMessage, true_m: Vector) -> float:
    """Distance from the true position, without the height if that was given."""
    axes = 2 if fix.height_known else 3
    return math.dist(fix.position_m[:axes], true_m[:axes])


def _row(fix: FixMessage, true_m: Vector | None, ended_unix_s: float) -> list[Any]:
    """Row of one tag in a ``state``, rounded to what a page can show, which halves its size."""
    unix_s = fix.unix_s if abs(fix.unix_s - ended_unix_s) <= MAX_CLOCK_ERROR_S else ended_unix_s
    x, y, z = fix.position_m
    xx, xy, _, _, yy = fix.covariance_m2[:5]
    vx, vy, _ = fix.velocity_mps or (None, None, None)
    verified_s = fix.verified_until_s
    return [
        fix.tag,
        round(x, 4),
        round(y, 4),
        round(z, 4),
        None if vx is None else round(vx, 3),
        None if vy is None else round(vy, 3),
        round(xx, 8),
        round(xy, 8),
        round(yy, 8),
        round(fix.std_m, 5),
        None if true_m is None else round(error_m(fix, true_m), 4),
        None if true_m is None else round(true_m[0], 4),
        None if true_m is None else round(true_m[1], 4),
        len(fix.anchors) or None,
        round(fix.chi2, 3),
        round(unix_s, 4),
        None if fix.hpl_m is None else round(fix.hpl_m, 4),
        fix.alert,
        int(fix.height_known),
        None if fix.height_known else round(math.sqrt(max(fix.covariance_m2[8], 0.0)), 5),
        None if verified_s is None else round(fix.time_s - verified_s, 2),
        None if verified_s is None else round(fix.unverified, 3),
    ]


# The survey of a site for pages: the newest messages of the survey program, and pages' requests to it.
#
# The survey program computes; its messages are forwarded here, and pages' requests are checked and published.

Handler = Callable[[str, bytes], None]
_M = TypeVar("_M", SurveyMessage, WatchMessage)


class Newest(Generic[_M]):
    """The newest message of a retained topic, and its age.

    The first one after connecting may be old, and only its own time tells its age. Later ones are new on arrival,
    whatever their sender's clock.
    """

    def __init__(self, name: str, kind: type[_M], clock: Callable[[], float], wall_clock: Callable[[], float]) -> None:
        self.name = name
        self.message: _M | None = None
        self._kind: type[_M] = kind
        self._clock, self._wall_clock = clock, wall_clock
        self._first = True
        self._made_s = 0.0

    def expect_kept(self) -> None:
        """Expect that the next message may be a retained one."""
        self._first = True

    def read(self, payload: bytes) -> None:
        """Replace the message. An empty payload removes it. Raises WrongMessageError."""
        self.message = read_message(payload, self._kind) if payload else None
        self._made_s = self._clock()
        if self.message is not None and self._first:
            self._made_s -= max(0.0, self._wall_clock() - self.message.unix_s)
        self._first = False

    def age_s(self) -> float | None:
        """Seconds since the message was made, or None without one."""
        return None if self.message is None else self._clock() - self._made_s

    def encoded(self) -> bytes:
        """Message for pages."""
        return encode(self.name, {self.name: self.message, "age_s": self.age_s()})


class SiteSurvey:
    """The newest messages of the survey program. Each change is passed to ``broadcast`` for the open pages."""

    def __init__(
        self,
        name: str,
        broadcast: Callable[[str, bytes], None],
        clock: Callable[[], float],
        wall_clock: Callable[[], float],
    ) -> None:
        """``name``: of the dashboard on MQTT."""
        self._name, self._broadcast = name, broadcast
        self.survey = Newest("survey", SurveyMessage, clock, wall_clock)
        """State of the survey program."""
        self.watch = Newest("watch", WatchMessage, clock, wall_clock)
        """Findings of the watch of the anchors."""

    def handlers(self, site_id: int) -> dict[str, Handler]:
        """Topics to subscribe to, with their handlers."""
        return {
            survey_topic(site_id): partial(self._on, self.survey),
            watch_topic(site_id): partial(self._on, self.watch),
        }

    def messages(self) -> dict[str, bytes]:
        """The messages that a new page needs, by kind."""
        return {one.name: one.encoded() for one in (self.survey, self.watch) if one.message is not None}

    def expect_kept(self) -> None:
        """Expect retained messages, as the broker is connected again."""
        self.survey.expect_kept()
        self.watch.expect_kept()

    def facts_message(self, body: bytes) -> SurveyFactsMessage:
        """Check facts from a page's user. Returns the message to publish. Raises BadFactsError."""
        try:
            message = read_message(body, SurveyFactsMessage)
        except WrongMessageError as error:
            raise BadFactsError(f"these are no facts of a survey: {error}") from None
        check_facts(message)
        return replace(message, by=self._name)

    def save_message(self, body: bytes) -> SurveySaveMessage:
        """Check a request to save a result. Returns the message to publish. Raises BadFactsError and HTTPException."""
        try:
            serial = read_message(body, _SaveRequest).serial
        except WrongMessageError as error:
            raise BadFactsError(f'this is no request to save, such as {{"serial": 12}}: {error}') from None
        newest = self.survey.message
        if newest is None or newest.survey is None:
            raise HTTPException(409, "the survey has no result yet")
        if not 0 <= serial <= newest.serial:
            raise HTTPException(409, f"there is no result {serial}; the newest is {newest.serial}")
        return SurveySaveMessage(self._name, serial)

    def _on(self, newest: Newest[_M], _topic: str, payload: bytes) -> None:
        newest.read(payload)
        self._broadcast(newest.name, newest.encoded())


class _SaveRequest(Struct):
    """A page's request to save a result."""

    serial: int
