"""OpenCL device: which one, its queue, and kernels built for what a scene needs."""

import os
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import numpy as np
import pyopencl as cl

from gi_core import layout, pocl_cpu
from gi_core.background import give_way
from gi_core.errors import DeviceError, KernelBuildError
from kernels_cl import include_directory, source

ENVIRONMENT = "SECTORLIGHT_DEVICE"
GROUP = 32  # work-items per work-group
LANES = 2  # in-order queues for work that goes on side by side


def available_devices() -> list[cl.Device]:
    """Every OpenCL device of every platform, in the order that the loader gives."""
    _pin_workers()
    try:
        with _polite_threads():
            return [device for platform in cl.get_platforms() for device in platform.get_devices()]
    except cl.LogicError:
        return []


def _pin_workers() -> None:
    """Ask PoCL to keep each of its threads on a processor of its own, unless POCL_AFFINITY says otherwise.

    Linux wakes a thread where its waker runs, so left alone they often share one processor for as long as a tick lasts. Number i goes to
    processor i: there must be one.
    """
    if hasattr(os, "sched_getaffinity") and os.sched_getaffinity(0) == set(range(os.cpu_count() or 0)):
        os.environ.setdefault("POCL_AFFINITY", "1")


@contextmanager
def _polite_threads() -> Iterator[None]:
    """Threads that are made meanwhile, PoCL's, wait for a processor that is free rather than stop whoever runs on theirs (Linux's
    SCHED_BATCH, which they inherit).

    Else one that wakes to do what a tick asks for stops the tick itself, which had more to ask of the other processor.
    """
    if not hasattr(os, "SCHED_BATCH") or os.sched_getscheduler(0) != os.SCHED_OTHER:
        yield
        return
    own = os.sched_param(0)
    try:
        os.sched_setscheduler(0, os.SCHED_BATCH, own)
    except OSError:  # not allowed here, as in some sandboxes
        yield
        return
    try:
        yield
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, own)


def describe(device: cl.Device) -> str:
    """One line that names a device: platform, device, version."""
    return f"{device.platform.name} / {device.name.strip()} ({device.platform.version.split(',')[0].strip()})"


def choose_device(name: str | None) -> cl.Device:
    """The device whose description contains ``name`` (any case); without one, PoCL's CPU, or else the first.

    Raises DeviceError, listing what there is, when nothing matches.
    """
    devices = available_devices()
    if not devices:
        raise DeviceError("no OpenCL device found; `pip install 'pyopencl[pocl]'` brings one that needs no driver")
    if name:
        for device in devices:
            if name.lower() in describe(device).lower():
                return device
        raise DeviceError(f"no OpenCL device matches {name!r}; there are: {'; '.join(describe(d) for d in devices)}")
    return next((d for d in devices if "portable computing" in d.platform.name.lower()), devices[0])


