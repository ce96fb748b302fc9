"""How the error grows with the share of messages that are lost: at the tags alone, or between anchors as well."""

from typing import Final

from skyless.experiments.studies.plan import Plan
from skyless.experiments.studies.stage import walking
from skyless.experiments.studies.summary import Case

SHARES: Final = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
QUICK: Final = (0.3, 0.5, 0.7, 0.9)
LIMITS: Final = {0.5: 1.3, 0.9: 2.5}
CLEAN: Final = "nothing lost"

AT_TAGS: Final = "lost at tags"
EVERYWHERE: Final = "lost everywhere"


def cases(plan: Plan) -> list[Case]:
    """Both kinds of loss, one case for each share."""
    clean = walking(plan)
    shares = QUICK if plan.quick else SHARES
    return [
        Case(CLEAN, AT_TAGS, 0.0, clean, CLEAN),
        *(Case(_name(s, AT_TAGS), AT_TAGS, s, walking(plan, lost_at_tags=s), CLEAN, LIMITS.get(s)) for s in shares),
        *(Case(_name(s, EVERYWHERE), EVERYWHERE, s, walking(plan, loss=s), CLEAN, LIMITS.get(s)) for s in shares),
    ]


def _name(share: float, kind: str) -> str:
    return f"{100 * share:.0f} % {kind}"
