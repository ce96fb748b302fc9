"""Of two survey programs at one site the later one waits, else both would save what the page asks for.

No I/O and no clock: times are passed in, by any clock that does not go back.
"""

import secrets
from typing import Final

from skyless.mqtt.messages import SurveyMessage

QUIET_S: Final = 10.0
"""A program that serves publishes a survey at least this often."""

_ENDED_S: Final = 3.0 * QUIET_S
"""An earlier program without a message for this time has ended."""


class Precedence:
    """The name of one survey program among those of its site, and whether an earlier one serves the site."""

    def __init__(self, unix_s: float) -> None:
        """``unix_s``: when this program started."""
        self.name = f"{1e3 * unix_s:014.0f}-{secrets.token_hex(4)}"
        """Programs that started earlier have lesser names."""
        self._newest: tuple[str, float] | None = None
        """Of an earlier program: its name, and the time in its newest message."""
        self._heard_s: float | None = None
        """When an earlier program was last seen to run."""

    def add(self, message: SurveyMessage, now_s: float) -> bool:
        """Process a survey on MQTT; whether it is the first that shows that this program has to wait.

        One message shows nothing: the broker may have kept it of a program that has ended. A second, different
        message does.
        """
        if message.by == "" or message.by >= self.name:
            return False
        before, self._newest = self._newest, (message.by, message.unix_s)
        if before is None or before[0] != message.by or before == self._newest:
            return False
        waited = self.waits(now_s)
        self._heard_s = now_s
        return not waited

    def waits(self, now_s: float) -> bool:
        """Whether an earlier program serves the site."""
        return self._heard_s is not None and now_s - self._heard_s < _ENDED_S
