"""The command line's exit status and its one line on stderr."""

import errno
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest

from bake_jobs.config import PRESETS
from gi_core.errors import InputError
from server.cli import parse_sectors
from server.settings import Settings, is_loopback, read_token
from server.version import program_version

RunCommand = Callable[..., Any]
SOURCE = "procedural:midtown?blocks=1x1&seed=1"


def expect_refusal(done: Any, *words: str) -> None:
    assert done.returncode == 2, done.stderr
    line = done.stderr.strip()
    assert "\n" not in line
    assert line.startswith("sectorlight: ")
    for word in words:
        assert word in line


def test_every_command_has_help(sectorlight: RunCommand) -> None:
    for command in ([], ["bake"], ["info"], ["serve"], ["compare"], ["tradeoff"], ["strip"], ["bench"], ["loadtest"]):
        done = sectorlight(*command, "--help")
        assert done.returncode == 0
        assert "Usage" in done.stdout
        # What stands in brackets is formatting to the library that prints help, and vanishes.
        assert not re.search(r" \.\s", done.stdout)
    assert sectorlight().stdout == sectorlight("--help").stdout


def test_help_needs_neither_baker_nor_server() -> None:
    check = (
        "import sys; from typer.testing import CliRunner; from server.cli import app;"
        "assert CliRunner().invoke(app, ['--help']).exit_code == 0;"
        "heavy = {'fastapi', 'pyopencl', 'embreex', 'trimesh', 'scipy', 'httpx', 'websockets'} & set(sys.modules); assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", check], check=True, timeout=60)


def test_version(sectorlight: RunCommand) -> None:
    done = sectorlight("--version")
    assert (done.returncode, done.stdout) == (0, f"sectorlight {program_version()}\n")


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["serve", "somewhere", "--prot", "1"], "--prot"),
        (["serve", "somewhere", "--port", "70000"], "65535"),
        (["serve", "somewhere", "--sky-lux", "5"], "--sky FILE"),
        (["bake"], "source"),
        (["bake", SOURCE], "--output"),
        (["bench", "--json"], "--json"),
        (["boke"], "boke"),
    ],
)
def test_arguments_that_cannot_be_read_are_one_clear_line(sectorlight: RunCommand, arguments: list[str], word: str) -> None:
    expect_refusal(sectorlight(*arguments), word)


def test_no_dataset_is_one_clear_line(sectorlight: RunCommand, tmp_path: Path) -> None:
    for command in (["info", str(tmp_path)], ["serve", str(tmp_path / "none"), "--port", "0"]):
        expect_refusal(sectorlight(*command), str(tmp_path), "expected")


