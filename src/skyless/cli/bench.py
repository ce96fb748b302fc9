"""``skyless bench``: how fast filters and Monte Carlo draws run on this machine."""

from typing import TYPE_CHECKING, Annotated, Final

from cyclopts import App

from skyless.cli.common.options import JsonOptions, command
from skyless.cli.common.output import console, print_json
from skyless.cli.common.progress import status
from skyless.core.arguments import whole

if TYPE_CHECKING:
    from skyless.research.bench.measure import Speed
    from skyless.research.bench.monte_carlo_speed import MonteCarloSpeed

_QUICK_DRAWS: Final = 100_000

app = App(name="bench", help_epilogue="Example: skyless bench --json")


@app.default
@command
def bench(
    *,
    draws: Annotated[int, whole(100, 10**9)] = 1_000_000,
    anchor_count: Annotated[int, whole(1, 1000)] = 10,
    quick: bool = False,
    output: JsonOptions,
) -> None:
    """Measure filters and Monte Carlo draws next to plain NumPy, filterpy, scipy and plain compiled loops.

    The filters' figures are medians of several short runs on one core, in CPU time.

    Parameters
    ----------
    draws
        Draws of the paper's chain, compiled; the NumPy loop makes a hundredth of them.
    anchor_count
        How many anchors each draw has.
    quick
        Compute a fraction: a few seconds only, with fewer and shorter runs and at most a tenth of a million draws.
    """
    from skyless.research.bench.measure import FULL_EFFORT, QUICK_EFFORT, measure_all
    from skyless.research.bench.monte_carlo_speed import measure

    draws = min(draws, _QUICK_DRAWS) if quick else draws
    with status("filters"):
        speed = measure_all(QUICK_EFFORT if quick else FULL_EFFORT)
    with status(f"{draws:,} draws of {anchor_count} anchors"):
        chain = measure(draws, anchor_count)
    if output.json:
        from msgspec.structs import asdict

        print_json({**asdict(speed), "monte_carlo": chain})
        return
    _print_table(speed, chain)


def _print_table(speed: "Speed", chain: "MonteCarloSpeed") -> None:
    out = console()
    load = "" if speed.load is None else f", load {speed.load:.1f}"
    out.print(f"{speed.cores} cores{load}; filters on one core, medians")
    kernels = speed.kernels
    for name, kernel in (
        ("joint", kernels.joint),
        ("joint, mesh", kernels.joint_mesh),
        ("joint, room", kernels.joint_room),
        ("joint, room, mesh", kernels.joint_room_mesh),
    ):
        ratios = f"{kernel.ratio:.0f} × NumPy, {kernel.loop_ratio:.2f} × a plain compiled loop"
        if kernel.filterpy_ratio is not None:
            ratios += f", {kernel.filterpy_ratio:.0f} × filterpy"
        out.print(f"{name:<24}{kernel.messages_per_s:>14,.0f} messages/s  {ratios}")
    out.print(f"{'Receiver, joint':<24}{1e6 * kernels.streaming.seconds_per_message:>14.1f} µs a message")
    snapshots = speed.snapshots
    out.print(
        f"{'snapshots':<24}{snapshots.fixes_per_s:>14,.0f} fixes/s  {snapshots.ratio:.1f} × scipy's least_squares"
    )
    for name, tags in speed.tags.items():
        each = ", ".join(f"{value:.0f} ns with {count:,}" for count, value in tags.ns_per_message.items())
        all_cores = f"{tags.all_cores_messages_per_s:,.0f} messages/s on all cores"
        out.print(f"{'tags at once, ' + name:<24}{each} tags; {all_cores}")
    if speed.filterpy_missing:
        out.print(speed.filterpy_missing)
    for name, rate in (
        ("NumPy loop, one core", chain.numpy_loop_draws_per_s),
        ("compiled, one core", chain.one_core_draws_per_s),
        (f"compiled, {chain.cores} cores", chain.all_cores_draws_per_s),
    ):
        out.print(f"{name:<24}{rate:>14,.0f} draws/s")
    out.print(f"compiled over NumPy loop, one core: {chain.ratio:.1f} times")
