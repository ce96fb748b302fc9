"""``skyless board``: an emulated board on a pseudo-terminal."""

import sys
from pathlib import Path
from typing import Literal

from cyclopts import App

from skyless.cli.common import JsonOptions, command, print_json
from skyless.cli.nodes.options import log, run_until_stopped
from skyless.core.arguments import Options
from skyless.core.errors import SkylessError
from skyless.run.board import RADIO_OF, Board
from skyless.run.open_radio import DEFAULT_RADIO, is_ether, open_radios

app = App(name="board", help_epilogue="Example: skyless board tag1 --link /tmp/board")


class BoardOptions(Options, frozen=True, kw_only=True):
    """Options of ``skyless board``."""

    name: str
    """Which radio it is: an anchor's number, or a tag of the air (tag1)."""
    radio: str = DEFAULT_RADIO
    """Radio of the board, on the emulated air: ether:HOST:PORT of skyless ether."""
    wire: Literal["link", "sniffer", "sniffer-text", "listener", "uci", "uci-2"] = "link"
    """Format on the serial port: link (Skyless), sniffer or sniffer-text (Bitcraze; beacons become TDoA3 packets),
    listener (uwb-apps, JSON), uci or uci-2 (a FiRa board that receives DL-TDoA; measurements of version 1 or 2)."""
    link: Path | None = None
    """A symbolic link to the pseudo-terminal, which keeps its name when the board is started again."""


@app.default
@command
def board(asked: BoardOptions, output: JsonOptions) -> None:
    """Emulate a board with a UWB radio on a pseudo-terminal, until Ctrl-C, to try programs without hardware.

    The board is one node of the emulated air. Programs open it as they would open a real one:
    skyless tag tag1 --radio serial:PATH. A tag's computes by itself where its settings say so (skyless flash-config, or
    skyless tag --from-board), until it is ended, and says records alone.
    """
    name, wire = asked.name, asked.wire
    if not is_ether(asked.radio):
        raise SkylessError(f"--radio is {asked.radio!r}; it should be the emulated air, ether:HOST[:PORT]")
    kind: Literal["anchor", "tag"] = "anchor" if name.isdecimal() else "tag"
    if kind == "anchor" and wire != "link":
        raise SkylessError(
            f"--wire is {wire!r}; it should be link for an anchor, as boards of other formats only listen"
        )
    emulated = Board(open_radios(asked.radio, kind, (name,))[0], kind, wire, asked.link, log)
    path = emulated.pty.name
    if output.json:
        print_json({"board": name, "path": path, "format": wire, "radio": f"{RADIO_OF[wire]}:{path}"})
        sys.stdout.flush()
    else:
        log(f"board {name}: emulated, at {path}")
        rest = " --anchors anchors.csv" if RADIO_OF[wire] == "sniffer" else ""
        log(f"next: skyless {kind} {name} --radio {RADIO_OF[wire]}:{path}{rest}")
    run_until_stopped(emulated.run(), punctual=True)
