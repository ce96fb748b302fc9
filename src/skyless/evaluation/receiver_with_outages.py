"""A tag whose radio hears nothing for a while."""

from skyless.air.reception import Reception
from skyless.positioning.fix import Fix
from skyless.positioning.integrity import IntegrityRequirement
from skyless.receiver import Receiver
from skyless.simulation.impairments import Outage


class ReceiverWithOutages(Receiver):
    """Counts what it would have heard while deaf as dropped; unlike after an outage, its counter has gone on."""

    def __init__(
        self, method: str, *, qa: float, integrity: IntegrityRequirement, silences: tuple[Outage, ...]
    ) -> None:
        """``silences`` are in the time of the host, which in the simulated world is the true one.

        Raises:
            ValueError: there is no such method.
        """
        super().__init__(method, qa=qa, integrity=integrity)
        self._silences = silences

    def hear(self, reception: Reception) -> Fix | None:
        """See ``Receiver``."""
        host_s = reception.host_s
        if host_s is not None and any(silence.off_s <= host_s < silence.on_s for silence in self._silences):
            self.counters["deaf"] += 1
            return None
        return super().hear(reception)
