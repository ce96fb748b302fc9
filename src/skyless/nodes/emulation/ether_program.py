"""``skyless ether``: the emulated air as a program, with what only it knows, the truth, on MQTT."""

import time
from typing import Final

from skyless.mqtt.address import MqttAddress
from skyless.mqtt.topics import health_topic, truth_topic
from skyless.nodes.emulation.ether import Ether
from skyless.nodes.process.running import HEALTH_S, Log, every, keep, link_of, together

TRUTH_S: Final = 0.05


class Air:
    """An ether that listens, and its link."""

    def __init__(self, ether: Ether, host: str, port: int, address: MqttAddress | None, say: Log) -> None:
        self._ether, self._host, self._port, self._say = ether, host, port, say
        self._site = ether.site.id
        self._link = link_of(address, "air", site=self._site, kind="ether")

    async def run(self) -> None:
        """Serve until cancelled.

        Raises:
            OSError: the address cannot be listened to.
        """
        server = await self._ether.serve(self._host, self._port)
        host, port = server.sockets[0].getsockname()[:2]
        self._say(f"ether at {f'[{host}]' if ':' in host else host}:{port}")
        async with server:
            parts = [self._ether.tell_clocks()]
            if self._link is not None:
                parts += [
                    keep(self._link, self._say),
                    every(TRUTH_S, self._tell_truth),
                    every(HEALTH_S, self._tell_health),
                ]
            await together(*parts)

    def _tell_truth(self) -> None:
        if self._link is not None:
            self._link.publish(truth_topic(self._site), self._ether.truth(time.time() - time.monotonic()))

    def _tell_health(self) -> None:
        if self._link is not None:
            self._link.publish(health_topic(self._site, "ether", "air"), self._ether.health(time.time()))
