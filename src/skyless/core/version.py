"""The version of the installed package."""


def installed_version() -> str:
    """Version that pip shows for ``skyless``; read on demand, because ``importlib.metadata`` is slow to import."""
    from importlib.metadata import version  # noqa: PLC0415

    return version("skyless")
