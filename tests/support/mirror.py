"""pytest plugin: kernels launched on the CPU are launched again on a GPU with the same inputs, and the ends compared.

    pytest -p support.mirror -n 8 tests

lists each argument of which more than MOST of the numbers written differ. Some do by design: bits of openings and ways
behind the first that is clear, lists in any order, depths above a bound, searches that rounding leads elsewhere.
"""

import threading
from collections import Counter
from collections.abc import Iterator
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
import pytest
import warp as wp
from warp._src.codegen import Struct, StructInstance

from lgrasp.math.lanes import lanes_of
from lgrasp.object import arrays
from lgrasp.runtime.device import start
from lgrasp.runtime.kernels import import_all

MOST = 0.02
TRIES, TRIES_OF_A_TEST = 6, 2
MOST_BYTES = 1 << 30
NOT_MIRRORED = {"grid", "dots"}  # arguments: handles of hash grids; of pictures, which only a CPU draws

_launch = wp.launch
_lock = threading.RLock()


class Mirror:
    """Launches on both devices, and how much of each argument differs."""

    def __init__(self, device: str, package: str = "lgrasp.") -> None:
        self.device, self.package, self.test = device, package, ""
        self.found: dict[str, list[int]] = {}  # of kernel and argument: numbers that differ, that were written
        self.failed: dict[str, str] = {}
        self._tries: Counter[Any] = Counter()
        self._owners: WeakValueDictionary[int, Any] = WeakValueDictionary()  # meshes and trees by handle
        self._twins: dict[int, tuple[Any, Any]] = {}  # with their owners: no other one has the handle then
        self._objects: WeakValueDictionary[int, StructInstance] = WeakValueDictionary()  # by where their points are

    def note_handle(self, owner: Any) -> None:
        self._owners[int(owner.id)] = owner

    def note_object(self, struct: StructInstance) -> None:
        self._objects[struct.contact_points.ptr] = struct

    def launch(self, kernel: Any, dim: Any, inputs: Any = (), outputs: Any = (), *args: Any, **more: Any) -> Any:
        """In place of ``wp.launch``."""
        name, given = f"{kernel.func.__module__}:{kernel.key}", [*inputs, *outputs]
        if args or not self._wanted(name, kernel, dim, given, more):
            return _launch(kernel, dim, inputs, outputs, *args, **more)
        labels = [argument.label for argument in kernel.adj.args]
        with _lock:
            twin = _Twin(self)
            try:
                own = [twin.of(value, label) for value, label in zip(given, labels, strict=True)]
            except LookupError as error:
                self.failed[name] = str(error)
                own = None
            made = _launch(kernel, dim, inputs, outputs, **more)
            if own is None:
                return made
            sizes = (dim,) if isinstance(dim, int) else tuple(dim)
            options = {key: value for key, value in more.items() if key not in ("device", "stream")}
            _launch(kernel, (*sizes[:-1], twin.lanes or sizes[-1]), own, [], device=self.device, **options)
            for label, cpu, before, other in twin.alone():
                self.compare(f"{name} {label}", before, cpu.numpy(), other.numpy())
            return made

    def _wanted(self, name: str, kernel: Any, dim: Any, given: list[Any], more: dict[str, Any]) -> bool:
        if not name.startswith(self.package) or more.get("adjoint") or more.get("record_cmd"):
            return False
        if not wp.get_device(more.get("device")).is_cpu or 0 in np.atleast_1d(dim):
            return False
        if NOT_MIRRORED & {argument.label for argument in kernel.adj.args} or _bytes(given) > MOST_BYTES:
            return False
        with _lock:
            self._tries.update((name, (name, self.test)))
            return self._tries[name] <= TRIES and self._tries[name, self.test] <= TRIES_OF_A_TEST

    def compare(self, name: str, before: np.ndarray, cpu: np.ndarray, gpu: np.ndarray) -> None:
        """Add up how much two ends of one argument differ."""
        sums = self.found.setdefault(name, [0, 0])
        for old, a, b in zip(_leaves(before), _leaves(cpu), _leaves(gpu), strict=True):
            near = {"rtol": 1e-3, "atol": 1e-5} if a.dtype.kind == "f" else {"rtol": 0, "atol": 0}
            sums[0] += int((~np.isclose(a, b, equal_nan=True, **near)).sum())
            sums[1] += int(((a != old) | (b != old)).sum())

    def handle(self, number: int) -> int:
        """That of a mesh or tree on the other device; 0, of none, stays."""
        if not number:
            return 0
        if number not in self._twins:
            if number not in self._owners:
                raise LookupError(f"no mesh or tree {number}")
            own = self._owners[number]
            parts = (own.points, own.indices) if isinstance(own, wp.Mesh) else (own.lowers, own.uppers)
            more = {"support_winding_number": True} if isinstance(own, wp.Mesh) else {}
            self._twins[number] = own, type(own)(*(wp.clone(part, device=self.device) for part in parts), **more)
        own, twin = self._twins[number]
        if isinstance(own, wp.Mesh):  # its points may have moved
            wp.copy(twin.points, own.points)
            twin.refit()
        return int(twin.id)

    def objects(self, rows: np.ndarray) -> list[StructInstance]:
        """Structs of arrays, on the other device."""
        return [_Twin(self).of(self._objects[int(row["contact_points"]["data"])], "") for row in rows]

    def lines(self) -> Iterator[str]:
        """What differs most first, and what could not be compared."""
        shares = {name: wrong / max(written, wrong, 1) for name, (wrong, written) in self.found.items()}
        for name in sorted(shares, key=lambda name: -shares[name]):
            if shares[name] > MOST:
                yield f"{shares[name]:7.1%} of {self.found[name][1]:9,} {name}"
        yield from (f"not compared: {name}, {why}" for name, why in self.failed.items())
        yield f"{len(shares):,} arguments of {len({name.split()[0] for name in shares})} kernels compared"


