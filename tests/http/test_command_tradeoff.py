"""``sectorlight tradeoff``: its files and its refusals. What a sweep measures is held elsewhere."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

RunCommand = Callable[..., Any]
SOURCE = "procedural:midtown?blocks=1x1&seed=1"
SMALL = ("--points", "3", "--samples", "16", "--states", "noon", "--jobs", "1", "--sectors", "0:1,0:1")


def test_it_leaves_a_table_json_and_a_plot(sectorlight: RunCommand, tmp_path: Path) -> None:
    out = tmp_path / "sweep"
    done = sectorlight("tradeoff", SOURCE, "-o", str(out), "--variants", "draft", *SMALL)
    assert done.returncode == 0, done.stderr
    assert done.stdout == (out / "tradeoff.md").read_text()
    assert "| draft * |" in done.stdout
    (row,) = json.loads((out / "tradeoff.json").read_text())
    assert row["variant"] == "draft"
    with Image.open(out / "tradeoff.png") as picture:
        assert picture.format == "PNG"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--variants", "speed"), ("speed", "or a knob")),
        (("--states", "foggy_noon"), ("foggy_noon", "low_sun")),
        (("--sectors", "1:0,0:1"), ("X0 < X1",)),
        (("--sectors", "900:901,0:1", "--variants", "draft"), ("900:901,0:1", "holds no sector")),
        (("--device", "abacus", "--variants", "draft", *SMALL), ("abacus", "there are")),
    ],
)
def test_what_cannot_be_swept_is_refused(sectorlight: RunCommand, tmp_path: Path, options: tuple[str, ...], words: tuple[str, ...]) -> None:
    done = sectorlight("tradeoff", SOURCE, "-o", str(tmp_path / "out"), *options)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
    for word in words:
        assert word in done.stderr


def test_a_file_in_the_folders_place_is_refused(sectorlight: RunCommand, tmp_path: Path) -> None:
    (tmp_path / "out").write_text("")
    done = sectorlight("tradeoff", SOURCE, "-o", str(tmp_path / "out"))
    assert done.returncode == 2
    assert "expected a folder" in done.stderr
