"""``skyless broker``: runs nats-server, which speaks MQTT 3.1.1, as a child process.

While it runs, a file in a folder private to the user states its address, for programs without ``--mqtt``. The file is
locked meanwhile, so that a file left behind by a killed program is recognised.
"""

import asyncio
import contextlib
import fcntl
import json
import os
import secrets
import shutil
import signal
import socket
import ssl
import sysconfig
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any, Final, Self

from msgspec import Struct
from msgspec.structs import replace

from skyless.core.errors import SkylessError, writing
from skyless.files import replace_files
from skyless.machine import how_to_install
from skyless.run.gather.subjects import DOMAIN, MAX_PAYLOAD, NAME_REQUESTS, PAGE_INBOX, NatsAddress, at
from skyless.run.gather.subjects import FIRST_PORT as FIRST_NATS_PORT
from skyless.run.hub_files import PING_INTERVAL, Leaf
from skyless.run.mqtt.address import ACCESS, PASSWORD_VARIABLE, MqttAddress, Role, mqtt_address
from skyless.run.mqtt.connection import check_broker
from skyless.run.process import data_folder, end, end_with_parent, locked, reserve_free, reserve_next

FIRST_PORT: Final = 1883
_PRIVATE: Final = 10_000
"""How much higher the ports of a private broker are."""
_PORTS_TO_TRY: Final = 100

_TEMPORARY: Final = "skyless-broker-"  # prefix of temporary folders' names

_NATS_HOST: Final = "127.0.0.1"

_ABANDONED_S: Final = 10.0  # a temporary folder of this age that is not locked was left by a killed broker

_START_S: Final = 20.0
_POLL_S: Final = 0.02


class BrokerLimits(Struct, frozen=True):
    """Beyond them nats-server ends a connection, or refuses what is asked, and says so in its log."""

    message_bytes: int = MAX_PAYLOAD
    """A message, such as a floor plan."""
    stored_bytes: int = 4 * 1024**3
    """What is retained, and what waits for clients with sessions; a gather's streams come in addition."""
    subscriptions: int = 100_000
    """Subscriptions of QoS 1 of all clients: each is a consumer of a stream, and nats-server's default is 1,000."""
    session_idle_h: int = 24
    """Hours after which subscriptions of a session that is away end, where strangers may read and could leave many."""
    log_bytes: int = 1_000_000
    """A file of the log, of which there are two."""


LIMITS: Final = BrokerLimits()


class BrokerSettings(Struct, frozen=True):
    """Where the embedded broker listens and stores its data. By default it serves only this machine."""

    port: int | None = None
    """None means 1883, or the next free port."""
    listen: str = "127.0.0.1"
    data: Path | None = None
    """None means the user's data folder, or a temporary one if that cannot be used or another broker has it."""
    user: str | None = None
    password: str | None = None
    certificate: Path | None = None
    key: Path | None = None
    """Certificate and private key in PEM form, for TLS."""
    roles: Mapping[Role, str] | None = None
    """Passwords of the roles, whose permissions ``ACCESS`` states, instead of a single user for everything."""
    strangers_read: bool = False
    """Whether clients without user and password have the stranger's role; otherwise they are refused."""
    temporary: bool = False
    """Whether the data are in a temporary folder, which is deleted at the end."""
    gathered_bytes: int | None = None
    """Disk limit of a gather's streams; None without a gather, for which the NATS port is unused."""
    hub: Leaf | None = None
    """The site's connection to a hub."""
    is_private: bool = False
    """Whether it is for the program that starts it alone: its address is not stated, and its ports are unusual ones."""

    def check(self) -> None:
        """Check the options for access control. Raises SkylessError that names the missing option."""
        if (self.user is None) != (self.password is None):
            raise SkylessError(f"--user and a password in {PASSWORD_VARIABLE} belong together")
        if self.user is not None and self.roles is not None:
            raise SkylessError("--user and --access exclude each other; the role operator may do everything")
        if self.strangers_read and self.roles is None:
            raise SkylessError("--strangers-read needs --access; without it everybody, or --user, may do everything")
        if self.user is None and self.roles is None and not MqttAddress(self.listen, 1).loopback:
            raise SkylessError(
                f"--listen is {self.listen!r}, where others can reach the broker; "
                f"it should come with --access, or with --user and a password in {PASSWORD_VARIABLE}"
            )
        if (self.certificate is None) != (self.key is None):
            raise SkylessError("--certificate and --key belong together")
        for text in (self.user or "", self.password or ""):
            if not text.isprintable():
                raise SkylessError("the broker's user name and password should be printable characters")
        if (self.password or "").startswith("$2"):
            raise SkylessError("the broker's password should not begin with $2, which nats-server takes for a hash")

    @property
    def operator(self) -> tuple[str | None, str | None]:
        """User and password with all permissions; None without access control."""
        if self.roles is None:
            return self.user, self.password
        return str(Role.OPERATOR), self.roles[Role.OPERATOR]

    def address(self, port: int) -> MqttAddress:
        """Address for clients on this machine. With roles, each fills in its own user."""
        host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self.listen, self.listen)
        return MqttAddress(host, port, self.certificate is not None, self.user, self.password)


