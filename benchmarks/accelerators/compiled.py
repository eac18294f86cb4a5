"""Compiling for an absent GPU, and counting the work of the compiled program.

XLA compiles for a chip that it knows only by a description. The result is the optimised program, with the kernels
that it would launch and the memory that it would take. Nothing runs, so that all of this is an estimate. It needs the
wheels of ``pip install "jax[cuda13]"``, 4.6 GB, in an environment of their own: beside a GPU JAX would use it.
"""

import json
import math
import re
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

LAUNCH = 4e-6
"""Seconds from one kernel to the next, at least: 3 to 5 µs."""
BANDWIDTH = 4.8e12
"""Bytes of memory traffic a second."""
FLOPS = {"f64": 34e12, "f32": 67e12}
"""Operations a second in matrix products, without tensor cores, which XLA may use or not."""

# NVIDIA H200: 132 multiprocessors at 1.98 GHz, 141 GB of memory. The numbers of the rates are XLA's primitive types.
_SCALARS = {4: (64, 1), 8: (64, 1), 10: (128, 2), 11: (128, 1), 12: (64, 1), 16: (128, 2)}
_MATRICES = {12: (1.98, 32), 11: (1.83, 256), 10: (1.83, 512), 16: (1.83, 512)} | dict.fromkeys(
    (2, 6, 19, 20, 23, 24, 25, 28, 29, 33, 35, 36), (1.83, 1024)
)


def _rate(primitive: int, clock: float, units: int, operations: int) -> str:
    value = f"clock_rate_ghz: {clock} units_per_core: {units} ops_per_clock: {operations}"
    return f"rate_infos {{ key: {primitive} value {{ {value} }} }}"


def _chip() -> str:
    """Return the description that XLA compiles for, in the text format of protocol buffers."""
    numbers = {
        "threads_per_block_limit": 1024,
        "threads_per_warp": 32,
        "threads_per_core_limit": 2048,
        "shared_memory_per_block": 48 << 10,
        "shared_memory_per_block_optin": 227 << 10,
        "shared_memory_per_core": 228 << 10,
        "registers_per_core_limit": 1 << 16,
        "registers_per_block_limit": 1 << 16,
        "core_count": 132,
        "fpus_per_core": 128,
        "block_dim_limit_x": (1 << 31) - 1,
        "block_dim_limit_y": (1 << 16) - 1,
        "block_dim_limit_z": (1 << 16) - 1,
        "thread_dim_limit_x": 1024,
        "thread_dim_limit_y": 1024,
        "thread_dim_limit_z": 64,
        "memory_bandwidth": int(BANDWIDTH),
        "l2_cache_size": 50 << 20,
        "device_memory_size": 141 << 30,
        "pcie_bandwidth": 32 << 30,
        "clock_rate_ghz": 1.98,
        "device_address_bits": 64,
    }
    texts = {
        "name": "NVIDIA H200",
        "device_vendor": "NVIDIA Corporation",
        "platform_version": "Compute Capability 9.0a",
        "driver_version": "13.0.0",
        "runtime_version": "12.8.0",
        "compile_time_toolkit_version": "12.8.0",
        "dnn_version": "9.10.0",
    }
    parts = [f"{name}: {value}" for name, value in numbers.items()]
    parts += [f'{name}: "{value}"' for name, value in texts.items()]
    parts += [
        "ecc_enabled: true",
        "cuda_compute_capability { major: 9 feature_extension: ACCELERATED_FEATURES }",
        f"scalar_unit_description {{ {' '.join(_rate(p, 1.98, *rest) for p, rest in _SCALARS.items())} }}",
        f"matrix_unit_description {{ {' '.join(_rate(p, c, 4, n) for p, (c, n) in _MATRICES.items())} }}",
    ]
    return (
        f"gpu_device_info {{ {' '.join(parts)} }} "
        'platform_name: "CUDA" dnn_version_info { major: 9 minor: 10 } device_description_str: "NVIDIA H200"'
    )


def unavailable() -> str | None:
    """Return why nothing can be compiled for the chip here; None if it can."""
    try:
        _sharding()
    except (RuntimeError, ValueError, jax.errors.JaxRuntimeError) as error:
        reason = str(error).splitlines()[0]
        return f'skipped: no compiler for CUDA here; install "jax[cuda13]" in an environment of its own ({reason})'
    return None


def _sharding() -> jax.sharding.Sharding:
    from jax.experimental import topologies

    topology = topologies.get_topology_desc(platform="cuda", target_config=_chip(), topology="1x1x1")
    mesh = topologies.make_mesh(topo=topology, mesh_shape=(1,), axis_names=("device",))
    return jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec())


