"""Child processes of tests: they start with the usual signals, and none outlasts its test."""

import asyncio
import contextlib
import itertools
import os
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

from skyless.run.hub_files import CLUSTER_PORT, LEAF_PORT, MONITOR_PORT
from skyless.run.process import end_with_parent

SKYLESS = (sys.executable, "-m", "skyless.cli.main")
LIMIT_S = 60.0


def usual_signals():
    """A ``preexec_fn``: the child ends with the test run, and ignores no signal although that may (``nohup``)."""
    request_end = end_with_parent()

    def prepare():
        for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
            signal.signal(number, signal.SIG_DFL)
        request_end()

    return prepare


_WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")) % 10
# Below the ports that Linux gives to connections (32768 and up), which could take one before the test listens there.
_FIRST_PORT = 12000 + 2000 * _WORKER
_ports = itertools.cycle(range(_FIRST_PORT, _FIRST_PORT + 2000))
# The four ports of each server of a hub are below and apart from all others: from 5000, 7000, 8200 and 9000 on.
_FIRST_NODE = 5000 + 80 * _WORKER
_nodes = itertools.cycle(range(_FIRST_NODE, _FIRST_NODE + 80))


def free_port(kind=socket.SOCK_STREAM):
    """A port of loopback where nobody listens, and which no other test of this run gets."""
    return next(port for port in _ports if is_free_port(port, kind))


def free_node_port():
    """The same for a server of a hub, which listens at four ports."""
    added = (0, CLUSTER_PORT, LEAF_PORT, MONITOR_PORT)
    return next(port for port in _nodes if all(is_free_port(port + more) for more in added))


def is_free_port(port, kind=socket.SOCK_STREAM):
    """Whether nobody listens at a port of loopback."""
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", port))
        return True
    return False


def lives(pid):
    """Whether there is a process with this number that has not ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


@contextlib.contextmanager
def started(*command, limit_s=LIMIT_S, **options):
    """A process with pipes of text; killed at the end, or after a time, so that no read of a pipe waits for ever."""
    pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, preexec_fn=usual_signals(), **pipes | options) as process:  # noqa: PLW1509
        limit = threading.Timer(limit_s, process.kill)
        limit.start()
        try:
            yield process
        finally:
            limit.cancel()
            process.kill()


@contextlib.asynccontextmanager
async def running_program(*command, **options):
    """The same for a test with an event loop; pipes are those that are asked for."""
    process = await asyncio.create_subprocess_exec(*command, preexec_fn=usual_signals(), **options)
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()
