"""A history that writes files all the time, for a process that will be killed."""

import asyncio

from skyless.run.history import program
from skyless.run.history.program import HistoryNode
from skyless.run.history.writer import Keep


def keep_history(folder, site, mqtt, nats):
    """Keep the history of a site until killed."""
    program._CHECK_S, program._FIRST_FILE_S, program.FILE_S = 0.05, 0.1, 0.1
    asyncio.run(HistoryNode(folder, site, mqtt, Keep(), print, nats).run())
