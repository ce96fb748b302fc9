"""The state of the site for pages, gathered from messages, and the parts that are new to each page. No I/O."""

import math
from collections.abc import Callable, Iterable
from itertools import islice
from typing import Annotated, Any, Final, TypeVar

import msgspec
from msgspec import Meta, Struct
from msgspec.structs import replace
from starlette.exceptions import HTTPException

from skyless.run.mqtt.messages import (
    AnchorHealth,
    FixMessage,
    StatusMessage,
    SurveyFactsMessage,
    SurveyMessage,
    SurveySaveMessage,
    TruthBuffer,
    TruthMessage,
    Vector,
    WatchMessage,
    WrongMessageError,
    read_message,
)
from skyless.run.site_feed import M, Newest, SiteFeed
from skyless.run.site_table import THRESHOLDS, Node, SiteTable
from skyless.run.survey.checked_facts import BadFactsError, check_facts

MAX_CLOCK_ERROR_S: Final = 0.5
"""The time of a fix by its tag's clock is replaced if it is wrong by more than this."""

MAX_ROWS: Final = 2_000
"""Maximum number of tags sent to a page. With more, tags on its map and tags that it names or searches are sent."""

MAX_HEALTHS: Final = 200
"""With more tags, or anchors, a page gets only the health of those that it names."""

_MAX_NAMED: Final = 200

_MAX_ENCODED: Final = 16
_Request = TypeVar("_Request", bound=Struct)
_GROUPS: Final = {"anchors": "anchor", "tags": "tag", "ether": "ether"}
"""Kinds of nodes by their name in messages to pages."""

CHOICE_S: Final = 0.5
"""Interval at which the tags for a page are chosen again."""


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


