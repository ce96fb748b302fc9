"""What fixes say of their integrity, in words that need no arithmetic."""

from enum import StrEnum


class Alert(StrEnum):
    """What a fix says of its integrity."""

    NONE = "none"
    EXCLUDED = "detected-excluded"
    NOT_EXCLUDED = "detected-not-excluded"
    UNAVAILABLE = "unavailable"
    LIMIT = "alert-limit-exceeded"
