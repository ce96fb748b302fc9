"""Which slot length suits a Raspberry Pi: the table of docs/hardware.md. Simulated; some minutes.

python benchmarks/host_latency.py [SECONDS [SEEDS [SLOT_MS ...]]]
"""

import sys

import numpy as np
from host_latency_model import LatencyResult, run_hosts
from host_programs import HostLatency

SLOTS_MS = (1.05, 2.1, 2.5, 5.0, 10.0)


def main() -> None:
    """Print the table."""
    seconds, seeds = (float(word) for word in (*sys.argv[1:3], *("10", "4")[len(sys.argv[1:3]) :]))
    slots_ms = [float(word) for word in sys.argv[3:]] or SLOTS_MS
    heads = (
        "slot",
        "messages/s",
        "skipped",
        "tag heard",
        "anchors heard",
        "error",
        "bound",
        "ratio",
        "without latency",
    )
    print(f"| {' | '.join(heads)} |")
    print("|---" * len(heads) + "|")
    for slot_ms in slots_ms:
        results = runs(slot_ms, HostLatency(), seconds, int(seeds))
        assert not any(result.wrong_stamps or result.misused for result in results)
        error_m, bound_m = rms(results)
        ideal_m, ideal_bound_m = rms(runs(slot_ms, HostLatency.none(), seconds, int(seeds)))
        sent, slots = (sum(getattr(result, name) for result in results) for name in ("sent", "slots"))
        heard, relayed = (np.mean([getattr(result, name) for result in results]) for name in ("heard", "relayed"))
        print(
            f"| {slot_ms:g} ms | {sent / slots / slot_ms * 1e3:.0f} | {100 * (1 - sent / slots):.2f} % "
            f"| {100 * heard:.1f} % | {100 * relayed:.1f} % | {100 * error_m:.2f} cm | {100 * bound_m:.2f} cm "
            f"| {error_m / bound_m:.2f} | {ideal_m / ideal_bound_m:.2f} |",
            flush=True,
        )


def runs(slot_ms: float, latency: HostLatency, seconds: float, seeds: int) -> list[LatencyResult]:
    """One run for each seed."""
    return [run_hosts(1e-3 * slot_ms, latency, seconds, seed) for seed in range(1, seeds + 1)]


def rms(results: list[LatencyResult]) -> tuple[float, float]:
    """Error and bound over all fixes."""
    weights = [result.fixes for result in results]
    squares = [(result.rms_m**2, result.bound_m**2) for result in results]
    error_m, bound_m = np.sqrt(np.average(squares, axis=0, weights=weights))
    return float(error_m), float(bound_m)


if __name__ == "__main__":
    main()
