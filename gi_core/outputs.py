"""Whether what a command is to write can be written: said before an hour of work is lost to a typing mistake."""

import os
import tempfile
from pathlib import Path

from gi_core.errors import InputError


def expect_folder(path: Path, option: str) -> None:
    """InputError unless a folder takes files, or can be made, its missing parents too. Leaves nothing."""
    if os.path.exists(path) and not os.path.isdir(path):
        raise InputError(f"{option} {path}: expected a folder, or a name for a new one; found a file")
    # os.path's answer is no, where Path's is an error, for what lies in a folder that must not be looked into.
    there = next(folder for folder in (path.absolute(), *path.absolute().parents) if os.path.exists(folder))
    _expect_room_in(there, f"{option} {path}: expected a folder that can be written, or made")


def expect_file(path: Path, option: str) -> None:
    """InputError unless a file can be put there, in a folder that exists. Leaves nothing."""
    expected = f"{option} {path}: expected a file in a folder that exists"
    if os.path.isdir(path):
        raise InputError(f"{expected}; found a folder")
    _expect_room_in(path.absolute().parent, expected)


def _expect_room_in(folder: Path, expected: str) -> None:
    """Permissions alone do not tell: a file system may be read-only or full, or take no files, as /proc does."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"{expected}; {folder} takes no file ({error.strerror or error})") from error
