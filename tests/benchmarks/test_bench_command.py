"""``sectorlight bench`` runs, and says what the contract wants. How fast things are is for a quiet machine to tell."""

import json
import math
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from gi_core.bench import side_by_side
from server.bench import BenchError, Connection

RELIGHT = [f"relight_two_sectors{which}" for which in ("", "_resampled", "_settled", "_flicker")]
PACK = [f"volume_pack_{which}" for which in ("npy", "f16", "rgb9e5", "ktx2_f16", "ktx2_rgb9e5", "stream")]
NAMES = [
    *RELIGHT,
    "relight_host",
    "volume_fill",
    "volume_step",
    "sector_decode",
    "sector_decode_sh2",
    "lamp_moved",
    "bake_sector",
    *PACK,
    "http_volume",
]
UNITS = [*["ms"] * 10, "s", *["us"] * 6, "requests/s"]


@pytest.mark.slow
def test_a_quick_run_has_every_row_beside_its_baseline(tmp_path: Path) -> None:
    command = [sys.executable, "-c", "from server.cli import main; main()", "bench", "--quick", "--json", str(tmp_path / "out.json")]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "out.json").read_text())
    assert [row["name"] for row in rows] == NAMES
    assert [row["unit"] for row in rows] == UNITS
    for row in rows:
        assert {"name", "median", "unit", "baseline", "ratio", "sizes", "device"} <= set(row)
        assert all(math.isfinite(row[key]) and row[key] > 0 for key in ("median", "baseline", "ratio"))
        better = row["median"] / row["baseline"] if row["unit"].endswith("/s") else row["baseline"] / row["median"]
        assert row["ratio"] == pytest.approx(better)
        assert row["sizes"]
        assert all(isinstance(size, int) and size > 0 for size in row["sizes"].values())
        assert row["device"]
        assert row["name"] in done.stdout
    # One sector of a city: a bake casts its primary rays, and more.
    bake = rows[NAMES.index("bake_sector")]
    assert bake["baseline"] < bake["median"]
    # Texels of six faces: twelve, eight and four bytes a colour, files a little more for their heads, a stream's halves compressed.
    colours = 6 * 16 * 32 * 32
    exact, half, shared, half_file, shared_file, frame = (rows[NAMES.index(name)]["sizes"]["bytes"] for name in PACK)
    assert (half, shared) == (8 * colours, 4 * colours)
    assert 12 * colours < exact < 12 * colours + 1000
    assert half < half_file < half + 2000
    assert shared < shared_file < shared + 2000
    assert 1000 < frame < 6 * colours


@pytest.mark.parametrize("options", [("--json", "nowhere/out.json"), ("--device", "abacus")])
def test_bad_input_is_one_clear_line(options: tuple[str, str]) -> None:
    command = [sys.executable, "-c", "from server.cli import main; main()", "bench", "--quick", *options]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert "\n" not in done.stderr.strip()
    assert options[1] in done.stderr


def test_the_two_sides_take_turns_and_one_call_of_each_is_not_counted() -> None:
    order: list[str] = []
    side_by_side(lambda: order.append("m"), lambda: order.append("b"), rounds=3, calls=2)
    assert "".join(order) == "mb" + 3 * "mmb"


def test_the_slower_side_reads_slower() -> None:
    pause = threading.Event()
    fast, slow = side_by_side(lambda: pause.wait(0.001), lambda: pause.wait(0.02), rounds=3)
    assert 0.001 <= fast < slow
    assert slow >= 0.02


@contextmanager
def peer(*pieces: bytes) -> Iterator[int]:
    """A server that reads one request, sends some bytes piece by piece, and closes."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            client, _ = listener.accept()
            with client:
                client.recv(4096)
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                for piece in pieces:
                    client.sendall(piece)

        thread = threading.Thread(target=serve)
        thread.start()
        yield listener.getsockname()[1]
        thread.join(10)


def ask(port: int, largest_reply: int = 100) -> tuple[int, bytes]:
    connection = Connection(port, "/", largest_reply)
    try:
        connection.send()
        reply = connection.receive()
        return reply.status, bytes(reply.content)
    finally:
        connection.close()


def test_a_reply_in_pieces_is_read_whole() -> None:
    with peer(b"HTTP/1.1 200 OK\r\nContent-Le", b"ngth: 5\r\n\r", b"\nhel", b"lo") as port:
        assert ask(port) == (200, b"hello")


def test_a_status_is_passed_on() -> None:
    with peer(b"HTTP/1.1 404 Not Found\r\ncontent-length: 0\r\n\r\n") as port:
        assert ask(port) == (404, b"")


@pytest.mark.parametrize(
    "reply",
    [
        b"",
        b"HTTP/1.1 200 OK\r\nContent-Length: 5\r\n\r\nhel",
        b"HTTP/1.1 200 OK\r\n\r\nhello",
        b"HTTP/1.1 200 OK\r\nContent-Length: 99999999\r\n\r\n",
    ],
    ids=["closed", "cut off", "no length", "too long"],
)
def test_a_reply_that_is_none_is_an_error_not_a_hang(reply: bytes) -> None:
    with peer(reply) as port, pytest.raises(BenchError, match="http_volume"):
        ask(port)
