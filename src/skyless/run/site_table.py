"""Who is at a site, and whether it is still there: the one table of which all readers of a live site are views.

No I/O; ``now_s`` is the reader's own clock, which only goes forward: arrival decides, whatever senders' clocks say. A
recording's readers use its times. ``docs/live_site.md`` has the rules for people.

A tag is **fresh** while its newest fix is no older than a few of its own intervals, and **gone** when it has been
silent for longer than some more of them. The interval is learnt, or stated by the tag. Silence counts only while
messages can arrive, and not while a tag is **asleep** by its own statement. What has been gone for a day is
**forgotten**.
"""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from heapq import heappop, heappush
from typing import Final, Literal, NamedTuple

from msgspec import UNSET, Struct
from msgspec.structs import replace

from skyless.core.site import Site
from skyless.run.mqtt.messages import AnchorHealth, Asset, EtherHealth, FixMessage, StatusMessage, TagHealth
from skyless.site.anchor_names import anchor_name

Health = TagHealth | AnchorHealth | EtherHealth
Presence = Literal["fresh", "late", "asleep", "gone"]
"""``late``: neither fresh nor gone."""


class Thresholds(Struct, frozen=True):
    """All times from which a view decides what is still there."""

    fresh_s: float = 2.5
    fresh_intervals: float = 2.5
    """A fix is fresh for the longer of the two: one may be missed."""
    gone_s: float = 10.0
    gone_intervals: float = 4.0
    """A tag is gone after the longer of the two: three fixes in a row may be missed."""
    longest_s: float = 900.0
    """No silence is longer than this, unless the tag says that it sleeps. Also that of a tag of unknown interval."""
    report_s: float = 3.5
    """Programs report once a second; one that has been silent for longer is offline, whatever its status says."""
    grace_s: float = 5.0
    """What has just started, or a connection just made, may be incomplete for this long."""
    site_s: float = 5.0
    """A site reports to its hub once a second, over a line that may be slow; after this time it is cut off."""
    watch_s: float = 30.0
    """The watch of the anchors reports every 10 s at least."""
    forgotten_s: float = 86_400.0


THRESHOLDS: Final = Thresholds()

MAX_NAMES: Final = {"tag": 200_000, "anchor": 20_000}
"""Most names admitted of each kind."""
MAX_OTHERS: Final = 2_000
"""Most names admitted of all other kinds together."""

_LOOK_S: Final = 0.1  # shortest time between two looks at a tag that is there
_FORGET_PERIOD_S: Final = 60.0
_COUNT_S: Final = 10.0
"""Interval at which the count of refused names starts again, so that it falls when they end."""

_SET_BACK_S: Final = 10.0
"""A fix older than the newest by more than this is of a clock that was set back; others that are older are late."""

# A tag's own interval, from its gaps. Only gaps that can change an answer are kept; shorter ones change nothing.
_SHORT_S: Final = 1.5
_MAX_GAPS: Final = 8
_KNOWN_S: Final = 10.0
"""The interval of a tag heard for a shorter time is unknown: it may send in bursts, with long silence between them."""
_LEARN_S: Final = 1.0  # shortest time between two looks at the gaps of a tag that sends often
_MEMORY: Final = 10.0
"""A gap is remembered for this many times its length."""
_SHARE: Final = 0.15
"""Gaps that fill this share of the remembered time are the tag's rhythm. A single gap of a tag that has been heard for
long fills 10 %, and is an outage."""
_ALIKE: Final = 0.8
"""A gap counts as being as long as another if it has this share of its length."""


class _Gap(NamedTuple):
    """A gap between two fixes of a tag."""

    end_s: float
    length_s: float
    was_gone: bool
    """Whether the tag had gone meanwhile: one such gap is an absence, and only two are its rhythm."""