def compile_for_chip(function: Callable, *args: Any, **static: Any) -> Any:
    """Return a function, jitted or not, compiled for arguments like these: arrays, or their shapes and dtypes."""
    sharding = _sharding()

    def described(x: Any) -> jax.ShapeDtypeStruct:
        x = x if hasattr(x, "dtype") else np.asarray(x)
        return jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding)

    jitted = function if hasattr(function, "lower") else jax.jit(function)
    # Without a GPU, XLA cannot try out Triton's matrix products, and finds none for some shapes; so it takes cuBLAS's.
    options = {"xla_gpu_enable_triton_gemm": False}
    return jitted.lower(*jax.tree.map(described, args), **static).compile(compiler_options=options)


class Cost(NamedTuple):
    """The work of a part of a program.

    Attributes:
        launches: kernels, copies and calls of libraries, each counted once.
        waits: how often the host waits for a number: for each turn of a loop whose length only the device knows, and
            for each conditional.
        seconds: the least time, each launch by its bytes, its operations and its overhead.
        libraries: which libraries were called, and how often.
    """

    launches: float
    waits: float
    seconds: float
    libraries: dict[str, float]

    def plus(self, other: "Cost", times: float = 1.0) -> "Cost":
        """Return the sum of this and another, the latter taken `times` times."""
        names = {**self.libraries, **other.libraries}
        libraries = {name: self.libraries.get(name, 0) + times * other.libraries.get(name, 0) for name in names}
        numbers = (a + times * b for a, b in zip(self[:3], other[:3], strict=True))
        return Cost(*numbers, libraries)


NOTHING = Cost(0, 0, 0, {})


def peak_bytes(compiled: Any) -> int:
    """Return the most memory in use at once: arguments, results and temporaries."""
    memory = compiled.memory_analysis()
    own = memory.argument_size_in_bytes + memory.output_size_in_bytes + memory.temp_size_in_bytes
    return own - memory.alias_size_in_bytes


