"""``Alert``, in a module of its own so that programs that only read fixes load no numeric library."""

from enum import StrEnum


class Alert(StrEnum):
    """Integrity statement of a fix."""

    NONE = "none"
    EXCLUDED = "detected-excluded"
    NOT_EXCLUDED = "detected-not-excluded"
    UNAVAILABLE = "unavailable"
    LIMIT = "alert-limit-exceeded"