class Node:
    """A tag, an anchor, the emulated air or another program of a site."""

    __slots__ = (
        *("asleep_until_s", "codes_s", "ended_unix_s", "first_s", "fix", "fix_s", "gaps"),
        *("due_s", "health", "health_s", "health_serial", "heard_s", "is_gone", "learn_s", "learnt_s"),
        *("name", "previous", "row", "sends", "serial", "since_s", "stated_s", "status", "status_serial"),
        *("used_s", "used_until_s"),
    )

    def __init__(self, name: str) -> None:
        self.name = name
        self.status: StatusMessage | None = None
        self.since_s: float | None = None  # time when it came online, or of its first message
        self.health: Health | None = None
        self.previous: Health | None = None  # the health before
        self.health_s = float("-inf")  # arrival of the health
        self.fix: FixMessage | None = None  # the newest fix that was passed on
        self.ended_unix_s = 0.0  # end of its last frame, by the reader's wall clock
        self.fix_s = float("-inf")  # arrival of its newest fix, passed on or not
        self.sends = False  # whether messages of its own arrive; otherwise it is known only from batches, or expected
        self.first_s = float("-inf")  # arrival of the first fix since it was last gone
        self.is_gone = True  # as of the last ``tick``, fix or status
        self.due_s = float("inf")  # when ``tick`` looks at it next
        self.heard_s: float | None = None  # arrival of the first fix of all
        self.gaps: list[_Gap] = []  # the last long gaps between fixes
        self.learnt_s = 0.0  # the interval that the gaps show
        self.learn_s = float("-inf")  # time when they are looked at again, besides after each gap
        self.stated_s = 0.0  # the interval that the tag states
        self.asleep_until_s = float("-inf")
        self.used_s = float("-inf")  # arrival of the last fix that used this anchor
        self.used_until_s = float("-inf")  # until when a fix that used it is fresh
        self.codes_s: float | None = None  # time since when it states that its beacons have codes
        self.serial = self.health_serial = self.status_serial = 0
        """Count of the table at the last change, for readers that want what is new."""
        self.row: list[object] | None = None  # the page's row of the fix, once asked for

    @property
    def online(self) -> bool | None:
        """Whether its status says that it is online; None without one."""
        return None if self.status is None else self.status.online

    @property
    def host(self) -> str:
        """Name of its computer; empty if unknown."""
        return "" if self.status is None else self.status.host

    def begin(self, now_s: float) -> None:
        """Mark it present from now, unless it already is."""
        if self.since_s is None:
            self.since_s = now_s

    def reports(self, now_s: float) -> bool:
        """Whether the node is online with a fresh health message."""
        return now_s - self.health_s < THRESHOLDS.report_s and (self.status is None or self.status.online)

    def codes_for_s(self, now_s: float) -> float:
        """How long its beacons have had codes, as it states; 0 without codes."""
        return 0.0 if self.codes_s is None else now_s - self.codes_s

    @property
    def interval_s(self) -> float | None:
        """The interval between its fixes, 0 if it is so short that it changes nothing; None while it is unknown."""
        is_known = self.gaps or self.stated_s or (self.heard_s is not None and self.fix_s - self.heard_s >= _KNOWN_S)
        return max(self.learnt_s, self.stated_s) if is_known else None

    def gone_after_s(self, longest_s: float) -> float:
        """How long it must be silent to be gone, at most ``longest_s``."""
        interval_s = self.interval_s
        if interval_s is None:
            return longest_s
        return min(max(THRESHOLDS.gone_s, THRESHOLDS.gone_intervals * interval_s), longest_s)

    def note_fix(self, now_s: float, ready_s: float, longest_s: float) -> None:
        """Note the arrival of a fix, and learn from the gap before it, as far as messages could arrive in it.

        A gap of more than ``longest_s`` is no rhythm: the tag was away.
        """
        gap_s = now_s - max(self.fix_s, ready_s, self.asleep_until_s)
        if self.heard_s is None:
            self.heard_s = now_s
        elif _SHORT_S < gap_s <= longest_s:
            was_gone = self.is_gone or gap_s >= self.gone_after_s(longest_s)
            self.gaps, self.learn_s = [*self.gaps[1 - _MAX_GAPS :], _Gap(now_s, gap_s, was_gone)], now_s
        self.fix_s = now_s
        if self.is_gone:
            self.is_gone, self.first_s = False, now_s
        if self.gaps and now_s >= self.learn_s:
            self.learn_s = now_s + _LEARN_S
            self.gaps = [gap for gap in self.gaps if now_s - gap.end_s <= _MEMORY * gap.length_s]
            rhythms = (gap.length_s for gap in self.gaps if self._is_rhythm(gap.length_s, now_s))
            self.learnt_s = max(rhythms, default=0.0)

    def _is_rhythm(self, gap_s: float, now_s: float) -> bool:
        """Whether gaps about this long fill a share of the time in which they are remembered."""
        assert self.heard_s is not None
        span_s = min(_MEMORY * gap_s, now_s - self.heard_s)
        alike = [gap for gap in self.gaps if gap.length_s >= _ALIKE * gap_s and now_s - gap.end_s <= span_s]
        is_absence = len(alike) == 1 and alike[0].was_gone
        return not is_absence and sum(gap.length_s for gap in alike) >= _SHARE * span_s


