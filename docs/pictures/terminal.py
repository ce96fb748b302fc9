"""Output of a program as a picture of a terminal: ``PROGRAM | python docs/pictures/terminal.py NAME.svg "its title"``.

The pictures of ``docs/tools`` are made so, from what the programs that they show really wrote.
"""

import re
import sys
from io import StringIO
from pathlib import Path
from typing import Final

from rich.console import Console
from rich.terminal_theme import MONOKAI
from rich.text import Text

WIDTH: Final = 100
_MAX_LINES: Final = 40


def terminal_svg(text: str, title: str, width: int = WIDTH) -> str:
    """The text with its colours, if it has any, in a window with a title; the fonts are the reader's own."""
    console = Console(record=True, width=width, file=StringIO(), legacy_windows=False)
    for line in text.rstrip().splitlines()[:_MAX_LINES]:
        console.print(Text.from_ansi(line), soft_wrap=False, overflow="fold")
    svg = console.export_svg(title=title, theme=MONOKAI, unique_id="terminal")
    return re.sub(r"@font-face \{.*?\}\s*", "", svg, flags=re.DOTALL).replace("Fira Code, ", "")


if __name__ == "__main__":
    out, title = sys.argv[1:]
    Path(out).write_text(terminal_svg(sys.stdin.read(), title), encoding="utf-8")
