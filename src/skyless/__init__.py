"""GPS without a sky: listen-only ultra-wideband positioning indoors.

The names below are the interface for programs and notebooks; they are imported when first used, so that
``import skyless`` stays light, and ``from skyless import Receiver`` needs no compiler. ``docs/architecture.md``
describes the packages that hold everything else.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from skyless.air.reception import Reception, Transmission
    from skyless.anchor import Anchor
    from skyless.api.calibrate import CalibrationResult, calibrate
    from skyless.api.plan import PlanResult, plan
    from skyless.api.recording import open_recording
    from skyless.api.replay import ReplayResult, replay
    from skyless.api.simulate import SimulationResult, simulate
    from skyless.api.slot_plan import SlotPlanResult
    from skyless.api.study import StudyResult, study
    from skyless.errors import SkylessError
    from skyless.evaluation.fleet import Fleet
    from skyless.evaluation.scenarios import Request, fleet_of
    from skyless.method_names import METHODS
    from skyless.positioning.fix import Fix, NoFixReason
    from skyless.positioning.methods.locate import locate
    from skyless.receiver import Receiver
    from skyless.site.lab import lab_site
    from skyless.site.load import load_site
    from skyless.site.model import Site
    from skyless.trusted_receiver import SiteTrust, Trust, TrustedReceiver

    __version__: str

_MODULES: Final = {
    "METHODS": "skyless.method_names",
    "Anchor": "skyless.anchor",
    "CalibrationResult": "skyless.api.calibrate",
    "Fix": "skyless.positioning.fix",
    "Fleet": "skyless.evaluation.fleet",
    "NoFixReason": "skyless.positioning.fix",
    "PlanResult": "skyless.api.plan",
    "Receiver": "skyless.receiver",
    "Reception": "skyless.air.reception",
    "ReplayResult": "skyless.api.replay",
    "Request": "skyless.evaluation.scenarios",
    "SimulationResult": "skyless.api.simulate",
    "Site": "skyless.site.model",
    "SkylessError": "skyless.errors",
    "SiteTrust": "skyless.trusted_receiver",
    "SlotPlanResult": "skyless.api.slot_plan",
    "StudyResult": "skyless.api.study",
    "Transmission": "skyless.air.reception",
    "Trust": "skyless.trusted_receiver",
    "TrustedReceiver": "skyless.trusted_receiver",
    "calibrate": "skyless.api.calibrate",
    "fleet_of": "skyless.evaluation.scenarios",
    "lab_site": "skyless.site.lab",
    "load_site": "skyless.site.load",
    "locate": "skyless.positioning.methods.locate",
    "open_recording": "skyless.api.recording",
    "plan": "skyless.api.plan",
    "replay": "skyless.api.replay",
    "simulate": "skyless.api.simulate",
    "study": "skyless.api.study",
}

__all__ = [
    "METHODS",
    "Anchor",
    "CalibrationResult",
    "Fix",
    "Fleet",
    "NoFixReason",
    "PlanResult",
    "Receiver",
    "Reception",
    "ReplayResult",
    "Request",
    "SimulationResult",
    "Site",
    "SiteTrust",
    "SkylessError",
    "SlotPlanResult",
    "StudyResult",
    "Transmission",
    "Trust",
    "TrustedReceiver",
    "calibrate",
    "fleet_of",
    "lab_site",
    "load_site",
    "locate",
    "open_recording",
    "plan",
    "replay",
    "simulate",
    "study",
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