class SiteState:
    """What pages get of a site's table: rows of tags, healths and statuses."""

    def __init__(self, table: SiteTable) -> None:
        self.table = table
        self.now_s = self.unix_s = 0.0
        """Times of the next messages, by the table's clock and by Unix time; set by the owner."""
        self._truths = TruthBuffer()
        self._leaders: set[str] = set()  # anchors that lead the site's time
        self.conditions: dict[str, str] = {}
        """The condition of each anchor, by name, as of the last ``judge``."""
        self._waiting: list[str] = []  # tags that report and have no position yet
        self._encoded: dict[tuple[int, int], bytes] = {}

    def add_truth(self, truth: TruthMessage) -> None:
        """Add true positions of simulated tags."""
        self._truths.add(truth)

    def forget_encoded(self) -> None:
        """Encode rows again, as truth or time may have changed them."""
        self._encoded.clear()

    # Fixes

    def state_since(self, serial: int) -> bytes:
        """The ``state`` message with all tags that have a newer fix. Readers at the same serial share its bytes."""
        key = serial, self.table.fixes_serial
        if key not in self._encoded:
            if len(self._encoded) >= _MAX_ENCODED:
                self._encoded.clear()
            self._encoded[key] = encode("state", {"unix_s": round(self.unix_s, 3), "tags": self.rows_since(serial)})
        return self._encoded[key]

    def rows_since(self, serial: int) -> list[list[Any]]:
        """Rows of the ``state`` message, with fields in the order of ``page/tracks.js``."""
        return [self._row(tag) for tag in self.table.fixed.values() if tag.serial > serial]

    def _row(self, tag: Node) -> list[Any]:
        fix, table = tag.fix, self.table
        assert fix is not None
        if tag.row is None:
            slept_s = max(0.0, tag.asleep_until_s - tag.fix_s)
            presence = table.fresh_for_s(tag), slept_s, slept_s + table.gone_after_s(tag)
            if tag.is_gone:  # its program has ended
                presence = 0.0, 0.0, 0.0
            truth = self._truths.at(fix.tag, fix.unix_s)
            tag.row = [*_row(fix, truth, tag.ended_unix_s), *(round(one_s, 1) for one_s in presence)]
        return tag.row

    def new_state(self, sent: Sent) -> bytes | None:
        """The ``state`` message with what is new to a page, or None if nothing is.

        At a large site the page gets a part of the tags; ``left`` are those that no longer belong to that part, ``of``
        is the number of all tags, and ``inside`` the number in the page's view.
        """
        if len(self.table.fixed) <= sent.wanted.rows:
            serial = self.table.fixes_serial
            if sent.fixes == serial and sent.tags is None:
                return None
            since, sent.fixes = 0 if sent.tags is not None else sent.fixes, serial
            sent.tags = None
            return self.state_since(since)
        tags = self.table.fixed
        before = sent.tags if sent.tags is not None else dict.fromkeys(tags if sent.fixes else ())
        if sent.tags is None or self.now_s - sent.chosen_s >= CHOICE_S:
            sent.chosen_s = self.now_s
            sent.tags = self._choose(sent, before)
        chosen = {name: tags[name] for name in sent.tags if name in tags}
        rows = [self._row(tag) for name, tag in chosen.items() if tag.serial > sent.fixes or name not in before]
        left = [name for name in before if name not in sent.tags] if before is not sent.tags else []
        sent.fixes = self.table.fixes_serial
        if not rows and not left:
            return None
        fields = {"tags": rows, "left": left, "of": len(tags), "inside": sent.inside}
        return encode("state", {"unix_s": round(self.unix_s, 3), **fields})

    def _choose(self, sent: Sent, before: dict[str, None]) -> dict[str, None]:
        """Choose tags for a page: those that it names, searches, and has in view, first the already sent ones."""
        wanted, text = sent.wanted, sent.wanted.find.lower()
        x1, y1, x2, y2 = wanted.view or (-math.inf, -math.inf, math.inf, math.inf)
        inside, tags = [], self.table.fixed
        for name, tag in tags.items():
            assert tag.fix is not None
            x, y, _ = tag.fix.position_m
            if x1 <= x <= x2 and y1 <= y <= y2 and not tag.is_gone:
                inside.append(name)
        sent.inside = len(inside)
        named = [name for name in wanted.tags if name in tags]
        found = [name for name in tags if text in name.lower()] if text else []
        names = dict.fromkeys([*named, *found, *(name for name in inside if name in before), *inside])
        return dict.fromkeys(list(names)[: wanted.rows])

    # Healths and statuses

    def judge(self, now_s: float, *, blind: bool) -> None:
        """Update the condition of each anchor: ``good``, ``warn`` (not synchronised) or ``bad`` (offline).

        While ``blind``, when messages may be missing, silence does not make an anchor ``bad``.
        """
        table = self.table
        waiting = (name for name, tag in table.senders("tag") if tag.health is not None and tag.fix is None)
        self._waiting = list(islice(waiting, MAX_HEALTHS))
        found, self._leaders = {}, set()
        for name, anchor in table.all("anchor").items():
            health = anchor.health
            if isinstance(health, AnchorHealth):
                if health.role == "master":
                    self._leaders.add(name)
                found[name] = "good" if health.synchronised or health.role == "master" else "warn"
                is_silent = now_s - anchor.health_s > THRESHOLDS.report_s
                if is_silent and not (blind and self.conditions.get(name) != "bad"):
                    found[name] = "bad"
            if anchor.online is False:
                found[name] = "bad"
        self.conditions = found

    def new_health(self, sent: Sent) -> bytes:
        """The ``health`` message with what is new to a page. The first one is ``whole``.

        With many tags or anchors it contains only the health of those that the page names, and of leading anchors.
        ``ages``: since each arrived; ``waiting``: tags that report but have no position yet.
        """
        table, whole, since = self.table, sent.healths is None, sent.healths or 0
        named = {"tags": {*sent.wanted.tags}, "anchors": {*sent.wanted.anchors, *self._leaders}}
        new: dict[str, list[Any]] = {}
        ages: dict[str, dict[str, float]] = {}
        for group, kind in _GROUPS.items():
            healths = {name: node for name, node in table.senders(kind) if node.health is not None}
            names: Iterable[str] = healths
            if len(healths) > MAX_HEALTHS:
                names = [name for name in named[group] if name in healths]
            more = named.get(group, set()) - sent.named[group]
            fresh = [name for name in names if healths[name].health_serial > since or name in more]
            new[group] = [healths[name].health for name in fresh]
            ages[group] = {name: round(self.now_s - healths[name].health_s, 2) for name in fresh}
        nodes: list[StatusMessage] = []
        if sent.statuses < table.statuses_serial:
            there = {kind: [node.status for _, node in table.senders(kind) if node.status] for kind in table.kinds}
            newer = [
                node for kind in table.kinds for _, node in table.senders(kind) if node.status_serial > sent.statuses
            ]
            nodes = [node.status for node in sorted(newer, key=lambda node: node.status_serial) if node.status]
            if sum(map(len, there.values())) > MAX_HEALTHS:  # then pages list only the other programs
                nodes = [status for status in nodes if status.kind not in {"tag", "anchor"}]
        changed = {name: kind for name, kind in self.conditions.items() if sent.conditions.get(name) != kind}
        changed |= dict.fromkeys(sent.conditions.keys() - self.conditions.keys(), "unknown")
        sent.healths, sent.named = table.healths_serial, named | {"ether": set()}
        sent.statuses, sent.conditions = table.statuses_serial, self.conditions
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
                "dropped": table.drops,
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
        self.survey = Newest[SurveyMessage](clock, wall_clock)
        """State of the survey program."""
        self.watch = Newest[WatchMessage](clock, wall_clock)
        """Findings of the watch of the anchors."""

    def follow(self, feed: SiteFeed) -> None:
        """Get the messages of a feed."""
        feed.on(SurveyMessage, lambda message, _: self._on("survey", self.survey, message))
        feed.on(WatchMessage, lambda message, _: self._on("watch", self.watch, message))

    def messages(self) -> dict[str, bytes]:
        """The messages that a new page needs, by kind."""
        found = {} if self.survey.message is None else {"survey": _encoded("survey", self.survey)}
        return found if self.watch.message is None else found | {"watch": _encoded("watch", self.watch)}

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

    def _on(self, name: str, newest: Newest[M], message: M | None) -> None:
        newest.replace(message)
        self._broadcast(name, _encoded(name, newest))


def _encoded(name: str, newest: Newest[M]) -> bytes:
    return encode(name, {name: newest.message, "age_s": newest.age_s()})


class _SaveRequest(Struct):
    """A page's request to save a result."""

    serial: int
