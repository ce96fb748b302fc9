"""Compile the simulation before a clock runs: the first time takes some seconds, later ones load it from disk."""

from skyless.core.method_names import DEFAULT_METHOD, FILTERS
from skyless.sim.evaluation.fleet import Fleet, FleetSettings
from skyless.sim.impairments import lab_impairments
from skyless.sim.lab import lab_site, paper_lab_site
from skyless.sim.trajectory import Static


def compile_kernels(method: str = DEFAULT_METHOD) -> None:
    """Run a fifth of a second of the lab; for snapshots that of the paper, as they need its protocol."""
    site = lab_site() if method in FILTERS else paper_lab_site()
    fleet = Fleet(site, [Static(3.0, 4.0)], lab_impairments(100.0), 0, FleetSettings(method, warmup_s=0.0))
    for _ in fleet.run(0.2):
        pass
