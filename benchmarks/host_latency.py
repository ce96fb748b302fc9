"""Which slot length suits a Raspberry Pi with a DW1000 on its SPI: the tables of docs/hardware.md. Simulated.

    python benchmarks/host_latency.py [--seconds 11] [--seeds 2] [--slot-ms 2.1 …]
    python benchmarks/host_latency.py --seconds 6 --slot-ms 2.1 --lead-ms 1 1.5 2      # anchors keep to this lead

Frames that come too late are skipped, and cost their slots.
"""

import argparse
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "firmware"))

import numpy as np
from emulator.site.delayed_hosts import WARMUP_S, run_hosts
from emulator.site.host_programs import HostLatency

SLOTS_MS = (1.05, 2.1, 2.5, 5.0, 10.0)


def runs(slot_ms, latency, asked, lead_ms=None):
    """One run for each seed; none with a wrong stamp."""
    lead_s = None if lead_ms is None else 1e-3 * lead_ms
    seeds = range(1, asked.seeds + 1)
    results = [run_hosts(1e-3 * slot_ms, latency, asked.seconds, seed, lead_s) for seed in seeds]
    assert not any(result.wrong_stamps or result.misused for result in results)
    return results


def rms_cm(results):
    """Error and bound over all fixes."""
    squares = [(result.rms_m**2, result.bound_m**2) for result in results]
    return 100.0 * np.sqrt(np.average(squares, axis=0, weights=[result.fixes for result in results]))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=11.0)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--slot-ms", type=float, nargs="+", default=SLOTS_MS)
    parser.add_argument("--lead-ms", type=float, nargs="+", default=[None], help="instead of one that adapts")
    asked = parser.parse_args()
    if asked.seconds < WARMUP_S + 2.0:
        parser.error(f"argument --seconds: {asked.seconds:g} should be {WARMUP_S + 2.0:g} or more")
    names = ("slot", "lead", "messages/s", "skipped", "tag heard", "anchors heard", "error", "bound", "error / bound",
             "without latency")  # fmt: skip
    print(f"| {' | '.join(names)} |\n{'|---' * len(names)}|")
    for slot_ms in asked.slot_ms:
        ideal_cm = rms_cm(runs(slot_ms, HostLatency(0.0, 0.0, 0.0, 0.0, 0.0), asked))
        for lead_ms in asked.lead_ms:
            results = runs(slot_ms, HostLatency(), asked, lead_ms)
            error_cm, bound_cm = rms_cm(results)
            sent, slots = (sum(getattr(result, name) for result in results) for name in ("sent", "slots"))
            heard, relayed = (np.mean([getattr(result, name) for result in results]) for name in ("heard", "relayed"))
            print(
                f"| {slot_ms:g} ms | {'adapts' if lead_ms is None else f'{lead_ms:g} ms'} "
                f"| {sent / slots / slot_ms * 1e3:.0f} | {100 * (1 - sent / slots):.2f} % | {100 * heard:.1f} % "
                f"| {100 * relayed:.1f} % | {error_cm:.2f} cm | {bound_cm:.2f} cm | {error_cm / bound_cm:.2f} "
                f"| {ideal_cm[0] / ideal_cm[1]:.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
