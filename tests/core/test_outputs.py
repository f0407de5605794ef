import errno
import os
from pathlib import Path

import pytest

from gi_core.errors import InputError
from gi_core.outputs import expect_file, expect_folder


def test_what_can_be_written_is_left_as_it_was(tmp_path):
    (tmp_path / "there").mkdir()
    (tmp_path / "old.json").write_text("[]")
    for folder in ("there", "new", "new/below/it"):
        expect_folder(tmp_path / folder, "--output")
    for file in ("new.json", "old.json", "there/new.json"):
        expect_file(tmp_path / file, "--json")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["old.json", "there"]
    assert (tmp_path / "old.json").read_text() == "[]"


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("file", "found a file"),
        ("file/below", r"/file takes no file \(Not a directory\)"),
        ("file/below/it", r"/file takes no file \(Not a directory\)"),
    ],
)
def test_a_file_in_the_place_of_a_folder_is_the_users_mistake(tmp_path, name, reason):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match=rf"--output .*/{name}: expected a folder.*{reason}"):
        expect_folder(tmp_path / name, "--output")
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize("name", ["", "nowhere/out.json", "file/out.json"])
def test_no_file_is_made_over_a_folder_or_in_one_that_is_not_there(tmp_path, name):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match=r"--json .*: expected a file in a folder that exists; .*(found a folder|takes no file)"):
        expect_file(tmp_path / name, "--json")
    assert [path.name for path in tmp_path.rglob("*")] == ["file"]


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="there is no /proc here")
def test_a_folder_that_may_be_written_but_takes_no_files_is_refused():
    for name in ("/proc/nope", "/proc/self/fd"):
        with pytest.raises(InputError, match=r"expected a folder that can be written, or made; /proc\S* takes no file \(No such file"):
            expect_folder(Path(name), "--output")


@pytest.mark.parametrize("number", [errno.EACCES, errno.EROFS, errno.ENOSPC])
def test_the_system_s_reason_is_told(tmp_path, monkeypatch, number):
    def refuse(**_):
        raise OSError(number, os.strerror(number), "a name of nobody's")

    monkeypatch.setattr("tempfile.TemporaryFile", refuse)
    with pytest.raises(InputError, match=rf"{tmp_path} takes no file \({os.strerror(number)}\)$"):
        expect_folder(tmp_path / "out", "--output")
