"""OpenCL C sources: one .cl per pass, one .h per idea. Knows nobody."""

from importlib.resources import files
from pathlib import Path


def include_directory() -> Path:
    """Folder for the compiler's ``-I``; the kernels use real includes."""
    return Path(str(files(__name__)))


def source(name: str) -> str:
    """Text of one kernel file, for example ``gather_probes.cl``."""
    return (include_directory() / name).read_text(encoding="utf-8")
