"""Lets PoCL compile on processors that its LLVM is too old to know.

PyPI's PoCL 3.0 carries LLVM 14, to which every AMD processor since Zen 5 is "generic". PoCL hands that name to clang, clang refuses
it for x86-64, and no kernel builds: "unknown target CPU 'generic'" (pocl issue 1049; no option or variable changes the name).
PoCL keeps the name in memory of its own, which its device points to; this module finds it there and writes the name of an older
processor that the machine is compatible with. It does so only after a build has failed for that very reason.
"""

import platform
import struct
import sys
from pathlib import Path

_UNKNOWN = b"generic\0"
# The pointer sits at byte 640 of PoCL 3.0's device record, which is 5120 bytes long.
_SEARCHED_BYTES = 2048
_MEMORY = Path("/proc/self/mem")
# LLVM's name for a processor, and the flags without which its code would not run. Names fit the 8 bytes of what they replace.
_TARGETS: tuple[tuple[bytes, set[str]], ...] = (
    (b"znver3", {"avx2", "fma", "bmi2", "sha_ni", "sse4a", "vaes", "vpclmulqdq", "clwb", "clzero", "rdpid", "fsgsbase", "adx"}),
    (b"haswell", {"avx2", "fma", "bmi1", "bmi2", "f16c", "movbe", "fsgsbase"}),
    (b"x86-64", set()),
)


def is_unknown_cpu(build_log: str) -> bool:
    """Whether a failed build's log shows that PoCL's LLVM does not know this processor."""
    return "unknown target CPU 'generic'" in build_log


def compatible_cpu(flags: set[str]) -> bytes:
    """The best processor known to LLVM 14 whose code runs with these flags, as /proc/cpuinfo names them."""
    return next(name for name, needed in _TARGETS if needed <= flags)


def name_compatible_cpu(device_address: int) -> str | None:
    """Tell a PoCL device, given its ``cl_device_id``, to compile for a compatible processor.

    -> that processor's name, or None where this is not possible (another system, another layout); nothing is changed then.
    """
    if sys.platform != "linux" or platform.machine() != "x86_64":
        return None
    with _MEMORY.open("r+b", buffering=0) as memory:

        def peek(address: int, size: int) -> bytes:
            try:
                memory.seek(address)
                return memory.read(size)
            except (OSError, ValueError, OverflowError):
                return b""  # not an address of this process

        record = peek(device_address, _SEARCHED_BYTES)
        words = struct.unpack(f"<{len(record) // 8}Q", record[: len(record) // 8 * 8])
        places = {word for word in words if word % 2 == 0 and peek(word, len(_UNKNOWN)) == _UNKNOWN}
        if len(places) != 1:
            return None
        name = compatible_cpu(_processor_flags())
        memory.seek(places.pop())
        memory.write(name.ljust(len(_UNKNOWN), b"\0"))
        return name.decode()


def _processor_flags() -> set[str]:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("flags"):
            return set(line.partition(":")[2].split())
    return set()
