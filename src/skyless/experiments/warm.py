"""Compile the kernels before a clock runs: the first time takes seconds, later ones load them from disk."""

from skyless.experiments.fleet import Fleet, FleetSettings
from skyless.simulation.scenario import lab_impairments
from skyless.simulation.trajectory import Static
from skyless.site.lab import lab_site


def compile_kernels(method: str = "tracker") -> None:
    """Run a fifth of a second of the lab."""
    fleet = Fleet(lab_site(), [Static(3.0, 4.0)], lab_impairments(100.0), 0, FleetSettings(method, warmup_s=0.0))
    for _ in fleet.run(0.2):
        pass
