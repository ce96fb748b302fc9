"""GPS without a sky: listen-only ultra-wideband positioning indoors.

The names below are the interface for programs and notebooks; they are imported when first used, so that
``import skyless`` stays light, and ``from skyless import Receiver`` needs no compiler. ``docs/architecture.md``
describes the packages that hold everything else.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from skyless.cli.api.plan import PlanResult as PlanResult
    from skyless.cli.api.plan import RatePlanResult as RatePlanResult
    from skyless.cli.api.plan import plan as plan
    from skyless.cli.api.replay import ReplayResult as ReplayResult
    from skyless.cli.api.replay import open_recording as open_recording
    from skyless.cli.api.replay import replay as replay
    from skyless.cli.api.simulate import SimulationResult as SimulationResult
    from skyless.cli.api.simulate import simulate as simulate
    from skyless.cli.api.study import StudyResult as StudyResult
    from skyless.cli.api.study import study as study
    from skyless.cli.api.survey import BiasResult as BiasResult
    from skyless.cli.api.survey import SurveyResult as SurveyResult
    from skyless.cli.api.survey import calibrate as calibrate
    from skyless.cli.api.survey import survey_site as survey_site
    from skyless.core.air.frame import Reception as Reception
    from skyless.core.air.frame import Transmission as Transmission
    from skyless.core.air.masterless_packets import PairTdoa as PairTdoa
    from skyless.core.anchor import Anchor as Anchor
    from skyless.core.errors import SkylessError as SkylessError
    from skyless.core.fix import Fix as Fix
    from skyless.core.fix import NoFixReason as NoFixReason
    from skyless.core.method_names import METHODS as METHODS
    from skyless.core.site import Site as Site
    from skyless.core.tag.position import locate as locate
    from skyless.core.tag.receiver import Receiver as Receiver
    from skyless.core.trusted_receiver import SiteTrust as SiteTrust
    from skyless.core.trusted_receiver import Trust as Trust
    from skyless.core.trusted_receiver import TrustedReceiver as TrustedReceiver
    from skyless.sim.evaluation.fleet import Fleet as Fleet
    from skyless.sim.evaluation.scenarios import Request as Request
    from skyless.sim.evaluation.scenarios import fleet_of as fleet_of
    from skyless.sim.lab import lab_site as lab_site
    from skyless.site.file.load import load_site as load_site

    __version__: str

_MODULES: Final = {
    "METHODS": "skyless.core.method_names",
    "Anchor": "skyless.core.anchor",
    "BiasResult": "skyless.cli.api.survey",
    "Fix": "skyless.core.fix",
    "Fleet": "skyless.sim.evaluation.fleet",
    "NoFixReason": "skyless.core.fix",
    "PairTdoa": "skyless.core.air.masterless_packets",
    "PlanResult": "skyless.cli.api.plan",
    "RatePlanResult": "skyless.cli.api.plan",
    "Receiver": "skyless.core.tag.receiver",
    "Reception": "skyless.core.air.frame",
    "ReplayResult": "skyless.cli.api.replay",
    "Request": "skyless.sim.evaluation.scenarios",
    "SimulationResult": "skyless.cli.api.simulate",
    "Site": "skyless.core.site",
    "SkylessError": "skyless.core.errors",
    "SiteTrust": "skyless.core.trusted_receiver",
    "StudyResult": "skyless.cli.api.study",
    "SurveyResult": "skyless.cli.api.survey",
    "Transmission": "skyless.core.air.frame",
    "Trust": "skyless.core.trusted_receiver",
    "TrustedReceiver": "skyless.core.trusted_receiver",
    "calibrate": "skyless.cli.api.survey",
    "fleet_of": "skyless.sim.evaluation.scenarios",
    "lab_site": "skyless.sim.lab",
    "load_site": "skyless.site.file.load",
    "locate": "skyless.core.tag.position",
    "open_recording": "skyless.cli.api.replay",
    "plan": "skyless.cli.api.plan",
    "replay": "skyless.cli.api.replay",
    "simulate": "skyless.cli.api.simulate",
    "study": "skyless.cli.api.study",
    "survey_site": "skyless.cli.api.survey",
}

__all__ = list(_MODULES)


def __getattr__(name: str) -> object:
    if name == "__version__":
        return import_module("importlib.metadata").version(__name__)
    module = _MODULES.get(name)
    if module is None:
        raise AttributeError(f"module 'skyless' has no attribute {name!r}")
    return getattr(import_module(module), name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
