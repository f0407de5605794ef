"""Which version of the program this is."""

from importlib.metadata import PackageNotFoundError, version


def program_version() -> str:
    """The installed distribution's version."""
    try:
        return version("sectorlight")
    except PackageNotFoundError:  # run from a checkout that is not installed
        return "0+unknown"
