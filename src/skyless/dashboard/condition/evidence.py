"""What is known of the live site's programs, and since when: the evidence of its condition. No I/O.

``now_s`` is the page server's monotonic clock everywhere, ``unix_s`` its clock of the day.
"""

from typing import Final

from skyless.dashboard.condition.lateness import FixAges
from skyless.dashboard.condition.leader import LeaderTracker
from skyless.dashboard.condition.roster import Roster
from skyless.mqtt.messages import AnchorHealth, EtherHealth, FixMessage, StatusMessage, TagHealth
from skyless.site.model import Site

Health = TagHealth | AnchorHealth | EtherHealth

FRESH_S: Final = 2.5
"""Fixes and health messages older than this are no evidence."""

GRACE_S: Final = 5.0
"""A tag that has just started may be without a fix for this long, and an anchor without a report."""

ALERTS: Final[dict[str | None, int]] = {"detected-excluded": 1, "detected-not-excluded": 2, "alert-limit-exceeded": 2}
"""Integrity alerts that are reported: 1 where the position is still sound, 2 where it may be wrong."""

ALERT_WORDS: Final = {
    "detected-excluded": "a faulty anchor is excluded",
    "detected-not-excluded": "a fault is not excluded, so that the position may be wrong",
    "alert-limit-exceeded": "the protection level is above the alert limit",
}


class Node:
    """A tag, an anchor or the emulated air."""

    __slots__ = ("alert", "codes_s", "fix_s", "health", "health_s", "host", "online", "previous", "since_s", "used_s")

    def __init__(self) -> None:
        self.online: bool | None = None
        """By its status; None without one."""
        self.host = ""
        """Name of its computer; empty where it is not known."""
        self.health: Health | None = None
        self.previous: Health | None = None
        """The health before."""
        self.since_s: float | None = None
        """When it came online, or its first message came."""
        self.health_s = float("-inf")
        """When the last health came."""
        self.fix_s = float("-inf")
        """When the last fix came."""
        self.used_s = float("-inf")
        """When the last fix came that used it as an anchor."""
        self.alert: str | None = None
        """The worst of its fixes since the last evaluation."""
        self.codes_s: float | None = None
        """Since when it states that its beacons have codes."""

    def begin(self, now_s: float) -> None:
        """It is there since now, unless it has been before."""
        if self.since_s is None:
            self.since_s = now_s

    def reports(self, now_s: float) -> bool:
        """Whether it is online and its health is fresh."""
        return self.online is not False and now_s - self.health_s < FRESH_S

    def has_fix(self, now_s: float) -> bool:
        """Whether a fix has come lately."""
        return now_s - self.fix_s < FRESH_S

    def codes_for_s(self, now_s: float) -> float:
        """For how long its beacons have had codes, as it states; 0 where they have none."""
        return 0.0 if self.codes_s is None else now_s - self.codes_s


class Evidence:
    """The newest of every node's messages, and when they came."""

    def __init__(self, host: str, now_s: float) -> None:
        """``host`` is this computer's name, as nodes state theirs."""
        self.host = host
        self.connected = False
        self.ready_s = now_s
        """When it began to wait for messages."""
        self.site: Site | None = None
        self.nodes: dict[tuple[str, str], Node] = {}
        """By kind and name."""
        self.roster = Roster()
        self._sorted: dict[str, list[tuple[str, Node]]] = {}
        self.ages = FixAges()
        self.leader = LeaderTracker()

    def set_connected(self, *, connected: bool, now_s: float) -> None:
        """Whether the broker is connected."""
        if connected != self.connected:
            self.connected, self.ready_s = connected, now_s

    def set_site(self, site: Site, now_s: float) -> None:
        """Which anchors there should be."""
        if self.site is None:
            self.ready_s = now_s
        self.site = site
        self.site_anchors()

    def site_anchors(self) -> list[str]:
        """The names of the site's anchors that are taken in."""
        site = self.site
        ids = [] if site is None else [*(a.id for a in site.anchors), *(a.id for a in site.unplaced)]
        return [name for name in map(str, ids) if self.roster.admits("anchor", name)]

    def add_status(self, status: StatusMessage, now_s: float) -> None:
        """Whether a node is online."""
        node = self._node(status.kind, status.name)
        if node is None:
            return
        if status.online and not node.online:
            node.since_s = now_s
        node.online, node.host = status.online, status.host or node.host
        if not status.online:
            node.alert, node.previous, node.codes_s = None, None, None
            self.ages.remove(status.name)

    def add_health(self, kind: str, name: str, health: Health, now_s: float, unix_s: float) -> None:
        """A node's health."""
        node = self._node(kind, name)
        if node is None:
            return
        node.begin(now_s)
        node.previous, node.health, node.health_s = node.health, health, now_s
        if isinstance(health, AnchorHealth):
            if health.chain is None or health.code_fault is not None:
                node.codes_s = None
            elif node.codes_s is None:
                node.codes_s = now_s
            self.leader.update(health, now_s)
        elif isinstance(health, TagHealth) and node.host == self.host:
            self.ages.add_health(name, unix_s - health.unix_s, now_s)

    def add_fix(self, fix: FixMessage, now_s: float) -> float:
        """A fix of a tag; returns its age as ``FixAges`` has it, in s."""
        node = self._node("tag", fix.tag)
        if node is None:
            return 0.0
        node.begin(now_s)
        node.fix_s = now_s
        if ALERTS.get(fix.alert, 0) > ALERTS.get(node.alert, 0):
            node.alert = fix.alert
        for anchor in fix.anchors:
            used = self._node("anchor", str(anchor))
            if used is not None:
                used.used_s = now_s
        return self.ages.add_fix(fix.tag, fix.unix_s, fix.latency_s, now_s)

    def of(self, kind: str) -> list[tuple[str, Node]]:
        """Names and nodes of a kind, in their natural order."""
        if kind not in self._sorted:
            found = [(name, node) for (of_kind, name), node in self.nodes.items() if of_kind == kind]
            found.sort(key=lambda item: (len(item[0]) if item[0].isdecimal() else 1 << 30, item[0]))
            self._sorted[kind] = found
        return self._sorted[kind]

    def in_grace(self, now_s: float, node: Node | None = None) -> bool:
        """Whether the connection, or a node, is too young to be complete."""
        since_s = self.ready_s if node is None or node.since_s is None else max(node.since_s, self.ready_s)
        return now_s - since_s < GRACE_S

    def computer(self, host: str) -> str:
        """Words for a computer; one that is not known counts as this one."""
        return "this computer" if host in {"", self.host} else f"computer {host}"

    def _node(self, kind: str, name: str) -> Node | None:
        node = self.nodes.get((kind, name))
        if node is None and self.roster.admits(kind, name):
            node = self.nodes[kind, name] = Node()
            self._sorted.pop(kind, None)
        return node
