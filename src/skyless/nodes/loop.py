"""How a program of the site runs: an event loop with fine timers, a clean end on Ctrl-C and SIGTERM."""

import asyncio
import contextlib
import ctypes
import gc
import os
import selectors
import signal
import sys
from collections.abc import Coroutine
from typing import Any, Final

CHILD_VARIABLE: Final = "SKYLESS_CHILD_OF"
"""Process number of the program that started this one, with which it ends."""

_PR_SET_PDEATHSIG: Final = 1


def run(main: Coroutine[Any, Any, None]) -> None:
    """Run a program until it ends, SIGTERM or Ctrl-C comes; the last two cancel it.

    Raises:
        KeyboardInterrupt: it was Ctrl-C.
    """
    _end_with_parent()
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
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, task.cancel)
    await task


def _end_with_parent() -> None:
    """Ask the kernel to end this process with the one that started it, however that one ends (Linux only)."""
    parent = os.environ.get(CHILD_VARIABLE)
    if parent is None or not sys.platform.startswith("linux"):
        return
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    if str(os.getppid()) != parent:
        raise SystemExit("the program that started this one has gone")