class SiteTable:
    """The nodes of one site, with their newest messages and the times at which these arrived."""

    def __init__(
        self, now_s: float, host: str = "", *, connected: bool = True, drops: Counter[str] | None = None
    ) -> None:
        """``host``: this computer's name, as nodes state theirs. ``connected``: whether messages can arrive.

        ``drops``: where fixes that are not used are counted, by reason, such as a feed's.
        """
        self.host, self.drops = host, Counter() if drops is None else drops
        self.site: Site | None = None
        self._addresses = False
        self.site_anchors: tuple[str, ...] = ()
        """Names of the site's anchors, as far as admitted."""
        self.fixed: dict[str, Node] = {}
        """Tags of which a fix is known."""
        self.batched: dict[str, Node] = {}
        """Tags of which no message of their own has arrived, as their fixes come in batches."""
        self.fixes_serial = self.healths_serial = self.statuses_serial = 0
        """Counts of changes. A reader that has the state at one serial asks for what is newer."""
        self.ready_s = now_s
        """Since when messages can arrive."""
        self.connected, self.was_connected = connected, connected
        self.batches_connected = True
        """Whether batches, if a site has them, can arrive."""
        self.longest_s = THRESHOLDS.longest_s
        """The site's value of ``Thresholds.longest_s``."""
        self.longest_of_groups_s: Mapping[str, float] = {}
        """The same for groups of assets."""
        self.group_of: Mapping[str, str] = {}
        """Groups by tag."""
        self.roster = Roster()
        self._lost_s = now_s
        self._due: list[tuple[float, str]] = []  # heap of times at which tags that are there are looked at
        self._forget_s = now_s
        self._nodes: defaultdict[str, dict[str, Node]] = defaultdict(dict)  # by kind and name
        self._sorted: dict[str, list[tuple[str, Node]]] = {}

    # What arrives

    def set_connected(self, *, connected: bool, now_s: float, batches: bool = False) -> None:
        """Note whether messages, or batches, can arrive."""
        heard = self.hears
        if batches:
            self.batches_connected = connected
        else:
            self.connected, self.was_connected = connected, True
        if self.hears and not heard:
            self.ready_s = now_s
        elif heard and not self.hears:
            self._lost_s = now_s

    @property
    def hears(self) -> bool:
        """Whether all messages can arrive; otherwise silence means nothing."""
        return self.connected and self.batches_connected

    def set_site(self, site: Site, now_s: float, *, addresses: bool = False) -> None:
        """Update the site, and with it the expected anchors; ``addresses``: these are called by their MAC addresses."""
        self._addresses = addresses
        if self.site is None:
            self.ready_s = now_s
        self.site = site
        names = (*(str(one.id) for one in site.anchors), *(str(one.id) for one in site.unplaced))
        self.site_anchors = tuple(name for name in names if self.roster.admits("anchor", name))
        tags = site.tags
        self.longest_s = THRESHOLDS.longest_s if tags.longest_silence_s is UNSET else tags.longest_silence_s
        self.longest_of_groups_s = {} if tags.group_silence_s is UNSET else tags.group_silence_s

    def set_assets(self, assets: Mapping[str, Asset]) -> None:
        """Update the groups of tags."""
        self.group_of = {tag: asset.group for tag, asset in assets.items()} if self.longest_of_groups_s else {}

    def spelled(self, anchors: Iterable[str]) -> list[str]:
        """Names of anchors for people, of those in messages and topics."""
        return [
            anchor_name(int(name), addresses=True) if self._addresses and name.isdecimal() else name for name in anchors
        ]

    @property
    def is_bare(self) -> bool:
        """Whether no anchor of the site has a position yet, so that there can be no fixes."""
        return self.site is not None and not self.site.anchors

    def add(self, kind: str, name: str, *, sends: bool = False) -> Node | None:
        """The node of this name, added if need be; None if there are too many. ``sends``: it has sent a message."""
        node = self.get(kind, name)
        if node is None and self.roster.admits(kind, name):
            node = self._nodes[kind][name] = Node(name)
            if kind == "tag":
                self.batched[name] = node
        if node is not None and sends and not node.sends:
            node.sends = True
            self._sorted.pop(kind, None)
            if kind == "tag":
                del self.batched[name]
        return node

    def add_status(self, status: StatusMessage, now_s: float) -> bool:
        """Add a status, which says whether a node is online. Returns whether a tag that was there has gone with it."""
        node = self.add(status.kind, status.name, sends=True)
        if node is None:
            return False
        before = node.status
        if status.online and (before is None or not before.online or before.unix_s != status.unix_s):
            node.since_s = now_s
        self.statuses_serial += 1
        if not status.host and node.host:
            status = replace(status, host=node.host)
        node.status, node.status_serial = status, self.statuses_serial
        if status.online:
            return False
        node.previous, node.codes_s = None, None
        if node.asleep_until_s > now_s:
            return False  # a tag that disconnects as it falls asleep
        was_there, node.is_gone = not node.is_gone, True
        if node.fix is not None:
            self._changed(node)
        return was_there

    def add_health(self, kind: str, name: str, health: Health, now_s: float) -> None:
        """Add a node's health."""
        node = self.add(kind, name, sends=True)
        if node is None:
            return
        node.begin(now_s)
        self.healths_serial += 1
        node.previous, node.health, node.health_s = node.health, health, now_s
        node.health_serial = self.healths_serial
        if isinstance(health, AnchorHealth):
            if health.chain is None or health.code_fault is not None:
                node.codes_s = None
            elif node.codes_s is None:
                node.codes_s = now_s
        elif isinstance(health, TagHealth):
            fresh_s, sleep_s = self.fresh_for_s(node), _duration_s(health.sleeps_s)
            node.stated_s = _duration_s(health.interval_s)
            if sleep_s or node.asleep_until_s > now_s or self.fresh_for_s(node) != fresh_s:
                self._changed(node)
            node.asleep_until_s = now_s + sleep_s if sleep_s else min(node.asleep_until_s, now_s)
            if not node.is_gone:
                self._look_at(node, now_s + THRESHOLDS.gone_s)

    def add_fix(self, fix: FixMessage, now_s: float, *, batched: bool = False) -> Node | None:
        """Add a tag's fix; None for one that is late or repeated, or of a tag that is not admitted.

        Two sources may bring the same fix, as messages and batches do: the second one is a repetition. ``batched``: the
        fix is one of those of which ``hear`` was notified.
        """
        node = self.add("tag", fix.tag, sends=not batched)
        if node is None:
            return None
        if node.fix is not None and _is_late(fix, node.fix):
            self.drops["late-fix"] += 1
            return None
        if not batched or node.is_gone:
            self._note(node, now_s)
        node.fix = fix
        self.fixed[fix.tag] = node
        self._changed(node)
        anchors, until_s = self._nodes["anchor"], now_s + self.fresh_for_s(node)
        for anchor in map(str, fix.anchors):
            used = anchors.get(anchor)
            if used is None or not used.sends:
                used = self.add("anchor", anchor, sends=True)
            if used is not None:
                used.used_s = now_s
                if until_s > used.used_until_s:  # noqa: PLR1730 - max() takes 5 % of all the time for a fix
                    used.used_until_s = until_s
        return node

    def hear(self, tags: Iterable[str], now_s: float) -> dict[str, float]:
        """Note that batches have fixes of these tags, which may not be passed to ``add_fix``.

        Returns the times after which those of them that send rarely are gone.
        """
        known, rare = self._nodes["tag"], {}
        for name in tags:
            node = known.get(name)
            if node is None or node.is_gone or node.gaps or now_s - node.fix_s > _SHORT_S:
                node = self.add("tag", name)
                if node is not None:
                    self._note(node, now_s)
                    if node.gaps:
                        rare[name] = self.gone_after_s(node)
            else:  # the usual case, quickly: there may be 100,000
                node.fix_s = now_s
        return rare

    def _changed(self, tag: Node) -> None:
        """Let readers that ask for what is newer get a tag's newest fix, or what has become of it."""
        self.fixes_serial += 1
        tag.serial, tag.row = self.fixes_serial, None

    def _look_at(self, tag: Node, at_s: float) -> None:
        """Let ``tick`` look at a tag then, unless it does so before."""
        if at_s < tag.due_s:
            tag.due_s = at_s
            heappush(self._due, (at_s, tag.name))

    def _note(self, node: Node, now_s: float) -> None:
        self._look_at(node, now_s + THRESHOLDS.gone_s)
        if node.asleep_until_s > now_s and now_s - node.health_s > THRESHOLDS.report_s:
            node.asleep_until_s = now_s  # it has woken without a word
        node.begin(now_s)
        node.note_fix(now_s, self.ready_s, self.longest_silence_s(node))

    # What is there

    @property
    def is_empty(self) -> bool:
        """Whether no node is known."""
        return not any(self._nodes.values())

    def get(self, kind: str, name: str) -> Node | None:
        """The node of this kind and name, if known."""
        nodes = self._nodes.get(kind)
        return None if nodes is None else nodes.get(name)

    def all(self, kind: str) -> Mapping[str, Node]:
        """All nodes of a kind, by name."""
        return self._nodes.get(kind, {})

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of which nodes are known."""
        return tuple(kind for kind, nodes in self._nodes.items() if nodes)

    def senders(self, kind: str) -> list[tuple[str, Node]]:
        """Names and nodes of a kind that have sent messages, and anchors in use, in natural order."""
        if kind not in self._sorted:
            found = [(name, node) for name, node in self._nodes[kind].items() if node.sends]
            found.sort(key=lambda item: (len(item[0]) if item[0].isdecimal() else 1 << 30, item[0]))
            self._sorted[kind] = found
        return self._sorted[kind]

    def in_grace(self, now_s: float, node: Node | None = None) -> bool:
        """Whether the connection, or a node, is too young to be complete, such as for a tag's first fix."""
        if node is None:
            return now_s - self.ready_s < THRESHOLDS.grace_s
        since_s = max(self.ready_s, node.since_s or self.ready_s)
        return now_s - since_s < max(THRESHOLDS.grace_s, self.fresh_for_s(node))

    def silent_s(self, tag: Node, now_s: float) -> float:
        """For how long a tag has had no fix, without the time in which none could arrive and in which it slept."""
        until_s = now_s if self.hears else self._lost_s
        return max(0.0, until_s - max(tag.fix_s, self.ready_s, tag.asleep_until_s))

    def longest_silence_s(self, tag: Node) -> float:
        """The longest silence of a tag that is there, by the site's settings."""
        group = self.group_of.get(tag.name)
        return self.longest_s if group is None else self.longest_of_groups_s.get(group, self.longest_s)

    def fresh_for_s(self, tag: Node) -> float:
        """For how long a fix of a tag is fresh."""
        if not tag.gaps and not tag.stated_s:  # the usual case
            return THRESHOLDS.fresh_s
        interval_s = tag.interval_s or 0.0
        return min(max(THRESHOLDS.fresh_s, THRESHOLDS.fresh_intervals * interval_s), self.longest_silence_s(tag))

    def gone_after_s(self, tag: Node) -> float:
        """For how long a tag must be silent to be gone."""
        return tag.gone_after_s(self.longest_silence_s(tag))

    def is_fresh(self, tag: Node, now_s: float) -> bool:
        """Whether a tag's newest fix is fresh, and its program has not ended since."""
        return not tag.is_gone and now_s - tag.fix_s < self.fresh_for_s(tag)

    def is_there(self, tag: Node, now_s: float) -> bool:
        """Whether a tag has had a fix and is not gone."""
        return not tag.is_gone and self.silent_s(tag, now_s) < self.gone_after_s(tag)

    def presence(self, tag: Node, now_s: float) -> Presence:
        """Whether a tag is there, in a word."""
        if self.is_fresh(tag, now_s):
            return "fresh"
        if tag.asleep_until_s > now_s:
            return "asleep"
        return "late" if self.is_there(tag, now_s) else "gone"

    def tick(self, now_s: float) -> list[str]:
        """Return the tags that have gone since the last call, and forget what has been gone for long."""
        gone = []
        while self._due and self._due[0][0] <= now_s:
            due_s, name = heappop(self._due)
            tag = self.get("tag", name)
            if tag is None or tag.due_s != due_s:
                continue
            tag.due_s = float("inf")
            if tag.is_gone:
                continue
            left_s = self.gone_after_s(tag) - self.silent_s(tag, now_s)
            if left_s <= 0.0:
                tag.is_gone = True
                gone.append(name)
            else:
                wait_s = min(max(left_s, _LOOK_S), THRESHOLDS.gone_s)  # its interval may become known meanwhile
                asleep_s = min(max(0.0, tag.asleep_until_s - now_s), THRESHOLDS.longest_s)  # it may wake earlier
                self._look_at(tag, now_s + asleep_s + wait_s)
        if now_s - self._forget_s >= _FORGET_PERIOD_S:
            self._forget_s = now_s
            self._forget(now_s)
        return gone

    def _forget(self, now_s: float) -> None:
        """Forget nodes that have been neither online nor heard for long, but for the site's own anchors."""
        last_s, anchors = now_s - THRESHOLDS.forgotten_s, self.site_anchors
        for kind, nodes in self._nodes.items():
            for name, node in list(nodes.items()):
                newest_s = max(node.fix_s, node.health_s, node.since_s or float("-inf"))
                is_old = node.is_gone and not node.online and newest_s < last_s
                if is_old and not (kind == "anchor" and name in anchors):
                    del nodes[name]
                    self.roster.remove(kind, name)
                    self._sorted.pop(kind, None)
                    if kind == "tag":
                        self.fixed.pop(name, None)
                        self.batched.pop(name, None)


