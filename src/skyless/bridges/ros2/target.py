"""The target ``ros2://``: a site's fixes as topics of ROS 2, where ROS itself need not be installed.

    ros2://?domain=0&frame=site&namespace=skyless&tf=no

A thread writes: DDS may wait, and a tag's program must not. What it cannot keep up with is dropped, the oldest first.
"""

import asyncio
import os
import queue
import re
import threading
from typing import Final

from skyless.bridges.feed import BridgedSite
from skyless.bridges.ros2.dds import DdsPublisher
from skyless.bridges.ros2.messages import (
    FRAME_NAME,
    FRAME_RULE,
    NAMESPACE,
    SITE_FRAME,
    RosEncoder,
    RosMessage,
    RosSettings,
)
from skyless.bridges.target import BridgeContext, Target
from skyless.bridges.target_url import TargetUrl
from skyless.errors import SkylessError
from skyless.mqtt.messages import AnchorHealth, FixMessage, TagHealth

_MOST_DOMAIN: Final = 232
"""Beyond it, ports would exceed 65535."""

_MOST_WAITING: Final = 500
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
    domain = url.whole_number("domain", 0, 0, _MOST_DOMAIN)
    if not url.text_option("domain"):
        domain = _usual_domain(url.text)
    url.check_all_read()
    settings = RosSettings(frame=frame, namespace=namespace, transforms=transforms)
    return Ros2Target(url.text, DdsPublisher(url.text, domain), settings, context)


def _usual_domain(target: str) -> int:
    """As programs of ROS choose it. Raises SkylessError."""
    text = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not text.isdecimal() or int(text) > _MOST_DOMAIN:
        raise SkylessError(
            f"the target {target!r} uses the domain of ROS_DOMAIN_ID, which is {text!r}; it should be a whole number "
            f"from 0 to {_MOST_DOMAIN}"
        )
    return int(text)


class Ros2Target(Target):
    """Publishes poses, velocities, positions on the Earth, anchors and diagnostics."""

    def __init__(self, text: str, publisher: DdsPublisher, settings: RosSettings, context: BridgeContext) -> None:
        super().__init__(text)
        self._publisher, self._encoder, self._log = publisher, RosEncoder(settings), context.log
        self._waiting: queue.Queue[list[RosMessage] | None] = queue.Queue(_MOST_WAITING)
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
