"""Process that draws the installer's sheet with Matplotlib, which the server does not load."""

import time

from skyless.core.site import Site
from skyless.page.tasks import serve_tasks
from skyless.site.planning.sheet import sheet


def answer(site: Site) -> bytes:
    """Draw the sheet as a PDF."""
    return sheet(site, None, "pdf", time.strftime("%Y-%m-%d"), None)


if __name__ == "__main__":
    serve_tasks(Site, answer)
