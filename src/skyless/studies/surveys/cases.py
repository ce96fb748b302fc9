"""What the study ``survey`` varies: kinds of air, surveys that use it, and the limits of their figures."""

from typing import Final

from msgspec import Struct

from skyless.studies.plan import Limit

LATE_M: Final = (0.2, 1.0)
"""By how much late pairs are."""
_LATE_S: Final = 2.0
"""Length of runs with late pairs, whose errors do not average out."""


class Variant(Struct, frozen=True):
    """One survey of a run's air."""

    name: str
    delay_std_m: float
    """What the survey expects."""
    tapes: int = 0
    """Distances that the survey without them asked for."""
    keeps: bool = False
    """Positions by hand are kept."""
    sketched: bool = False


class Group(Struct, frozen=True):
    """One kind of air, and the surveys that use it."""

    name: str
    variants: tuple[Variant, ...]
    delay_std_m: float = 0.0
    """With which delays are drawn."""
    pair_std_m: float = 0.0
    late_share: float = 0.0
    missing_share: float = 0.0
    seconds: float | None = None


_KNOWN: Final = Variant("delays known", 0.0)
_EXACT: Final = (
    Group("exact", (_KNOWN,)),
    Group("1 s", (Variant("delays known, 1 s", 0.0),), seconds=1.0),
)
_DELAYS: Final = Group(
    "delays",
    (
        Variant("delays 15 cm", 0.15),
        Variant("delays 15 cm, a tape", 0.15, tapes=1),
        Variant("delays 15 cm, 3 tapes", 0.15, tapes=3),
        Variant("delays 15 cm, positions kept", 0.15, keeps=True),
    ),
    delay_std_m=0.15,
)
_PAIRS: Final = Group("pairs", (Variant("pairs 2 cm, delays 7 cm", 0.07),), delay_std_m=0.07, pair_std_m=0.02)
_CLEAN: Final = Group("clean", (Variant("pairs 3 cm", 0.0),), pair_std_m=0.03, seconds=_LATE_S)
_LATE: Final = Group("late", (Variant("10 % late", 0.0),), pair_std_m=0.03, late_share=0.1, seconds=_LATE_S)
_LATE_HALL: Final = Group(
    "late",
    (Variant("10 % late, 25 % missing, delays 7 cm", 0.07),),
    delay_std_m=0.07,
    pair_std_m=0.03,
    late_share=0.1,
    missing_share=0.25,
    seconds=_LATE_S,
)
_VERY_LATE: Final = Group("very late", (Variant("30 % late", 0.0),), pair_std_m=0.03, late_share=0.3, seconds=_LATE_S)
_VERY_LATE_HALL: Final = Group(
    "very late",
    (Variant("30 % late, 25 % missing", 0.0), Variant("30 % late, 25 % missing, sketch", 0.0, sketched=True)),
    pair_std_m=0.03,
    late_share=0.3,
    missing_share=0.25,
    seconds=_LATE_S,
)
GROUPS: Final = {
    "lab": (*_EXACT, _DELAYS, _PAIRS, _CLEAN, _LATE, _VERY_LATE),
    "room": (*_EXACT, _DELAYS, _PAIRS, _CLEAN, _LATE),
    "hall": (*_EXACT, _DELAYS, _PAIRS, _CLEAN, _LATE_HALL, _VERY_LATE_HALL),
}


def limits_of(layout: str, case: str) -> tuple[Limit, ...]:
    """Limits of issue 13 (``docs/survey.md``, "Figures")."""
    of = {"lab": 0, "room": 1, "hall": 2}[layout]
    honest = Limit("nees", 0.9, 1.1)
    found: dict[str, tuple[Limit, ...]] = {
        "delays known": (Limit("ratio", most=1.07), honest),
        "delays known, 1 s": (Limit("ratio", most=1.07), honest),
        "delays 15 cm": (
            (Limit("undetermined", 1.0),) if layout == "lab" else (Limit("rmse_m", most=(0.0, 0.006, 0.0022)[of]),)
        ),
        "delays 15 cm, a tape": (Limit("rmse_m", most=0.0045),) if layout == "lab" else (),
        "delays 15 cm, positions kept": (
            Limit("delay_m", most=(0.016, 0.016, 0.014)[of]),
            Limit("tag_m", most=(0.016, 0.024, 0.013)[of]),
        ),
        "pairs 2 cm, delays 7 cm": (
            Limit("ratio", most=1.05),
            honest,
            Limit("tag_m", most=(0.020, 0.026, 0.012)[of]),
        ),
        "pairs 3 cm": (Limit("flagged", most=0.01),),
        "10 % late": (*((Limit("near", 0.8),) if layout == "lab" else ()), Limit("wrong_flagged", 0.9)),
        "30 % late": (Limit("wrong_flagged", 0.9),),
        "10 % late, 25 % missing, delays 7 cm": (
            Limit("near", 0.95),
            Limit("excluded_wrongly", most=0.02),
            Limit("wrong_flagged", 0.9),
        ),
        "30 % late, 25 % missing": (Limit("wrong_flagged", 0.9),),
        "30 % late, 25 % missing, sketch": (Limit("near", 0.8), Limit("wrong_flagged", 0.9)),
    }
    return found.get(case, ())