def _configuration(settings: BrokerSettings, port: int, data: Path, nats: NatsAddress | None = None) -> str:
    """Return nats-server's configuration file; its format accepts JSON. ``nats`` is the address for a gather."""
    host = f"[{settings.listen}]" if ":" in settings.listen else settings.listen
    # A message that a dying subscriber has not acknowledged is sent again after ``ack_wait``; 30 s by default.
    mqtt: dict[str, object] = {"listen": f"{host}:{port}", "ack_wait": "3s"}
    if settings.certificate is not None:
        mqtt["tls"] = {"cert_file": str(settings.certificate), "key_file": str(settings.key)}
    if settings.strangers_read:
        mqtt["consumer_inactive_threshold"] = f"{LIMITS.session_idle_h}h"
    whole: dict[str, Any] = {
        "server_name": "skyless",
        "listen": "127.0.0.1:-1" if nats is None else nats.url.partition("://")[2],  # NATS itself
        "max_payload": LIMITS.message_bytes,
        "jetstream": {
            "store_dir": str(data),
            "max_file_store": LIMITS.stored_bytes + (settings.gathered_bytes or 0),
            "limits": {"default_max_consumers": LIMITS.subscriptions},
        },
        "log_file": str(data / "nats-server.log"),
        "logfile_size_limit": LIMITS.log_bytes,
        "logfile_max_num": 2,
        "mqtt": mqtt,
    }
    if settings.is_private:
        whole["jetstream"]["sync_interval"] = "1s"  # what a power cut may cost; 2 minutes by default
    if settings.hub is not None:
        site = at(DOMAIN, settings.hub.site)
        # The hub keeps only the newer of two servers with one name, so duplicate sites could not be detected.
        whole["server_name"] = f"{site}-{secrets.token_hex(4)}"
        whole["jetstream"]["domain"] = site
        whole |= {"leafnodes": settings.hub.configuration(), "ping_interval": PING_INTERVAL, "connect_error_reports": 1}
    if settings.user is not None:
        whole["authorization"] = {"user": settings.user, "password": settings.password}
    if settings.roles is not None:
        users = [_user(role, password) for role, password in settings.roles.items()]
        if nats is not None:
            for permissions in (user["permissions"] for user in users if user["user"] in {Role.PAGE, Role.SURVEY}):
                permissions["publish"]["allow"].append(NAME_REQUESTS)
                permissions["subscribe"]["allow"].append(f"{PAGE_INBOX}.>")
        if settings.strangers_read:
            users.append(_user(Role.STRANGER, ""))
            whole["no_auth_user"] = str(Role.STRANGER)
        whole["authorization"] = {"users": users}
    return json.dumps(whole, ensure_ascii=False, indent=1) + "\n"


def _user(role: Role, password: str) -> dict[str, Any]:
    access = ACCESS[role]
    permissions = {"publish": _permission(access.publish), "subscribe": _permission(access.subscribe)}
    return {"user": str(role), "password": password, "permissions": permissions}


