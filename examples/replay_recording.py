"""A recording of time differences becomes fixes, judged against the truth.

The recording is made up here, so that the example needs no file: a tag on a circle, eight anchors, 10 cm of noise.
Yours goes where ``recording`` stands; other formats (Bitcraze sniffers, MCAP of ``skyless record``, ...) are recognised
by their content. Picture: ``python replay_recording.py flight.png``.
"""

import random
import sys
import tempfile
from itertools import product
from math import cos, dist, sin
from pathlib import Path

import skyless

ANCHORS_M = dict(enumerate(product((0.0, 8.0), (0.0, 6.0), (0.2, 2.8)), start=1))
NOISE_M = 0.1


def position_m(t_s: float) -> tuple[float, float, float]:
    """Where the tag is: half a metre per second on a circle of 1.5 m, 1.2 m high."""
    return 4.0 + 1.5 * cos(t_s / 3.0), 3.0 + 1.5 * sin(t_s / 3.0), 1.2


def write_recording(path: Path, seconds: float) -> None:
    """500 time differences a second, each of two anchors."""
    draw = random.Random(1)
    lines = ["t_s,idA,idB,tdoa_m"]
    for number in range(round(500 * seconds)):
        t_s = number / 500.0
        a, b = draw.sample(list(ANCHORS_M), 2)
        tag_m = position_m(t_s)
        tdoa_m = dist(tag_m, ANCHORS_M[b]) - dist(tag_m, ANCHORS_M[a]) + draw.gauss(0.0, NOISE_M)
        lines.append(f"{t_s:.3f},{a},{b},{tdoa_m:.4f}")
    path.write_text("\n".join(lines) + "\n")


with tempfile.TemporaryDirectory() as folder:
    recording = Path(folder) / "circle.csv"
    write_recording(recording, seconds=6.0)
    truth = [(k / 20.0, *position_m(k / 20.0)) for k in range(121)]  # rows of time, x, y, z
    result = skyless.replay(recording, anchors=ANCHORS_M, truth=truth, settle_s=1.0)

print(result)
worst = abs(result.fixes.error_m[result.fixes.judged]).max(axis=0)
print("largest error along x, y, z in cm:", (100 * worst).round(1))
if len(sys.argv) > 1:
    result.plot().savefig(sys.argv[1])