class Program:
    """A compiled program, read from its text."""

    def __init__(self, compiled: Any, turns: float = 1.0) -> None:
        """Read it; loops of unknown length take a given number of turns, conditions the mean of their branches."""
        self.turns, self.bodies, self.entry = turns, {}, ""
        self.shapes: dict[str, str] = {}
        body: list[tuple[str, str, str, str]] = []
        for line in compiled.as_text().splitlines():
            head = re.match(r"^(ENTRY )?%?([\w.\-]+) \(.*\{\s*$", line)
            if head:
                body = self.bodies.setdefault(head[2], [])
                self.entry = head[2] if head[1] else self.entry
                continue
            found = re.match(r"^\s*(?:ROOT )?%?([\w.\-]+) = (\(.*?\)|\S+) ([\w\-]+)\((.*)$", line)
            if found:
                name, shape, kind, rest = found.groups()
                body.append((name, shape, kind, rest))
                self.shapes[name] = shape

    def cost(self, computation: str | None = None) -> Cost:
        """Return the cost of the program, or of one of its computations."""
        total = NOTHING
        for name, shape, kind, rest in self.bodies[computation or self.entry]:
            total = total.plus(self._of(name, shape, kind, rest))
        return total

    def loops(self) -> Iterator[tuple[str, float | None]]:
        """Yield the bodies of all loops, and how often they turn, where that is known."""
        for body in self.bodies.values():
            for _, _, kind, rest in body:
                if kind == "while":
                    yield _called(rest, "body"), _trips(rest)

    def _of(self, name: str, shape: str, kind: str, rest: str) -> Cost:
        if kind in _FREE:
            return NOTHING
        if kind == "call":
            return self.cost(_called(rest, "to_apply"))
        if kind == "while":
            trips = _trips(rest)
            turns = self.turns if trips is None else trips
            test = self.cost(_called(rest, "condition")) if trips is None else NOTHING
            turn = self.cost(_called(rest, "body")).plus(test)
            return NOTHING.plus(turn, turns).plus(Cost(0, 1 if trips is None else 0, 0, {}), turns)
        if kind == "conditional":
            found = re.search(r"branch_computations=\{([^}]*)\}", rest)
            names = found[1].split(",") if found else re.findall(r"(?:true|false)_computation=%?([\w.\-]+)", rest)
            mean = Cost(0, 1, 0, {})
            for branch in names:
                mean = mean.plus(self.cost(branch.strip().lstrip("%")), 1 / len(names))
            return mean
        seconds = max(self._bytes(shape, kind, rest) / BANDWIDTH, self._product(shape, kind, rest), LAUNCH)
        target = re.search(r'custom_call_target="([^"]+)"', rest)
        return Cost(1, 0, seconds, {target[1]: 1} if target else {})

    def _bytes(self, shape: str, kind: str, rest: str) -> float:
        """Return the bytes that a kernel reads and writes; of arrays that it slices, only the slices."""
        operands = _operands(rest)
        called = re.search(r"calls=%?([\w.\-]+)", rest)
        if not called:
            if kind in _SLICES:
                return 2 * _size(shape)
            if kind == "dynamic-update-slice":
                return 2 * _size(self.shapes.get(operands[1], ""))
            return _size(shape) + sum(_size(self.shapes.get(operand, "")) for operand in operands)
        body = self.bodies[called[1]]
        # Arrays that only change their shape have users of their own.
        root = {name: _operands(r)[0] for name, _, k, r in body if k == "bitcast"}

        def origin(name: str) -> str:
            return origin(root[name]) if name in root else name

        used = [(s, k, [origin(name) for name in _operands(r)]) for _, s, k, r in body if k != "bitcast"]
        read = 0.0
        for name, its_shape, its_kind, _ in body:
            if its_kind == "parameter":
                users = [(s, k, names) for s, k, names in used if name in names]
                slices = [s for s, k, names in users if k in _SLICES and names.index(name) == 0]
                changed = [s for s, k, names in users if k == "dynamic-update-slice" and names.index(name) == 0]
                apart = len(slices) + len(changed) == len(users)
                read += min(sum(map(_size, slices)), _size(its_shape)) if apart else _size(its_shape)
        updates = [_size(self.shapes.get(names[1], "")) for _, k, names in used if k == "dynamic-update-slice"]
        return read + (min(sum(updates), _size(shape)) if updates else _size(shape))

    def _product(self, shape: str, kind: str, rest: str) -> float:
        """Return the least time of a kernel's matrix products."""
        called = re.search(r"calls=%?([\w.\-]+)", rest)
        inside = self.bodies[called[1]] if called else [("", shape, kind, rest)]
        return sum(self._dot(*part[1:]) for part in inside)

    def _dot(self, shape: str, kind: str, rest: str) -> float:
        if kind == "dot":
            found = re.search(r"lhs_contracting_dims=\{([\d,]*)\}", rest)
        elif kind == "custom-call" and "gemm" in rest:
            found = re.search(r'"lhs_contracting_dimensions":\[([^\]]*)\]', rest)
        else:
            return 0.0
        if not found:
            return 0.0
        axes = [int(axis) for axis in found[1].replace('"', "").split(",") if axis]
        _, left = _arrays(self.shapes[_operands(rest)[0]])[0]
        dtype, result = _arrays(shape)[0]
        return 2 * math.prod(result) * math.prod(left[axis] for axis in axes) / FLOPS.get(dtype, math.inf)


_FREE = {
    "parameter", "constant", "tuple", "get-tuple-element", "bitcast", "after-all", "partition-id", "replica-id",
    "opt-barrier", "get-dimension-size",
}  # fmt: skip
_SLICES = ("dynamic-slice", "gather", "slice")
_BYTES = {"pred": 1, "s8": 1, "u8": 1, "s16": 2, "u16": 2, "f16": 2, "bf16": 2, "s64": 8, "u64": 8, "f64": 8, "c64": 8}


def _arrays(shape: str) -> list[tuple[str, list[int]]]:
    """Return the dtypes and sizes of the arrays in a shape's text."""
    found = re.findall(r"\b([a-z]+\d*)\[([\d,]*)\]", shape)
    return [(dtype, [int(n) for n in sizes.split(",") if n]) for dtype, sizes in found]


def _size(shape: str) -> float:
    return sum(_BYTES.get(dtype, 4) * math.prod(sizes) for dtype, sizes in _arrays(shape))


def _operands(rest: str) -> list[str]:
    """Return the names between an instruction's parentheses."""
    depth, end = 1, 0
    while depth and end < len(rest):
        depth += {"(": 1, ")": -1}.get(rest[end], 0)
        end += 1
    return re.findall(r"%([\w.\-]+)", rest[: end - 1])


def _called(rest: str, role: str) -> str:
    found = re.search(rf"{role}=%?([\w.\-]+)", rest)
    assert found
    return found[1]


def _trips(rest: str) -> float | None:
    found = re.search(r'"known_trip_count":(\{[^}]*\})', rest)
    return float(json.loads(found[1])["n"]) if found else None
