"""GPS without a sky: listen-only ultra-wideband positioning indoors.

The names below are the interface for programs and notebooks; they are imported when first used, so that
``import skyless`` stays light, and ``from skyless import Receiver`` needs no compiler. ``docs/architecture.md``
describes the packages that hold everything else.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from skyless.cli.api.plan import PlanResult, plan
    from skyless.cli.api.rate_plan import RatePlanResult
    from skyless.cli.api.replay import ReplayResult, open_recording, replay
    from skyless.cli.api.simulate import SimulationResult, simulate
    from skyless.cli.api.study import StudyResult, study
    from skyless.cli.api.survey import BiasResult, SurveyResult, survey_site
    from skyless.core.air.masterless_packets import PairTdoa
    from skyless.core.air.reception import Reception, Transmission
    from skyless.core.anchor.anchor import Anchor
    from skyless.core.errors import SkylessError
    from skyless.core.fix import Fix, NoFixReason
    from skyless.core.method_names import METHODS
    from skyless.core.site import Site
    from skyless.core.tag.locate import locate
    from skyless.core.tag.receiver import Receiver
    from skyless.core.trusted_receiver import SiteTrust, Trust, TrustedReceiver
    from skyless.sim.evaluation.fleet import Fleet
    from skyless.sim.evaluation.scenarios import Request, fleet_of
    from skyless.sim.lab import lab_site
    from skyless.site.file.load import load_site

    __version__: str

_MODULES: Final = {
    "METHODS": "skyless.core.method_names",
    "Anchor": "skyless.core.anchor.anchor",
    "BiasResult": "skyless.cli.api.survey",
    "Fix": "skyless.core.fix",
    "Fleet": "skyless.sim.evaluation.fleet",
    "NoFixReason": "skyless.core.fix",
    "PairTdoa": "skyless.core.air.masterless_packets",
    "PlanResult": "skyless.cli.api.plan",
    "RatePlanResult": "skyless.cli.api.rate_plan",
    "Receiver": "skyless.core.tag.receiver",
    "Reception": "skyless.core.air.reception",
    "ReplayResult": "skyless.cli.api.replay",
    "Request": "skyless.sim.evaluation.scenarios",
    "SimulationResult": "skyless.cli.api.simulate",
    "Site": "skyless.core.site",
    "SkylessError": "skyless.core.errors",
    "SiteTrust": "skyless.core.trusted_receiver",
    "StudyResult": "skyless.cli.api.study",
    "SurveyResult": "skyless.cli.api.survey",
    "Transmission": "skyless.core.air.reception",
    "Trust": "skyless.core.trusted_receiver",
    "TrustedReceiver": "skyless.core.trusted_receiver",
    "fleet_of": "skyless.sim.evaluation.scenarios",
    "lab_site": "skyless.sim.lab",
    "load_site": "skyless.site.file.load",
    "locate": "skyless.core.tag.locate",
    "open_recording": "skyless.cli.api.replay",
    "plan": "skyless.cli.api.plan",
    "replay": "skyless.cli.api.replay",
    "simulate": "skyless.cli.api.simulate",
    "study": "skyless.cli.api.study",
    "survey_site": "skyless.cli.api.survey",
}

__all__ = [
    "METHODS",
    "Anchor",
    "BiasResult",
    "Fix",
    "Fleet",
    "NoFixReason",
    "PairTdoa",
    "PlanResult",
    "RatePlanResult",
    "Receiver",
    "Reception",
    "ReplayResult",
    "Request",
    "SimulationResult",
    "Site",
    "SiteTrust",
    "SkylessError",
    "StudyResult",
    "SurveyResult",
    "Transmission",
    "Trust",
    "TrustedReceiver",
    "fleet_of",
    "lab_site",
    "load_site",
    "locate",
    "open_recording",
    "plan",
    "replay",
    "simulate",
    "study",
    "survey_site",
]


def __getattr__(name: str) -> object:
    if name == "__version__":
        return import_module("importlib.metadata").version(__name__)
    module = _MODULES.get(name)
    if module is None:
        raise AttributeError(f"module 'skyless' has no attribute {name!r}")
    return getattr(import_module(module), name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
