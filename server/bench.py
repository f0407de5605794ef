"""Volumes per second over HTTP, beside a bare route that sends the same bytes, in the same run.

Each server is a process of its own, started alike. The two take turns under one load, so that whatever else the machine does meets both.
"""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import urlencode, urlsplit

import numpy as np

from gi_core.arrays import Float64
from gi_core.bench import Measurement
from gi_core.dataset import Dataset
from gi_core.errors import SectorlightError

STARTUP_S = 120.0  # a first start builds its kernels
REPLY_S = 60.0
# Enough that the server always has a request waiting while the client copies a reply.
CONNECTIONS = 4
MAX_HEADER_BYTES = 1 << 16
REAL = ("from server.cli import main; main()", "serve", "--port", "0")
BARE = ("from server.bench_bare import main; main()",)


class BenchError(SectorlightError, RuntimeError):
    """A server under test did not start, or did not answer as it must."""

    code = "bench"


@dataclass(frozen=True)
class Reply:
    """What a server answered; ``content`` lies in the connection's buffer."""

    status: int
    content: memoryview


class Connection:
    """A kept-alive connection that asks one thing again and again. Does little but copy, so that what is timed is the server."""

    def __init__(self, port: int, target: str, largest_reply: int) -> None:
        self._request = f"GET {target} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode()
        self._buffer = memoryview(bytearray(largest_reply + MAX_HEADER_BYTES))
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=REPLY_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def close(self) -> None:
        self._socket.close()

    def send(self) -> None:
        """Ask."""
        self._socket.sendall(self._request)

    def receive(self) -> Reply:
        """The whole answer; it is valid until the next one. Raises BenchError when there is none."""
        filled, head, wanted = 0, -1, 0
        while head < 0 or filled < wanted:
            count = self._socket.recv_into(self._buffer[filled:])
            if count == 0:
                raise BenchError(f"http_volume: the server closed the connection after {filled} bytes of a reply")
            filled += count
            if head < 0:
                head = bytes(self._buffer[: min(filled, MAX_HEADER_BYTES)]).find(b"\r\n\r\n")
                if head >= 0:
                    wanted = head + 4 + self._content_length(head)
        return Reply(int(bytes(self._buffer[9:12])), self._buffer[head + 4 : wanted])

    def _content_length(self, head: int) -> int:
        for line in bytes(self._buffer[:head]).split(b"\r\n"):
            name, _, value = line.partition(b":")
            if name.lower() == b"content-length":
                length = int(value)
                if length > len(self._buffer) - head - 4:
                    break
                return length
        raise BenchError(f"http_volume: expected a reply of at most {len(self._buffer)} bytes with a Content-Length")


def bench_http(dataset_path: Path, device: str | None = None, rounds: int = 60, requests_per_round: int = 100) -> Measurement:
    """Requests per second for one cached raw volume, the median over rounds. Higher is better; ``ratio`` = median / baseline.

    Raises what Dataset.open raises, and BenchError.
    """
    dataset = Dataset.open(dataset_path)
    target = volume_target(dataset)
    environment = {} if device is None else {"SECTORLIGHT_DEVICE": device}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="sectorlight-bench-")))
        real_port = stack.enter_context(server_process((*REAL, str(dataset_path)), environment))
        content = fetch(real_port, target)
        (folder / "volume").write_bytes(content)
        bare_port = stack.enter_context(server_process((*BARE, str(folder / "volume")), {}))
        if fetch(bare_port, target) != content or fetch(real_port, target) != content:
            raise BenchError("http_volume: the two servers' replies differ, so their speeds cannot be compared")
        stack.enter_context(own_core())
        ports = (real_port, bare_port)
        connections = [[Connection(port, target, len(content)) for _ in range(CONNECTIONS)] for port in ports]
        for connection in (c for group in connections for c in group):
            stack.callback(connection.close)
        rates = np.zeros((rounds, 2))
        for number in range(-1, rounds):  # round -1 warms up and is overwritten by the last
            for which in (0, 1) if number % 2 else (1, 0):
                rates[number, which] = requests_per_second(connections[which], requests_per_round)
    median, baseline = (float(v) for v in np.median(rates, axis=0))
    sizes = {"bytes": len(content), "connections": CONNECTIONS, "requests": rounds * requests_per_round}
    return Measurement(
        "http_volume", median, "requests/s", baseline, median / baseline, sizes, "CPU", "bare Starlette route, same bytes; higher is better"
    )


def volume_place(dataset: Dataset) -> Float64:
    """(3,) [m]: in the middle of a dataset's first sector with probes, above its ground."""
    sectors = dataset.world.sectors
    index = next((i for i in sorted(sectors) if sectors[i].probes), None)
    if index is None:
        raise BenchError(f"{dataset.path}: no sector has a probe, so there is no light to serve")
    return np.array([index.origin[0] + 32.0, dataset.world.bounds[0, 1] + 10.0, index.origin[2] + 32.0])


def volume_target(dataset: Dataset) -> str:
    """Path and query of a raw volume at ``volume_place``."""
    place = dict(zip("xyz", volume_place(dataset).tolist(), strict=True))
    return f"/v1/volume?{urlencode({'time': '12:00', 'weather': 'clear', **place, 'format': 'raw', 'encoding': 'f16'})}"


@contextmanager
def server_process(arguments: tuple[str, ...], environment: dict[str, str]) -> Iterator[int]:
    """A server in a Python process of its own, for as long as the block lasts; gives its port. BenchError when it does not start."""
    command = [sys.executable, "-c", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, **environment}) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            if not line:
                raise BenchError("http_volume: a server ended before it listened; its own words stand above")
            port = urlsplit(line.split()[-1]).port
            assert port is not None
            wait_until_listening(process, port)
            if len(cores()) > 1:
                os.sched_setaffinity(process.pid, {cores()[-1]})
            yield port
        finally:
            process.terminate()


def cores() -> list[int]:
    """Cores that this process may use, in order; none where the system does not say."""
    return sorted(os.sched_getaffinity(0)) if sys.platform == "linux" else []


@contextmanager
def own_core() -> Iterator[None]:
    """This process on the first core while the servers have the last: left to the scheduler, the ratio swings by a third between runs."""
    before = cores()
    if len(before) > 1:
        os.sched_setaffinity(0, before[:1])
    try:
        yield
    finally:
        if len(before) > 1:
            os.sched_setaffinity(0, before)


def wait_until_listening(process: "subprocess.Popen[str]", port: int) -> None:
    """Return once the port takes connections. Raises BenchError when it does not in time."""
    deadline = time.monotonic() + STARTUP_S
    while process.poll() is None and time.monotonic() < deadline:
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1.0).close()
            return
        except OSError:
            time.sleep(0.02)
    raise BenchError(f"http_volume: a server did not start within {STARTUP_S:g} s")


def fetch(port: int, target: str) -> bytes:
    """One reply's body. Raises BenchError unless it is 200."""
    connection = Connection(port, target, 1 << 24)
    try:
        connection.send()
        reply = connection.receive()
        if reply.status != 200:
            raise BenchError(f"http_volume: {target} answered {reply.status}: {bytes(reply.content[:300])!r}")
        return bytes(reply.content)
    finally:
        connection.close()


def requests_per_second(connections: list[Connection], count: int) -> float:
    """Rate of ``count`` replies with every connection always waiting for one."""
    started = time.perf_counter()
    for connection in connections:
        connection.send()
    for number in range(count):
        connection = connections[number % len(connections)]
        if connection.receive().status != 200:
            raise BenchError("http_volume: a reply failed under load")
        if number + len(connections) < count:
            connection.send()
    return count / (time.perf_counter() - started)
