"""``skyless record``: request receptions from a site's tags, and write all of the site's messages to a file."""

import asyncio
import contextlib
import re
import secrets
import socket
import tempfile
import time
from pathlib import Path
from typing import IO, Final

from msgspec import Struct

from skyless.core.errors import SkylessError
from skyless.files import replace_files
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import ReceptionsMessage, RequestMessage, StatusMessage
from skyless.run.mqtt.topics import request_topic, site_topic
from skyless.run.process import Log, data_folder, every, locked
from skyless.run.recordings.reception_log import EVERY_TAG
from skyless.run.recordings.recorder import McapFile, McapRecorder

_LEASE_S: Final = 15.0
_REQUEST_S: Final = 5.0  # each request for receptions is repeated at this interval, before its lease ends

_FLUSH_S: Final = 0.8  # so that a recorder that is killed loses less than a second, the delay of messages included

_MAX_RECORDERS: Final = 1000

_NEW_RUN_S: Final = 1.0  # shortest time between new runs


class RecorderState(Struct, frozen=True):
    """Progress of a recording."""

    seconds: float
    messages: dict[str, int]
    receptions: int
    tags: int
    bytes: int
    lost: int
    drops: dict[str, int]
    trouble: str | None
    """Why there is no connection to the broker; None while there is one."""
    ended: str | None
    """Why the file is no longer written; None while it is."""


class RecorderNode:
    """Records one site until cancelled, or until the file can no longer be written."""

    def __init__(self, file: McapFile, address: MqttAddress, site: int, log: Log) -> None:
        self.file = file
        self.recorder = McapRecorder(file)
        self._name, self._lock = _own_name(site)
        # persistent, so that the broker keeps messages while this recorder is restarted
        self.link = Link(address, self._name, site=site, kind="recorder", persistent=True, client_key=_client_key())
        self.receptions = 0
        self._site = site
        self._log = log
        self._started_s = time.monotonic()
        self._runs = 0
        self._new_run_s = 0.0
        self._next: dict[str, tuple[str, int]] = {}  # for each tag: the segment, and the number of its next reception
        self.link.subscribe(f"{site_topic(site).removesuffix('site')}#", self._on_message, qos=1)
        self.link.on_state.append(self._on_state)

    async def run(self, duration_s: float | None = None) -> None:
        """Record, then withdraw the request and close the file."""
        link = asyncio.ensure_future(self.link.run())
        work = [asyncio.ensure_future(every(_REQUEST_S, self._request)), asyncio.ensure_future(self._write())]
        try:
            await asyncio.wait([link, *work], timeout=duration_s, return_when=asyncio.FIRST_COMPLETED)
            for task in (link, *work):
                if task.done():
                    task.result()
        finally:
            self.link.publish(request_topic(self._site), RequestMessage(self._by, (), 0.0), qos=1)
            for task in (link, *work):
                task.cancel()
            await asyncio.gather(link, *work, return_exceptions=True)
            self.file.close()
            self._lock.close()

    def state(self) -> RecorderState:
        """Return the progress so far."""
        return RecorderState(
            seconds=time.monotonic() - self._started_s,
            messages=dict(self.recorder.kinds),
            receptions=self.receptions,
            tags=len(self._next),
            bytes=self.file.written_bytes,
            lost=self.file.lost,
            drops=dict(self.recorder.drops),
            trouble=self.link.trouble,
            ended=self.file.ended,
        )

    @property
    def _by(self) -> str:
        return f"{self._name}-{self._started_s:.3f}-{self._runs}"

    def _request(self) -> None:
        self.link.publish(request_topic(self._site), RequestMessage(self._by, (EVERY_TAG,), _LEASE_S), qos=1)

    def _on_state(self, connected: bool) -> None:
        if connected:
            self._request()

    def _begin_new_run(self) -> None:
        """Request under another name after a segment's beginning was lost, so that the tags begin new ones."""
        now_s = time.monotonic()
        if now_s - self._new_run_s >= _NEW_RUN_S:
            self._new_run_s = now_s
            self._runs += 1
            self._request()

    def _on_message(self, topic: str, payload: bytes) -> None:
        message = self.recorder.add(topic, payload, time.time())
        if isinstance(message, ReceptionsMessage):
            self._check_sequence(message)
        elif isinstance(message, StatusMessage) and message.kind == "tag" and message.online:
            self._request()

    def _check_sequence(self, message: ReceptionsMessage) -> None:
        """Count what is missing. A message may come twice after a broken connection."""
        self.receptions += len(message.receptions)
        segment, following = self._next.get(message.tag, ("", 0))
        if message.segment != segment:
            if message.start is None:
                self.recorder.drops["receptions-without-beginning"] += len(message.receptions)
                self._begin_new_run()
                return
            following = 0
        if message.first > following:
            self.recorder.drops["gap-in-receptions"] += 1
        self._next[message.tag] = (message.segment, max(following, message.first + len(message.receptions)))

    async def _write(self) -> None:
        """Close chunks at intervals and sync them to the disk, until the file has ended."""
        while True:
            await asyncio.sleep(_FLUSH_S)
            self.file.flush()
            if self.file.ended is None:
                await asyncio.to_thread(self.file.sync)
            if self.file.ended is not None:
                self._log(f"the recording has ended: {self.file.ended}")
                return


def _own_name(site: int) -> tuple[str, IO[str]]:
    """Choose and lock an MQTT name that no other running recorder on this machine has.

    A killed recorder leaves a session that the broker fills; the next recorder takes it over and ends it. Another
    user's lock cannot be opened, so its name is skipped.

    Raises SkylessError: there is no folder for temporary files, or too many recorders run.
    """
    host = re.sub(r"[^A-Za-z0-9_.-]", "-", socket.gethostname())
    try:
        folder = Path(tempfile.gettempdir())
    except OSError as error:
        raise SkylessError(f"a recorder needs a folder for temporary files: {error.strerror}") from None
    for number in range(1, _MAX_RECORDERS + 1):
        with contextlib.suppress(OSError):
            return f"{host}-{number}", locked(folder / f"skyless-record-{site}-{number}.lock")
    raise SkylessError(f"no name is left for a recorder: {folder}/skyless-record-{site}-*.lock cannot be locked")


def _client_key() -> str:
    """Random key shared by all of this user's recorders on this machine, so that a later one gets the same session.

    If it cannot be stored, it is new each time, and the session of a killed recorder stays at the broker.
    """
    key = secrets.token_hex(16)
    with contextlib.suppress(OSError, UnicodeError):
        file = data_folder() / "recorder_key"
        kept = file.read_text(encoding="ascii") if file.exists() else ""
        if re.fullmatch("[0-9a-f]{32}", kept):
            return kept
        replace_files({file: key.encode()}, secret=(file,))
    return key
