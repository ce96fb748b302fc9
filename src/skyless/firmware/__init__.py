"""Files that run unchanged on a board under MicroPython and here; they import nothing else of Skyless.

A board has only the other files of this folder; this one replaces what MicroPython brings.
"""

ptr8 = bytearray
"""MicroPython's type of a pointer to bytes."""


class micropython:  # noqa: N801 - the module's name
    """Stands in for MicroPython's module."""

    @staticmethod
    def viper(function):  # noqa: ANN001, ANN205 - of any kind
        """Leave the function as it is."""
        return function