def _permission(filters: tuple[str, ...]) -> dict[str, list[str]]:
    """Convert topic filters to NATS subjects. An empty list of allowed subjects would allow all of them."""
    subjects = [name.replace("/", ".").replace("+", "*").replace("#", ">") for name in filters]
    # In MQTT "a/#" includes "a"; nats-server subscribes to both.
    subjects += [subject.removesuffix(".>") for subject in subjects if subject.endswith(".>")]
    return {"allow": subjects} if subjects else {"deny": [">"]}


# The folder and the port


def _locked_folder(settings: BrokerSettings) -> tuple[Path, IO[str]]:
    """Lock the private folder for the data. Without ``data``, use a temporary one if the usual one fails."""
    if settings.data is not None:
        try:
            return settings.data, _lock(settings.data)
        except BlockingIOError:
            raise SkylessError(f"--data is {str(settings.data)!r}, which another broker uses") from None
        except OSError as error:
            raise SkylessError(f"--data is {str(settings.data)!r}, which cannot be used: {error.strerror}") from None
    if not settings.temporary:
        with contextlib.suppress(OSError):
            usual = data_folder() / "broker"
            return usual, _lock(usual)
    _remove_abandoned()
    temporary = Path(tempfile.mkdtemp(prefix=_TEMPORARY))
    return temporary, _lock(temporary)


