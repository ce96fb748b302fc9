"""How a program of the site runs: an event loop with fine timers, a clean end on Ctrl-C and SIGTERM."""

import asyncio
import contextlib
import ctypes
import gc
import os
import selectors
import signal
import sys
from collections.abc import Callable, Coroutine
from typing import Any, Final

_PR_SET_PDEATHSIG: Final = 1

PUNCTUAL_NICE: Final = -10
"""Priority of programs that serve a radio, where the system lets them have it (root, or a limit in limits.conf)."""


def run(main: Coroutine[Any, Any, None], *, punctual: bool = False) -> None:
    """Run a program until it ends, SIGTERM, SIGHUP or Ctrl-C comes; these cancel it.

    ``punctual``: ask the system to prefer it to others, because a radio's slots do not wait.

    Raises:
        KeyboardInterrupt: it was Ctrl-C.
    """
    if punctual:
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, 0, PUNCTUAL_NICE)
    gc.collect()
    gc.freeze()
    with asyncio.Runner(loop_factory=_new_loop) as runner, contextlib.suppress(asyncio.CancelledError):
        runner.run(_until_terminated(main))


def _new_loop() -> asyncio.AbstractEventLoop:
    """A loop on select(), whose timers are exact to microseconds; those of epoll() are a millisecond late."""
    return asyncio.SelectorEventLoop(selectors.SelectSelector())


async def _until_terminated(main: Coroutine[Any, Any, None]) -> None:
    task = asyncio.ensure_future(main)
    with contextlib.suppress(NotImplementedError):
        for number in ending_signals():
            asyncio.get_running_loop().add_signal_handler(number, task.cancel)
    await task


def ending_signals() -> tuple[signal.Signals, ...]:
    """What asks a program to end besides Ctrl-C: SIGTERM, and that of a closed terminal, but under ``nohup``."""
    left_alone = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return (signal.SIGTERM,) if left_alone else (signal.SIGTERM, signal.SIGHUP)


def end_with_parent(by: signal.Signals = signal.SIGTERM) -> Callable[[], None] | None:
    """What a child process does first, so that it ends with the one that started it, however that ends; Linux only."""
    if not sys.platform.startswith("linux"):
        return None
    prctl = ctypes.CDLL(None).prctl
    parent = os.getpid()

    def ask() -> None:
        prctl(_PR_SET_PDEATHSIG, by, 0, 0, 0)
        if os.getppid() != parent:  # it died before the question
            os._exit(1)

    return ask