class SharedKernel:
    """A kernel that everyone launches with arguments of their own. An instance for each would take half a millisecond to make.

    A kernel is always launched with the same local size: PoCL compiles it anew for each, and would choose one for every global size.

    pyopencl is told what the arguments are: left to find out, it raises and catches a C++ exception for each number, 12 us apiece.
    """

    def __init__(self, device: "Device", kernel: cl.Kernel) -> None:
        self._device = device
        self._kernel = kernel
        self._knows_types = False
        self._lock = threading.Lock()

    def launch(
        self,
        size: tuple[int, ...],
        group: tuple[int, ...] | None,
        *arguments: Any,
        queue: cl.CommandQueue | None = None,
        offset: tuple[int, ...] | None = None,
    ) -> None:
        """Enqueue the kernel: global and local size (None: the driver picks one), then buffers, None for those that the kernel does not
        read, NumPy scalars and (1,) records, each of the same type at every launch. ``queue``: the device's own, or another lane;
        ``offset``: the first work-item's global id."""
        with self._lock:
            if not self._knows_types:
                self._kernel.set_scalar_arg_dtypes(
                    [None if given is None or isinstance(given, cl.Buffer) else given.dtype for given in arguments]
                )
                self._knows_types = True
            event = self._kernel(queue or self._device.queue, size, group, *arguments, global_offset=offset)
        if self._device.launched is not None:
            self._device.launched.append((self._kernel.function_name, event))

    def launch_1d(self, items: int, *arguments: Any, queue: cl.CommandQueue | None = None) -> None:
        """Enqueue the kernel for some work-items, rounded up to whole work-groups of GROUP: kernels guard against the excess."""
        self.launch((-(-items // GROUP) * GROUP,), (GROUP,), *arguments, queue=queue)


class Device:
    """A device with an in-order queue, more for work that can go on beside it, and the programs built for it so far."""

    def __init__(self, name: str | None = None, timed: bool = False) -> None:
        """``name`` is part of a device's description; SECTORLIGHT_DEVICE where it is None. Raises DeviceError.

        timed : keep each launch of a shared kernel, by name, with an event that knows when it ran, in ``launched``
        """
        self.device = choose_device(name or os.environ.get(ENVIRONMENT))
        self.name = describe(self.device)
        self.is_processor = bool(self.device.type & cl.device_type.CPU)
        self.context = cl.Context([self.device])
        self._properties = cl.command_queue_properties.PROFILING_ENABLE if timed else 0
        self.lanes = tuple(self._new_queue() for _ in range(LANES))
        self._of_thread = threading.local()
        self.launched: list[tuple[str, cl.Event]] | None = [] if timed else None
        self._programs: dict[tuple[str, tuple[tuple[str, int], ...]], cl.Program] = {}
        self._shared_kernels: dict[tuple[object, ...], SharedKernel] = {}
        self._tables: dict[Callable[[], np.ndarray[Any, Any]], cl.Buffer] = {}
        try:
            self._check_layout()
        except KernelBuildError as error:
            if not pocl_cpu.is_unknown_cpu(str(error)) or pocl_cpu.name_compatible_cpu(self.device.int_ptr) is None:
                raise
            self._check_layout()

    @property
    def queue(self) -> cl.CommandQueue:
        """The queue that the calling thread uses: the device's own, the first of its lanes, unless it works ``beside`` others."""
        return getattr(self._of_thread, "queue", self.lanes[0])

    @contextmanager
    def beside(self) -> Iterator[None]:
        """Meanwhile the calling thread has a queue of its own, so that who waits for the device's does not wait for it. All that it has
        enqueued is done at the end."""
        own = self._of_thread.queue = self._new_queue()
        try:
            yield
        finally:
            del self._of_thread.queue
            own.finish()

    def _new_queue(self) -> cl.CommandQueue:
        return cl.CommandQueue(self.context, properties=self._properties)

    def kernel(self, name: str, **defines: int) -> cl.Kernel:
        """A new instance of kernel ``name`` of ``name.cl``, with arguments of its own; programs are built once for each set of defines.

        Raises KernelBuildError with the compiler's log.
        """
        key = (name, tuple(sorted(defines.items())))
        if key not in self._programs:
            self._programs[key] = self.build(source(f"{name}.cl"), f"{name}.cl", **defines)
        return cl.Kernel(self._programs[key], name)

    def shared_kernel(self, name: str, **defines: int) -> SharedKernel:
        """The kernel ``name`` of ``name.cl`` that all of the process launch, built at the first call; defines in the same order each time.

        Raises KernelBuildError with the compiler's log.
        """
        key = (name, *defines.items())
        found = self._shared_kernels.get(key)
        if found is None:
            found = self._shared_kernels[key] = SharedKernel(self, self.kernel(name, **defines))
        return found

    @property
    def built_kernels(self) -> tuple[tuple[str, dict[str, int]], ...]:
        """Name and defines of each kernel that was built: what no scene has asked for is not among them."""
        return tuple((name, dict(defines)) for name, defines in self._programs)

    def build(self, text: str, name: str, **defines: int) -> cl.Program:
        """Compile OpenCL C with the kernels' include path. Raises KernelBuildError."""
        options = ["-I", str(include_directory()), *(f"-D{key}={value}" for key, value in sorted(defines.items()))]
        try:
            with warnings.catch_warnings():
                # PoCL logs harmless remarks on stderr, which pyopencl turns into warnings.
                warnings.simplefilter("ignore")
                return cl.Program(self.context, text).build(options)
        except cl.RuntimeError as error:
            raise KernelBuildError(f"{name} does not build on {self.name} with {defines}:\n{error}") from error

    def upload(self, values: "np.ndarray[Any, Any]") -> cl.Buffer:
        """A read-only buffer with the array's bytes; never empty, since OpenCL has no empty buffers."""
        give_way()
        data = np.ascontiguousarray(values)
        if data.nbytes == 0:
            data = np.zeros(16, np.uint8)
        return cl.Buffer(self.context, cl.mem_flags.READ_ONLY | cl.mem_flags.COPY_HOST_PTR, hostbuf=data)

    def upload_once(self, table: Callable[[], "np.ndarray[Any, Any]"]) -> cl.Buffer:
        """The buffer of what a function gives, which is the same each time: uploaded at the first call, then kept."""
        found = self._tables.get(table)
        if found is None:
            found = self._tables[table] = self.upload(table())
        return found

    def allocate(self, nbytes: int) -> cl.Buffer:
        """A read-write buffer of zeros."""
        buffer = cl.Buffer(self.context, cl.mem_flags.READ_WRITE, max(nbytes, 16))
        cl.enqueue_fill_buffer(self.queue, buffer, np.uint8(0), 0, max(nbytes, 16))
        return buffer

    def read(self, buffer: cl.Buffer, into: "np.ndarray[Any, Any]") -> None:
        """Copy a buffer into an array, after all that was enqueued before."""
        if into.nbytes:
            cl.enqueue_copy(self.queue, into, buffer)

    def _check_layout(self) -> None:
        """Refuse a device whose compiler lays records out differently from NumPy."""
        writes = "\n".join(f"size[{i}] = sizeof({record.name});" for i, record in enumerate(layout.RECORDS))
        program = self.build(f'#include "layout.h"\n__kernel void sizes(__global uint *size) {{ {writes} }}', "layout check")
        sizes = np.zeros(len(layout.RECORDS), np.uint32)
        buffer = self.allocate(sizes.nbytes)
        program.sizes(self.queue, (1,), None, buffer)
        self.read(buffer, sizes)
        expected = [record.dtype.itemsize for record in layout.RECORDS]
        if sizes.tolist() != expected:
            raise KernelBuildError(f"{self.name} lays out records in {sizes.tolist()} bytes, the host in {expected}")


@lru_cache(maxsize=4)
def shared_device(name: str | None = None) -> Device:
    """One Device per name for the whole process: contexts and built kernels are worth keeping."""
    return Device(name)