def _remove_abandoned() -> None:
    """Delete the temporary folders of brokers that were killed together with their parents."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_TEMPORARY}*"):
        with contextlib.suppress(OSError):
            if time.time() - folder.stat().st_mtime > _ABANDONED_S:  # else a new broker may be about to lock it
                with locked(folder / "lock"):
                    shutil.rmtree(folder)


def _lock(folder: Path) -> IO[str]:
    folder.mkdir(parents=True, exist_ok=True)
    folder.chmod(0o700)
    return locked(folder / "lock")


def _reserved(host: str, port: int) -> socket.socket | None:
    """Reserve a port against brokers starting at the same moment; None if another program has it.

    Raises SkylessError: the host is not an address of this machine, or the port needs privileges.
    """
    try:
        return reserve_free(host, port)
    except PermissionError:
        raise SkylessError(f"--port is {port}, which only the system may use; it should be 1024 or more") from None
    except OSError:
        raise SkylessError(f"--listen is {host!r}; it should be an address of this machine") from None


# The process


class _PortTakenError(Exception):
    """Another program listens on the port."""


class Broker:
    """A running broker. ``async with`` stops it on exit."""

    def __init__(
        self,
        address: MqttAddress,
        data: Path,
        process: asyncio.subprocess.Process,
        lock: IO[str],
        reservation: socket.socket,
        nats: NatsAddress | None,
        settings: BrokerSettings,
    ) -> None:
        self.address = address  # for clients on this machine, with credentials
        self.nats = nats  # for the broker's gather; None without one
        self.data = data
        self._process, self._lock, self._reservation = process, lock, reservation
        self._settings = settings
        is_stated = not (settings.is_private or address.tls)  # a certificate is for other names
        self._stated = StatedAddress(address, nats) if is_stated else None

    @property
    def pid(self) -> int:
        """Process ID of nats-server."""
        return self._process.pid

    async def wait(self) -> int:
        """Wait until nats-server ends, and return its exit code."""
        return await self._process.wait()

    @property
    def has_ended(self) -> bool:
        """Whether nats-server has ended."""
        return self._process.returncode is not None

    async def restart(self) -> None:
        """End nats-server, and start it again at the same ports. Raises SkylessError if it does not start."""
        await end(self._process)
        port = self.address.port
        self._process = await _spawn(_program(), self._settings, port, self.data, self._lock, self.nats)

    async def stop(self, *, to_restart: bool = False) -> None:
        """Stop the broker. Temporary data are deleted unless another broker continues with them (``to_restart``)."""
        if self._stated is not None:
            self._stated.withdraw()
        await end(self._process)
        if to_restart:
            os.utime(self.data)  # so that it does not count as abandoned
        self._reservation.close()
        _release(self.data, self._lock, keep=to_restart)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.stop()


async def start_broker(settings: BrokerSettings | None = None) -> Broker:
    """Start a broker, and return once it accepts MQTT. It ends with this process, however that ends.

    Raises SkylessError: the port is taken, the folder cannot be used, or nats-server is missing or does not start.
    """
    settings = settings or BrokerSettings()
    settings.check()
    program = _program()
    data, lock = _locked_folder(settings)
    first = FIRST_PORT + (_PRIVATE if settings.is_private else 0)
    last = first + _PORTS_TO_TRY - 1
    try:
        for port in range(first, last + 1) if settings.port is None else (settings.port,):
            with contextlib.suppress(_PortTakenError):
                return await _start(program, settings, port, data, lock)
        if settings.port is not None:
            raise SkylessError(
                f"--port is {settings.port}, where another program listens; without --port a free one is taken"
            )
        raise SkylessError(f"ports {first} to {last} of {settings.listen} are all taken; --port names one")
    except BaseException:
        _release(data, lock)
        raise


async def _start(program: Path, settings: BrokerSettings, port: int, data: Path, lock: IO[str]) -> Broker:
    reservation = _reserved(settings.listen, port)
    if reservation is None:
        raise _PortTakenError
    try:
        with contextlib.ExitStack() as until_it_listens:
            nats: NatsAddress | None = None
            if settings.gathered_bytes is not None:
                first = FIRST_NATS_PORT + (_PRIVATE if settings.is_private else 0)
                nats_port, held = reserve_next(_NATS_HOST, first)
                until_it_listens.enter_context(held)
                nats = NatsAddress(f"nats://{_NATS_HOST}:{nats_port}", *settings.operator)
            process = await _spawn(program, settings, port, data, lock, nats)
    except BaseException:
        reservation.close()
        raise
    return Broker(settings.address(port), data, process, lock, reservation, nats, settings)


async def _spawn(
    program: Path, settings: BrokerSettings, port: int, data: Path, lock: IO[str], nats: NatsAddress | None
) -> asyncio.subprocess.Process:
    """Start nats-server, and return once it accepts MQTT."""
    file = data / "nats-server.conf"
    with writing(file):
        replace_files({file: _configuration(settings, port, data, nats).encode()}, secret=(file,))
    process = await asyncio.create_subprocess_exec(
        *(program, "--config", file),
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.PIPE,
        start_new_session=True,  # Ctrl-C in a terminal must reach it last, through its parent
        pass_fds=(lock.fileno(),),  # the folder stays locked while nats-server writes there
        preexec_fn=end_with_parent(signal.SIGKILL),
    )
    user, password = settings.operator
    try:
        await _until_ready(process, replace(settings.address(port), user=user, password=password), data)
    except BaseException:
        await end(process)
        raise
    return process


async def _until_ready(process: asyncio.subprocess.Process, address: MqttAddress, data: Path) -> None:
    loop = asyncio.get_running_loop()
    tls = ssl.create_default_context() if address.tls else None
    if tls is not None:  # the child's certificate is for its network names, not for loopback
        tls.check_hostname, tls.verify_mode = False, ssl.CERT_NONE
    deadline_s = loop.time() + _START_S
    trouble: SkylessError | None = None
    while loop.time() < deadline_s:
        if process.returncode is not None:
            raise await _failure(process, data)
        try:
            await check_broker(address, tls)
        except SkylessError as error:
            trouble = error
            await asyncio.sleep(_POLL_S)
        else:
            return
    raise SkylessError(f"nats-server has not accepted MQTT within {_START_S:.0f} s: {trouble}")


async def _failure(process: asyncio.subprocess.Process, data: Path) -> Exception:
    """Return an exception that says why nats-server ended at its start, from its log."""
    lines = (await process.stderr.read()).decode(errors="replace").splitlines() if process.stderr else []
    with contextlib.suppress(OSError):
        log = (data / "nats-server.log").read_text(encoding="utf-8", errors="replace")
        lines += [line for line in log.splitlines() if line.startswith(f"[{process.pid}]")]
    faults = [line for line in lines if line.strip() and "[INF]" not in line]
    if any("address already in use" in line for line in faults):
        return _PortTakenError()
    return SkylessError(f"nats-server does not start: {faults[-1] if faults else f'exit code {process.returncode}'}")


def _release(data: Path, lock: IO[str], *, keep: bool = False) -> None:
    """Unlock the folder for the next broker; delete a temporary one unless ``keep``."""
    if not keep and data.name.startswith(_TEMPORARY):
        shutil.rmtree(data, ignore_errors=True)
    lock.close()


def _program() -> Path:
    """Path of nats-server: the wheel's, which is installed with this Python, or else the system's."""
    here = Path(sysconfig.get_path("scripts")) / "nats-server"
    found = str(here) if here.exists() else shutil.which("nats-server")
    if found is None:
        raise SkylessError(f"nats-server is missing at {here}: {how_to_install('site')}")
    return Path(found)


# The address for other programs


class StatedAddress:
    """A broker's address, published until ``withdraw``. Nothing is published if no file can be written.

    The second line of the file is the broker's NATS address, if it has a gather.
    """

    def __init__(self, address: MqttAddress, nats: NatsAddress | None = None) -> None:
        self._file: Path | None = None
        self._lock: IO[str] | None = None
        with contextlib.suppress(OSError):
            file = _session_folder() / f"broker-{address.port}"
            self._lock = _locked(file)
            self._lock.truncate(0)
            self._lock.write(f"{address}\n{nats.url}" if nats is not None else str(address))
            self._lock.flush()
            self._file = file

    def withdraw(self) -> None:
        """Withdraw the address, because the broker has ended."""
        if self._file is not None:
            self._file.unlink(missing_ok=True)
        if self._lock is not None:
            self._lock.close()


def _locked(file: Path) -> IO[str]:
    """Lock the file. A program looking for a broker may hold it briefly, and the previous broker may remove it.

    Raises OSError: it cannot be written, or another broker states its address there.
    """
    for attempt in range(20):
        time.sleep(0.01 if attempt else 0.0)
        with contextlib.suppress(BlockingIOError, FileNotFoundError):
            lock = locked(file)
            if os.path.samestat(os.fstat(lock.fileno()), file.stat()):
                return lock
    return locked(file)


def running_broker() -> MqttAddress | None:
    """The most recently started broker on this machine, or None."""
    return next((mqtt for mqtt, _ in _stated()), None)


def nats_of(broker: MqttAddress) -> NatsAddress | None:
    """NATS address, with the broker's user, of a broker on this machine; None if it has no gather."""
    for mqtt, nats in _stated():
        if nats and (mqtt.host, mqtt.port) == (broker.host, broker.port):
            return NatsAddress(nats, broker.user, broker.password)
    return None