def test_another_format_version_says_which_and_what_to_do(sectorlight: RunCommand, city: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    shutil.copytree(city, other)
    world = json.loads((other / "world.json").read_text())
    (other / "world.json").write_text(json.dumps(world | {"version": 99}))
    for command in (["info", str(other)], ["serve", str(other), "--port", "0"]):
        expect_refusal(sectorlight(*command), "99", "bake it again")


def test_a_broken_world_json_is_one_clear_line(sectorlight: RunCommand, tmp_path: Path) -> None:
    for text in ("", "{", "[]", '{"format": "sectorlight-dataset", "version": 1}'):
        (tmp_path / "world.json").write_text(text)
        expect_refusal(sectorlight("info", str(tmp_path)), "world.json")


def test_a_server_beyond_loopback_needs_a_token(sectorlight: RunCommand, city: Path, tmp_path: Path) -> None:
    expect_refusal(sectorlight("serve", str(city), "--host", "0.0.0.0", "--port", "0"), "0.0.0.0", "--token-file")
    weak = tmp_path / "token"
    weak.write_text("short\n")
    expect_refusal(sectorlight("serve", str(city), "--host", "0.0.0.0", "--port", "0", "--token-file", str(weak)), str(weak), "16")


def test_an_unknown_device_lists_those_that_exist(sectorlight: RunCommand, city: Path) -> None:
    expect_refusal(sectorlight("serve", str(city), "--port", "0", "--device", "abacus"), "abacus", "there are")


def test_a_taken_port_is_one_clear_line(sectorlight: RunCommand, city: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        expect_refusal(sectorlight("serve", str(city), "--port", port), port)


def test_info_shows_the_dataset_and_a_sector(sectorlight: RunCommand, city: Path) -> None:
    done = sectorlight("info", str(city))
    assert done.returncode == 0, done.stderr
    for word in ("draft", "probes", "surfels", "New_York"):
        assert word in done.stdout
    name = sorted(path.stem for path in (city / "sectors").iterdir())[0]
    one = sectorlight("info", str(city), name.replace("_", ","))
    assert one.returncode == 0, one.stderr
    assert "factors" in one.stdout
    for nowhere in ("900,900", "-900,900"):
        expect_refusal(sectorlight("info", str(city), nowhere), nowhere)
    expect_refusal(sectorlight("info", str(city), "north"), "expected X,Z")


def test_an_unknown_preset_is_refused_before_anything_is_read(sectorlight: RunCommand, tmp_path: Path) -> None:
    done = sectorlight("bake", SOURCE, "-o", str(tmp_path / "out"), "--quality", "best")
    expect_refusal(done, "best", *PRESETS)
    assert not (tmp_path / "out").exists()


def test_an_impossible_target_error_is_refused(sectorlight: RunCommand, tmp_path: Path) -> None:
    for target in ("0", "7", "nan"):
        done = sectorlight("bake", SOURCE, "-o", str(tmp_path / "out"), "--target-error", target)
        expect_refusal(done, "--target-error", "0.04")
    assert not (tmp_path / "out").exists()


def test_a_cluster_is_not_taken_yet(sectorlight: RunCommand, tmp_path: Path) -> None:
    done = sectorlight("bake", SOURCE, "-o", str(tmp_path / "out"), "--ray", "somewhere:6379")
    assert done.returncode == 2
    assert "--ray" in done.stderr


def test_a_bake_into_a_file_is_refused_and_leaves_it(sectorlight: RunCommand, tmp_path: Path) -> None:
    (tmp_path / "notes").write_text("mine")
    for output in (tmp_path / "notes", tmp_path / "notes" / "below"):
        expect_refusal(sectorlight("bake", SOURCE, "-o", str(output)), f"--output {output}", "folder")
    assert (tmp_path / "notes").read_text() == "mine"


def test_a_full_disk_names_the_output(sectorlight: RunCommand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fill(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("bake_jobs.runner.bake", fill)
    done = sectorlight("bake", SOURCE, "-o", str(tmp_path / "out"))
    assert (done.returncode, done.stderr) == (1, f"sectorlight: {tmp_path / 'out'}: No space left on device\n")


def test_an_interrupted_bake_says_what_it_kept_and_resumes(tmp_path: Path) -> None:
    output = tmp_path / "city"
    arguments = ["bake", "procedural:midtown?blocks=2x2&seed=1", "-o", str(output), "--quality", "draft", "--jobs", "2"]
    command = [sys.executable, "-c", "from server.cli import main; main()", *arguments]
    # A session of its own, so that the signal reaches all of its processes, as Ctrl-C in a terminal does.
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True) as process:
        deadline = time.monotonic() + 60
        while not list(output.glob("sectors/*.gisec")) and time.monotonic() < deadline:
            time.sleep(0.01)
        os.killpg(process.pid, signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in errors
    finished = {path: path.read_bytes() for path in output.glob("sectors/*.gisec")}
    assert f"{output} holds {len(finished)} finished sectors" in " ".join(errors.split())
    assert not (output / "world.json").exists()

    again = subprocess.run(command, check=False, capture_output=True, text=True, timeout=120)
    assert again.returncode == 0, again.stderr
    assert f"{len(finished)} of " in again.stderr
    assert len(list(output.glob("sectors/*.gisec"))) == len(json.loads((output / "world.json").read_text())["sectors"]) > len(finished)
    assert all(path.read_bytes() == content for path, content in finished.items())


def test_ctrl_c_stops_a_server_cleanly(city: Path) -> None:
    command = [sys.executable, "-c", "from server.cli import main; main()", "serve", str(city), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        address = process.stdout.readline().split()[-1]
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            try:
                assert httpx.get(f"{address}healthz").status_code == 200
                break
            except httpx.TransportError:
                time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=20)
    assert process.returncode == 0, errors
    assert "Traceback" not in errors


@pytest.mark.parametrize(("text", "expected"), [("0:4,-2:3", ((0, 4), (-2, 3))), (" -9:-8 , 0:1 ", ((-9, -8), (0, 1)))])
def test_sector_ranges(text: str, expected: object) -> None:
    assert parse_sectors(text) == expected


@pytest.mark.parametrize("text", ["", "1:2", "2:1,0:1", "0:1,0:0", "a:b,c:d", "0:1,0:1,0:1", "0:99999999,0:1"])
def test_bad_sector_ranges(text: str) -> None:
    with pytest.raises(InputError, match="--sectors"):
        parse_sectors(text)


def test_loopback_is_recognised() -> None:
    assert all(is_loopback(host) for host in ("127.0.0.1", "127.8.9.1", "::1", "localhost", "[::1]"))
    assert not any(is_loopback(host) for host in ("0.0.0.0", "::", "192.168.0.1", "example.org", "", "128.0.0.1"))


def test_a_token_is_one_long_word(tmp_path: Path) -> None:
    file = tmp_path / "token"
    file.write_text("0123456789abcdef\n")
    assert read_token(file) == "0123456789abcdef"
    assert Settings(host="0.0.0.0", token_file=file).checked().host == "0.0.0.0"
    for text in (b"", b"0123456789 abcdef", "0123456789abcdéf".encode(), b"\xff" * 20):
        file.write_bytes(text)
        with pytest.raises(InputError, match="token"):
            read_token(file)
    with pytest.raises(InputError, match="token"):
        read_token(tmp_path / "none")
