"""The process that draws the installer's sheet, with Matplotlib, which the server does not load."""

import time

import msgspec
from msgspec import Struct

from skyless.core.site import Site
from skyless.page.task_process import serve_tasks
from skyless.site.planning.sheet import sheet


class SheetTask(Struct, frozen=True):
    """What to draw, as JSON."""

    site: Site


def answer(task: bytes) -> bytes:
    """The sheet as a PDF."""
    site = msgspec.json.decode(task, type=SheetTask).site
    return sheet(site, None, "pdf", time.strftime("%Y-%m-%d"), None)


if __name__ == "__main__":
    serve_tasks(answer)