def _stated() -> Iterator[tuple[MqttAddress, str]]:
    """Yield the addresses in each broker's file, newest first; the NATS address is empty without a gather."""
    with contextlib.suppress(OSError):
        files = sorted(_session_folder().glob("broker-*"), key=lambda file: file.stat().st_mtime, reverse=True)
        for file in files:
            addresses = _addresses_in(file)
            if addresses is not None:
                yield addresses


def _addresses_in(file: Path) -> tuple[MqttAddress, str] | None:
    """Read the addresses in a file; None if its broker has ended. The file stays: a broker may be about to lock it."""
    try:
        with file.open(encoding="utf-8") as stated:
            try:
                fcntl.flock(stated, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                mqtt, _, nats = stated.read().partition("\n")
                return mqtt_address(mqtt), nats
    except (OSError, SkylessError, UnicodeError):  # the broker has just ended, or is just starting
        pass
    return None


def _session_folder() -> Path:
    """Return the user's folder for files that last no longer than a session, created if missing.

    Raises OSError: there is none private to the user.
    """
    shared = os.environ.get("XDG_RUNTIME_DIR")
    folder = Path(shared) / "skyless" if shared and Path(shared).is_absolute() else None
    if folder is None or not os.access(folder.parent, os.W_OK | os.X_OK):
        folder = Path(tempfile.gettempdir()) / f"skyless-run-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if found.st_uid != os.getuid() or found.st_mode & 0o022:
        raise PermissionError(f"{folder} can be written by others")
    return folder
