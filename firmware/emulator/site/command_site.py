"""A site whose programs are started by their command lines, as a person types them.

A command runs its program on a loop of its own, until Ctrl-C. Here it gives the program to the site's loop instead, and
all else is the command's own: what it reads of its words and of the site file, how it opens its radio, what it prints.
"""

import asyncio
import contextlib
from collections.abc import Coroutine, Iterator, Sequence
from pathlib import Path
from typing import Any

from emulator.site.emulated_site import DIRECT_WIRE, EmulatedSite, MakeBoard, SiteNode
from emulator.site.serial_wire import WireSettings
from skyless.cli.main import program
from skyless.run import process
from skyless.sim.trajectory import Trajectory
from skyless.site.file.load import load_site


def program_of(words: Sequence[str]) -> Coroutine[Any, Any, None]:
    """What a command line would run until Ctrl-C.

    Raises:
        SkylessError: the command refuses its words.
        ValueError: it ends at once, or runs something else than one program.
    """
    with _programs_kept() as kept:
        program()(list(words))
    if len(kept) != 1:
        raise ValueError(f"skyless {' '.join(words)} runs {len(kept)} programs, and should run one")
    return kept[0]


@contextlib.contextmanager
def _programs_kept() -> Iterator[list[Coroutine[Any, Any, None]]]:
    """Let commands give their programs instead of running them."""
    kept: list[Coroutine[Any, Any, None]] = []
    real = process.run

    def keep(main: Coroutine[Any, Any, None], *, punctual: bool = False) -> None:  # noqa: ARG001
        kept.append(main)

    process.run = keep
    try:
        yield kept
    finally:
        process.run = real


class CommandSite(EmulatedSite):
    """The emulated site with ``skyless anchor --site FILE`` and ``skyless tag --json``, which prints all fixes.

    What passes between the programs and their radios is not written down, so there is nothing to be judged.
    """

    def __init__(
        self,
        file: Path,
        trajectories: Sequence[Trajectory],
        make_board: MakeBoard,
        *,
        seed: int = 1,
        wire: WireSettings = DIRECT_WIRE,
    ) -> None:
        """``file``: the site's. Raises SkylessError."""
        super().__init__(load_site(file), trajectories, make_board, seed=seed, wire=wire)
        self._file = file

    def start_host(self, node: SiteNode) -> None:
        """Start the program of a node by its command line."""
        assert node.wire is not None
        radio = ["--radio", f"serial:{node.wire.path}", "--mqtt", "none"]
        if node in self.anchors:
            words = ["anchor", node.name, "--site", str(self._file), *radio]
        else:
            words = ["tag", node.name, "--json", "--publish-hz", "1000", *radio]
        node.task = asyncio.ensure_future(program_of(words))
