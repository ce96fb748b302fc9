"""What other programs' decoders get of a running site, as lines for a picture: ``python docs/pictures/listen.py KIND``.

- ``vehicle PORT``: pymavlink as a vehicle of system 1, at the port that ``mavlink+udpout`` sends to.

It ends after as many lines as a picture holds.
"""

import math
import selectors
import socket
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, Final

SECONDS: Final = 20.0


def datagrams(*ports: int) -> Iterator[tuple[int, bytes]]:
    """What comes to ports, with the number of the port, for ``SECONDS``."""
    with selectors.DefaultSelector() as selector:
        for port in ports:
            receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            receiver.bind(("127.0.0.1", port))
            selector.register(receiver, selectors.EVENT_READ)
        end_s = time.monotonic() + SECONDS
        while (left_s := end_s - time.monotonic()) > 0.0:
            for key, _ in selector.select(left_s):
                assert isinstance(key.fileobj, socket.socket)
                yield key.fileobj.getsockname()[1], key.fileobj.recv(1 << 16)


def shown(value: Any) -> str:
    """A field's value, shortly: a covariance as its diagonal's first three standard deviations."""
    if isinstance(value, list) and len(value) == 21:
        variances = value[0], value[6], value[11]
        return "σ " + " ".join("nan" if math.isnan(one) else f"{math.sqrt(one):.3f}" for one in variances)
    if isinstance(value, list):
        return "[" + " ".join(shown(one) for one in value) + "]"
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def vehicle(port: str) -> None:
    """Each message once, with all its fields, then a few lines of positions."""
    from pymavlink.dialects.v20 import ardupilotmega

    link = ardupilotmega.MAVLink(None)
    seen: set[str] = set()
    lines = 0
    for _, data in datagrams(int(port)):
        for message in link.parse_buffer(data) or []:
            kind = message.get_type()
            fields = message.to_dict()
            del fields["mavpackettype"]
            if kind not in seen:
                seen.add(kind)
                print(f"\033[1;36m{kind}\033[0m from {message.get_srcSystem()}/{message.get_srcComponent()}")
                print("  " + ", ".join(f"{name} {shown(value)}" for name, value in fields.items()))
            elif "x" in fields or "lat" in fields:
                names = ("x", "y", "z") if "x" in fields else ("lat", "lon", "alt")
                print(f"{kind}: " + ", ".join(f"{name} {shown(fields[name])}" for name in names), flush=True)
                lines += 1
            if lines == 8:
                return


if __name__ == "__main__":
    KINDS: dict[str, Callable[..., None]] = {"vehicle": vehicle}
    KINDS[sys.argv[1]](*sys.argv[2:])