def _is_late(fix: FixMessage, newest: FixMessage) -> bool:
    """Whether a fix was made no later than the newest, by its number and its time."""
    return 0.0 <= newest.unix_s - fix.unix_s <= _SET_BACK_S and fix.serial <= newest.serial


def _duration_s(stated_s: float | None) -> float:
    """A time that a tag states, as far as it can be believed."""
    return 0.0 if stated_s is None else min(max(stated_s, 0.0), THRESHOLDS.forgotten_s)


class Roster:
    """The admitted names of one site, in bounded memory: the first ones."""

    def __init__(self) -> None:
        self._names: dict[str, set[str]] = {}
        self._left_out: dict[str, set[int]] = {}  # hashes of names refused since the last count
        self._counted: dict[str, int] = {}
        self._counted_s = float("-inf")

    def admits(self, kind: str, name: str) -> bool:
        """Whether a name is admitted."""
        group, entry, most = _group(kind, name)
        names = self._names.setdefault(group, set())
        if entry in names:
            return True
        if len(names) < most:
            names.add(entry)
            return True
        left_out = self._left_out.setdefault(group, set())
        if len(left_out) < most:
            left_out.add(hash(entry))
        return False

    def remove(self, kind: str, name: str) -> None:
        """Make room for another name."""
        group, entry, _ = _group(kind, name)
        self._names.get(group, set()).discard(entry)

    def size(self, kind: str) -> int:
        """Number of admitted names of a kind."""
        return len(self._names.get(kind, ()))

    def left_out(self, kind: str, now_s: float) -> int:
        """Number of refused names of a kind, tag or anchor, counted at most up to the limit of admitted ones."""
        if now_s - self._counted_s >= _COUNT_S:
            self._counted = {group: len(names) for group, names in self._left_out.items()}
            self._left_out, self._counted_s = {}, now_s
        return max(self._counted.get(kind, 0), len(self._left_out.get(kind, ())))


def _group(kind: str, name: str) -> tuple[str, str, int]:
    """Group, entry and limit of a name."""
    most = MAX_NAMES.get(kind)
    return ("", f"{kind}/{name}", MAX_OTHERS) if most is None else (kind, name, most)
