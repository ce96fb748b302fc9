"""The draws of ``chain_draws`` on a CUDA device, through the same functions and with the same numbers.

Needs a CUDA driver and toolkit that Numba finds; NVIDIA's package ``numba-cuda[cu12]`` brings the latter, and takes the
place of Numba's own target. Import it only where a device is asked
for: ``monte_carlo.gpu_available`` says whether there is one.
"""

from importlib import import_module
from typing import Any, Final

import numpy as np

from skyless.kernels.arrays import Array
from skyless.paper.chain_draws import QUANTITIES, Readings, add_draw, noise_size, sums_size

cuda: Any = import_module("numba.cuda")

THREADS_PER_BLOCK: Final = 128
BLOCKS: Final = 264
"""Two for each multiprocessor of a large device; the sums of ten anchors then take 100 MB."""


def gpu_sums(readings: Readings, seed: int, first: int, count: int, blocks: int = BLOCKS) -> Array:
    """Sums of ``count`` draws from number ``first`` on, as ``chain_draws.add_draws`` makes them, but for rounding."""
    n, threads = len(readings.anchors), blocks * THREADS_PER_BLOCK
    inputs = [cuda.to_device(a) for a in (readings.shared, readings.anchors, readings.settings, readings.ideal)]
    noise = cuda.device_array((noise_size(n), threads))
    errors = cuda.device_array((QUANTITIES, n, threads))
    sums = cuda.to_device(np.zeros((sums_size(n), threads)))
    add_share[blocks, THREADS_PER_BLOCK](seed, first, count, readings.uniform, *inputs, noise, errors, sums)
    total: Array = sums.copy_to_host().sum(axis=1)
    return total


@cuda.jit  # type: ignore[untyped-decorator]
def add_share(
    seed: int,
    first: int,
    count: int,
    uniform: bool,
    shared: Array,
    anchors: Array,
    settings: Array,
    ideal: Array,
    noise: Array,
    errors: Array,
    sums: Array,
) -> None:
    """What each thread runs: every draw whose turn it is.

    The thread is the last index of its scratch and sums, so that neighbours read neighbouring numbers.
    """
    thread = cuda.grid(1)
    for k in range(thread, count, cuda.gridsize(1)):
        add_draw(
            seed,
            first + k,
            uniform,
            shared,
            anchors,
            settings,
            ideal,
            noise[:, thread],
            errors[:, :, thread],
            sums[:, thread],
        )
