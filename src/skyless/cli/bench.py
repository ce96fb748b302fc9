"""``skyless bench``: how fast the heavy parts run here."""

from typing import Annotated

from cyclopts import App, Parameter
from cyclopts.validators import Number

app = App(name="bench", help_epilogue="Example: skyless bench --draws 1000000 --json")


@app.default
def bench(
    *,
    draws: Annotated[int, Parameter(validator=Number(gte=100, lte=10**9))] = 1_000_000,
    anchors: Annotated[int, Parameter(validator=Number(gte=1, lte=1000))] = 10,
    json: bool = False,
) -> None:
    """Measure Monte Carlo draws of the paper's chain beside a plain NumPy loop over the same draws.

    Parameters
    ----------
    draws
        Draws of the compiled chain; the NumPy loop makes a hundredth of them.
    anchors
        Anchors in each draw.
    json
        Write one JSON object instead of a table.
    """
    from skyless.cli.output import console, print_json
    from skyless.cli.progress import status
    from skyless.experiments.yardstick import measure

    with status(f"{draws:,} draws of {anchors} anchors"):
        speed = measure(draws, anchors)
    if json:
        print_json({"monte_carlo": speed})
        return
    rows = [
        ("NumPy loop, one core", speed.numpy_loop_draws_per_s),
        ("compiled, one core", speed.one_core_draws_per_s),
        (f"compiled, {speed.cores} cores", speed.all_cores_draws_per_s),
        ("GPU", speed.gpu_draws_per_s),
    ]
    out = console()
    for name, rate in rows:
        out.print(f"{name:<24}" + (f"{rate:>14,.0f} draws/s" if rate is not None else f"{'none here':>14}"))
    out.print(f"compiled over NumPy loop, one core: {speed.ratio:.1f} times")
