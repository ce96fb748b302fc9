"""Maps cells over all cores of this machine, or over a Dask cluster; the results are the same.

``reached`` is called with the share of the work that is done, ``keep`` with number and result of each finished cell.
"""

import logging
import multiprocessing
import os
import re
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from multiprocessing.connection import Connection
from socket import gethostname
from typing import Any, Final
from uuid import uuid4

from skyless.core.errors import SkylessError
from skyless.core.extras import extra_module
from skyless.core.processors import cores
from skyless.core.version import program_digest
from skyless.research.studies.common.plan import Cell

_POLL_S: Final = 0.2
_CONNECT_S: Final = 10.0
_WORKERLESS_S: Final = 30.0
"""For how long a study waits when no worker is left; ``dask worker`` starts a lost one again within seconds."""

_ADDRESS: Final = re.compile(r"((tcp|tls|ws|wss)://)?[^\s/]+:\d{1,5}")

_ENDING_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)

Reached = Callable[[float], None]
Keep = Callable[[int, Any], None]


class UnfinishedError(SkylessError):
    """Why work ended early."""


def run_cells(
    cells: Sequence[Cell], reached: Reached, processes: int | None = None, keep: Keep = lambda *_: None
) -> list[Any]:
    """Results in the order of the cells, computed by ``processes`` processes, by default one for each core.

    An interrupt ends all processes at once.

    Raises:
        UnfinishedError: a process died.
    """
    with _pool(min(processes or cores(), len(cells))) as pool:
        try:
            return _map(lambda cell: pool.submit(cell.function), cells, reached, keep)
        except BrokenProcessPool:
            raise UnfinishedError("a process died, killed from outside or for want of memory") from None


def run_cells_here(cells: Sequence[Cell], reached: Reached, keep: Keep) -> list[Any]:
    """As ``run_cells``, in this process and thread, one after the other."""
    total_s, done_s, results = sum(cell.weight_s for cell in cells), 0.0, []
    for number, cell in enumerate(cells):
        results.append(cell.function())
        keep(number, results[-1])
        done_s += cell.weight_s
        reached(done_s / total_s)
    return results


def run_cells_on_dask(
    cells: Sequence[Cell], reached: Reached, scheduler: str, keep: Keep = lambda *_: None
) -> list[Any]:
    """As ``run_cells``, on the workers of a Dask scheduler, which need the same program.

    What a lost worker was computing is computed by another one.

    Raises:
        UnfinishedError: the scheduler or all workers have gone, or a cell failed or killed several workers.
        SkylessError: the scheduler cannot be reached or has no workers, or a worker runs another program.
    """
    killed = extra_module("distributed", "--scheduler").KilledWorker
    with _cluster(scheduler) as (client, pool):

        def submit(cell: Cell) -> Future[Any]:
            key = (cell.name, uuid4().hex)
            return pool.submit(_compute_on_worker, program_digest(), cell.function, key=key)  # type: ignore[call-arg]

        def reached_by_workers(share: float) -> None:
            reached(share)
            try:
                if not client.nthreads():
                    client.wait_for_workers(1, _WORKERLESS_S)
            except TimeoutError:
                raise UnfinishedError(f"--scheduler {scheduler}: no worker is left; start some") from None
            except OSError:
                raise CancelledError from None

        try:
            return _map(submit, cells, reached_by_workers, keep)
        except SkylessError:
            raise
        except CancelledError:
            reason = "the scheduler has gone"
        except killed as error:
            reason = f"several workers died computing {error.task[0]!r}, killed from outside or for want of memory"
        except Exception as error:  # noqa: BLE001 - whatever a worker raised, or the network
            reason = " ".join(str(error).split()) or type(error).__name__
        raise UnfinishedError(f"--scheduler {scheduler}: the cluster failed: {reason}")


def _compute_on_worker(program: str, function: Callable[[], Any]) -> Any:  # noqa: ANN401 - any result
    if program_digest() != program:
        raise SkylessError(f"the worker on {gethostname()} runs another Skyless; it should be of the same source")
    return function()


def _map(submit: Callable[[Cell], Future[Any]], cells: Sequence[Cell], reached: Reached, keep: Keep) -> list[Any]:
    """The longest cells begin first. Futures of finished ones are dropped: a cluster would compute lost ones again."""
    order = sorted(range(len(cells)), key=lambda number: -cells[number].weight_s)
    with _uninterrupted():
        waiting = {submit(cells[number]): number for number in order}
    total_s, done_s, results = sum(cell.weight_s for cell in cells), 0.0, {}
    while waiting:
        for future in wait(waiting, _POLL_S, FIRST_COMPLETED).done:
            number = waiting.pop(future)
            results[number] = future.result()
            keep(number, results[number])
            done_s += cells[number].weight_s
        reached(done_s / total_s)
    return [results[number] for number in range(len(cells))]


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Hold Ctrl-C and SIGTERM back until the block ends; processes started in it never get Ctrl-C, only this one."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    # Processes inherit the mask. This program needs handlers as well: where its main thread masks a signal, the system
    # gives it to another thread, such as one of NumPy's, and Python would interrupt the main thread all the same.
    signal.pthread_sigmask(signal.SIG_BLOCK, _ENDING_SIGNALS)
    handlers = {number: signal.signal(number, lambda number, _: came.append(number)) for number in _ENDING_SIGNALS}
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _ENDING_SIGNALS)  # what was held back by it comes to these handlers
        for number, handler in handlers.items():
            signal.signal(number, handler)
    if came:
        signal.raise_signal(came[0])


@contextmanager
def _pool(processes: int) -> Iterator[ProcessPoolExecutor]:
    """Processes that end when the block is left by an exception, or this process is no more."""
    context = multiprocessing.get_context("spawn")
    reader, writer = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(processes, context, _start_worker, (reader,))
    try:
        yield pool
    except BaseException:
        writer.close()
        pool.shutdown(wait=True, cancel_futures=True)
        raise
    else:
        pool.shutdown()
    finally:
        writer.close()
        reader.close()


def _start_worker(parent: Connection) -> None:
    """End this process as soon as the other end of the pipe is closed, in the middle of a cell if need be."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})

    def watch() -> None:
        try:
            parent.recv_bytes()
        except (EOFError, OSError):
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def _cluster(scheduler: str) -> Iterator[tuple[Any, Executor]]:
    """A Dask client, and what it computes with, once all workers have said that they run this program."""
    if not _ADDRESS.fullmatch(scheduler):
        raise SkylessError(f"--scheduler is {scheduler!r}; it should be an address such as tcp://127.0.0.1:8786")
    connect = extra_module("distributed", "--scheduler").Client
    with ExitStack() as stack:
        logging.disable(logging.ERROR)  # what goes wrong is reported once, by an exception
        stack.callback(logging.disable, logging.NOTSET)
        try:
            client = stack.enter_context(connect(scheduler, timeout=_CONNECT_S, set_as_default=False))
            # Not by a task: a worker that cannot unpickle one ends, and the next one gets it.
            programs = client.run(program_digest, on_error="return", callback_timeout=_CONNECT_S)
        except (OSError, ValueError, TypeError) as error:
            raise SkylessError(f"--scheduler {scheduler}: scheduler or workers do not answer: {error}") from None
        if not programs:
            raise SkylessError(f"--scheduler {scheduler} has no workers; start some: dask worker {scheduler}")
        for worker, program in programs.items():
            if program != program_digest() and not isinstance(program, OSError):
                raise SkylessError(f"the worker {worker} runs another Skyless; it should be of the same source")
        executor = client.get_executor(pure=False)
        stack.callback(executor.shutdown, wait=False)
        yield client, executor
