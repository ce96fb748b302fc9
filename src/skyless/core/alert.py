"""What a fix states of its integrity; on its own, so that programs that only read fixes load no numeric library."""

from enum import StrEnum


class Alert(StrEnum):
    """What a fix states of its integrity."""

    NONE = "none"
    EXCLUDED = "detected-excluded"
    NOT_EXCLUDED = "detected-not-excluded"
    UNAVAILABLE = "unavailable"
    LIMIT = "alert-limit-exceeded"
