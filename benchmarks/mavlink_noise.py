"""A million random inputs to the reader of MAVLink frames: ``.venv/bin/python benchmarks/mavlink_noise.py [COUNT]``.

Noise, frames with damaged bytes, and frames with right checks and random contents, cut into random pieces. Nothing may
raise, and no more than one frame may be kept.
"""

import random
import sys
import time

from skyless.bridges.mavlink import CRC_EXTRAS, MAGIC_1, MAGIC_2, MavlinkEncoder, frame
from skyless.bridges.target import BridgedSite


def noise(rng: random.Random) -> bytes:
    """One input."""
    kind = rng.randrange(4)
    data = bytearray(rng.randbytes(rng.randrange(60)))
    if kind == 0:
        return bytes(data)
    if kind == 1:  # begins like a frame
        return bytes([rng.choice((MAGIC_1, MAGIC_2))]) + data
    number = rng.choice((*CRC_EXTRAS, rng.randrange(1 << 24)))
    extra = CRC_EXTRAS.get(number, rng.randrange(256))
    made = bytearray(frame(number, extra, bytes(data) or b"\0", sequence=rng.randrange(256), system=1, component=1))
    if kind == 2:
        made[rng.randrange(len(made))] ^= 1 << rng.randrange(8)
    return bytes(made)


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
    rng = random.Random(1)
    encoder = MavlinkEncoder("px4")
    encoder.on_site(BridgedSite(1, "hall", True, {}))
    answers, most = 0, 0
    start_s = time.monotonic()
    for _ in range(count):
        answers += len(encoder.on_bytes(noise(rng), rng.getrandbits(62)))
        most = max(most, len(encoder._reader._buffer))
    assert most <= 280, most
    print(
        f"{count} inputs in {time.monotonic() - start_s:.0f} s: {answers} questions answered, "
        f"{encoder.dropped['mavlink-check']} damaged frames, at most {most} bytes kept"
    )


if __name__ == "__main__":
    main()