class _Twin:
    """Arguments of one launch on the other device; an array that is passed twice is one there, too."""

    def __init__(self, mirror: Mirror) -> None:
        self.mirror, self.lanes = mirror, 0
        self.pairs: list[tuple[str, wp.array, np.ndarray, wp.array]] = []
        self._made: dict[Any, wp.array] = {}
        self._kept: list[StructInstance] = []  # an array of structs does not keep their arrays

    def of(self, value: Any, label: str) -> Any:
        if isinstance(value, StructInstance):
            twin = value._cls()
            for name in value._cls.vars:
                setattr(twin, name, self.of(getattr(value, name), f"{label}.{name}"))
            return twin
        if isinstance(value, wp.array):
            key = value.ptr, value.shape, value.strides, str(value.dtype)
            if key not in self._made:
                self._made[key] = self._array(value, label)
            return self._made[key]
        name = label.split(".")[-1]
        if name == "lanes":
            self.lanes = lanes_of(self.mirror.device)
            return self.lanes
        return self.mirror.handle(int(value)) if name == "mesh" else value

    def alone(self) -> Iterator[tuple[str, wp.array, np.ndarray, wp.array]]:
        """Arrays, before and after; not those of which a part was passed as an array of its own."""
        starts = {array.ptr for _, array, _, _ in self.pairs}
        for pair in self.pairs:
            inside = range(pair[1].ptr + 1, pair[1].ptr + pair[1].capacity)
            if not any(start in inside for start in starts):
                yield pair

    def _array(self, value: wp.array, label: str) -> wp.array:
        device, numbers = self.mirror.device, value.numpy().copy()
        if not value.size:
            return wp.empty(value.shape, dtype=value.dtype, device=device)
        if value.dtype is wp.uint64 and label.split(".")[-1] in ("mesh", "tree"):
            handles = [self.mirror.handle(int(number)) for number in numbers]
            return wp.array(np.array(handles, np.uint64), dtype=wp.uint64, device=device)
        if isinstance(value.dtype, Struct) and any(isinstance(v.type, wp.array) for v in value.dtype.vars.values()):
            structs = self.mirror.objects(numbers)
            self._kept += structs
            return wp.array(structs, dtype=value.dtype, device=device)
        twin = wp.array(np.ascontiguousarray(numbers), dtype=value.dtype, shape=value.shape, device=device)
        self.pairs.append((label, value, numbers, twin))
        return twin


def _bytes(values: list[Any]) -> int:
    sizes = (_bytes([getattr(x, n) for n in x._cls.vars]) if isinstance(x, StructInstance) else x for x in values)
    return sum(x if isinstance(x, int) else x.capacity for x in sizes if isinstance(x, (int, wp.array)))


def _leaves(values: np.ndarray) -> Iterator[np.ndarray]:
    for name in values.dtype.names or ():
        yield from _leaves(values[name])
    if values.dtype.names is None:
        yield values


def _noting(kind: type, mirror: Mirror) -> None:
    begin = kind.__init__

    def init(self: Any, *args: Any, **more: Any) -> None:
        begin(self, *args, **more)
        mirror.note_handle(self)

    kind.__init__ = init  # ty: ignore[invalid-assignment]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--mirror", default="cuda:0", help="device on which launches are repeated")


def pytest_configure(config: pytest.Config) -> None:
    start()
    import_all()
    mirror = config.stash[_MIRROR] = Mirror(config.getoption("mirror"))
    for kind in (wp.Mesh, wp.Bvh):
        _noting(kind, mirror)
    upload = arrays.upload_struct

    def noted(kind: Any, device: str, values: Any) -> Any:
        struct = upload(kind, device, values)
        if kind is arrays.Object and wp.get_device(device).is_cpu:
            mirror.note_object(struct)
        return struct

    arrays.upload_struct = noted
    wp.launch = mirror.launch


_MIRROR = pytest.StashKey[Mirror]()


def pytest_runtest_setup(item: pytest.Item) -> None:
    item.config.stash[_MIRROR].test = item.nodeid


def pytest_sessionfinish(session: pytest.Session) -> None:
    if hasattr(session.config, "workeroutput"):
        mirror = session.config.stash[_MIRROR]
        session.config.workeroutput["mirror"] = (mirror.found, mirror.failed)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    mirror = node.config.stash[_MIRROR]
    found, failed = getattr(node, "workeroutput", {}).get("mirror", ({}, {}))
    for name, sums in found.items():
        mirror.found[name] = [a + b for a, b in zip(mirror.found.get(name, (0, 0)), sums, strict=True)]
    mirror.failed |= failed


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    if not hasattr(config, "workeroutput"):
        terminalreporter.section("kernels on both devices")
        for line in config.stash[_MIRROR].lines():
            terminalreporter.write_line(line)
