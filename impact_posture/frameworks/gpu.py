"""Batches of H and the objective on all CPU cores, or on the GPU that holds the arrays.  CasADi is not needed.

Arrays of every package with the DLPack protocol are accepted: NumPy, CuPy, PyTorch, JAX.  A GPU needs CuPy
(``impact-posture[cuda]``) and an export with ``--cuda``.  CuPy compiles the kernels with NVRTC at their first call.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from impact_posture.codegen.export_functions import BLOCK_THREADS
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.config.checked import checked
from impact_posture.errors import InputError, SpecError
from impact_posture.system.optional_package import import_extra
from impact_posture.system.text_files import read_text

if TYPE_CHECKING:
    from impact_posture.robot.robot import Robot

# Number of the device type CUDA in DLPack.
_CUDA = 2
# Last words of the names of a joint's entries in q → number of entries of the joint in ν.
_JOINTS = {
    ("x (m)", "y (m)", "z (m)", "qx", "qy", "qz", "qw"): 6,
    ("x (m)", "y (m)", "cos", "sin"): 3,
    ("qx", "qy", "qz", "qw"): 3,
    ("cos", "sin"): 1,
}


@checked
def load(
    path: str | Path, *, robot: Robot | None = None, frame: str | None = None, free: bool = False
) -> BatchMetric:
    """Load an export for batches; arguments and errors are the same as in :meth:`ImpactGradient.load`.

    Loading runs the code of the export.
    """
    folder = Path(path) if Path(path).is_dir() else Path(path).parent
    return BatchMetric(ImpactGradient.load(path, robot=robot, frame=frame, free=free), folder)


@dataclass(frozen=True)
class Kernel:
    """A CUDA kernel on one GPU, and how it is launched.

    Attributes:
        function: The kernel; ``function.ptr`` is its ``CUfunction``.
        block: Number of threads in a block.
        rows: Number of rows that a block computes.
    """

    function: Any
    block: int
    rows: int


class BatchMetric:
    """``H`` and the objective of an export, with gradients, for many configurations.

    The results have the package, floating-point type and device of ``q``.  If ``q`` is on the CPU, the C code
    computes the rows on all cores.  If ``q`` is on an NVIDIA GPU, the CUDA code computes the rows on this GPU.  The
    results of an invalid configuration are NaN.

    By default, gradients are **tangent** gradients, shape (N, nv): entry i is the derivative along ``ν_i``.  For a
    floating base, the first six entries are for the linear and angular velocity in base axes.  With ``in_q``,
    gradients are derivatives with respect to the **entries of q**, shape (N, nq), and ``q`` need not be normalized.
    In this case, the function is ``H(u(q))``, where ``u`` divides every quaternion and every cosine-sine pair by its
    norm. For a robot without quaternions and cosine-sine pairs, both gradients are equal.

    Attributes:
        gradient: The functions for a single configuration.
    """

    def __init__(self, gradient: ImpactGradient, folder: Path) -> None:
        """Use a loaded export; ``folder`` contains its CUDA code, if there is any."""
        self.gradient, self._folder = gradient, folder
        names, prefix = gradient.manifest.get("q_names"), gradient.manifest["prefix"]
        if names is None:
            # An earlier version wrote this export.
            raise SpecError("does not name the entries of q", where=f"{prefix}.json", hint="run codegen again")
        self._joints = tuple(_joints(names))
        self._kernels: dict[tuple[str, int], Kernel] = {}

    def value_and_gradient(self, q: Any, n: Any, *, in_q: bool = False) -> tuple[Any, Any]:
        """Return ``H``, shape (N,), and its gradients for configurations ``q``, shape (N, nq).

        ``n`` is the unit normal out of the surface, shape (3,) or (N, 3), in the axes that the key ``normal_frame``
        of the manifest names.

        Raises:
            InputError: A shape is wrong, an array is neither on the CPU nor on an NVIDIA GPU, CuPy is not installed,
                or the export has no CUDA code.
        """
        return self._call("eval", q, n, in_q)

    def objective(self, q: Any, *, in_q: bool = False) -> tuple[Any, Any]:
        """Return the objective of the export, shape (N,), and its gradients.

        Raises:
            InputError: The same errors as in :meth:`value_and_gradient`.
            SpecError: An earlier version wrote the export, which therefore lacks a batch of the objective.
        """
        return self._call("objective", q, None, in_q)

    def _call(self, name: str, q: Any, n: Any, in_q: bool) -> tuple[Any, Any]:
        with _readable("q"):
            package, on_gpu = _package(q), _on_gpu(q)
        # Without quaternions and cosine-sine pairs, both gradients are equal.
        in_q = in_q and bool(self._joints)
        xp = import_extra("cupy", "cuda", "CuPy") if on_gpu else np
        device = q.__dlpack_device__()[1] if on_gpu else 0
        with xp.cuda.Device(device) if on_gpu else nullcontext():
            with _readable("q"):
                given = _to(xp, q)
            rows = xp.ascontiguousarray(given, dtype=self.gradient.dtype)
            with _readable("n"):
                normals = () if n is None else (xp.asarray(_to(xp, n), dtype=self.gradient.dtype),)
            self.gradient.check_shapes(rows, *normals)
            rows, scales = self.normalized(xp, rows) if in_q else (rows, None)
            inputs = (rows, *normals)
            value, grad = self._launch(xp, (name, device), *inputs) if on_gpu else self._on_cores(name, *inputs)
            if in_q:
                grad = self.in_coordinates(xp, rows, scales, grad)
            kept = given.dtype if given.dtype.kind == "f" else self.gradient.dtype
            results = [array.astype(kept, copy=False) for array in (value, grad)]
            value, grad = results if package is xp else map(package.from_dlpack, results)
        return value, grad

    def _on_cores(self, name: str, *inputs: Any) -> tuple[Any, Any]:
        call = self.gradient.objective_batch if name == "objective" else self.gradient.value_and_gradient_batch
        return call(*inputs, threads=len(os.sched_getaffinity(0)))

    def _launch(self, cupy: Any, key: tuple[str, int], q: Any, n: Any = None) -> tuple[Any, Any]:
        """Run a CUDA kernel; ``key`` is the name of its function and the number of the current GPU."""
        kernel = self.kernel(*key)
        count, normals = len(q), list[Any]()
        if n is not None:
            normals = [cupy.ascontiguousarray(n), np.int32(n.size // 3)]
        value = cupy.empty(count, dtype=self.gradient.dtype)
        grad = cupy.empty((count, self.gradient.nv), dtype=self.gradient.dtype)
        if count:
            # The last argument is a null pointer in place of the array of return codes.
            arguments = (q, *normals, np.int32(count), value, grad, 0)
            kernel.function((-(-count // kernel.rows),), (kernel.block,), arguments)
        return value, grad

    def kernel(self, name: str, device: int) -> Kernel:
        """Return the kernel of the function ``eval`` or ``objective`` for the GPU with the number ``device``.

        The first call compiles the kernel.

        Raises:
            InputError: CuPy is not installed, or the export has no CUDA code.
        """
        if (kernel := self._kernels.get((name, device))) is None:
            cupy = import_extra("cupy", "cuda", "CuPy")
            header = self._folder / f"{self.gradient.manifest['prefix']}.cuh"
            if not header.is_file():
                raise InputError("has no CUDA code", where=str(self._folder), hint="export it with `cuda`")
            expression = f"{self.gradient.symbols[name]}_kernel<{BLOCK_THREADS}>"
            code, options = read_text(header), ("-std=c++17",)
            with cupy.cuda.Device(device):
                module = cupy.RawModule(code=code, options=options, backend="nvrtc", name_expressions=(expression,))
                function = module.get_function(expression).kernel
            # An earlier version wrote a header without this macro; there, each thread computes a row.
            rows = re.search(r"^#define \w+_ROWS (\d+)$", code, re.MULTILINE)
            kernel = Kernel(function, BLOCK_THREADS, int(rows[1]) if rows else BLOCK_THREADS)
            self._kernels[name, device] = kernel
        return kernel

    def normalized(self, xp: Any, q: Any) -> tuple[Any, Any]:
        """Return ``u(q)``, with normalized quaternions and cosine-sine pairs, and ``u(q)/q``, shape (N, nq).

        ``xp`` is the module of the array ``q``, such as NumPy.
        """
        ones, parts, at = xp.ones_like(q), list[Any](), 0
        for names, first, _ in self._joints:
            last = first + len(names)
            unit = last - (4 if "qw" in names else 2)
            norm = xp.linalg.norm(q[:, unit:last], axis=1, keepdims=True)
            parts += [ones[:, at:unit], ones[:, unit:last] / norm]
            at = last
        scales = xp.concatenate([*parts, ones[:, at:]], axis=1)
        return q * scales, scales

    def in_coordinates(self, xp: Any, q: Any, scales: Any, tangent: Any) -> Any:
        """Return the gradients of ``H(u(q))``, shape (N, nq), from tangent gradients and ``u(q)``."""
        parts, done = list[Any](), 0
        for names, at, speed in self._joints:
            last, size = at + len(names), _JOINTS[names]
            # Joints before this joint have as many entries in q as in ν.
            parts.append(tangent[:, done:speed])
            done = speed + size
            g = tangent[:, speed:done]
            if "qw" in names:
                # With the vector part r and the scalar part w, q̇ = ½(wω + r×ω, −rᵀω) and R v = v + 2 r×(wv + r×v).
                r, w, turn = q[:, last - 4 : last - 1], q[:, last - 1 : last], g[:, -3:]
                if size == 6:
                    parts.append(g[:, :3] + 2 * xp.cross(r, w * g[:, :3] + xp.cross(r, g[:, :3])))
                parts += [2 * (w * turn + xp.cross(r, turn)), -2 * (r * turn).sum(axis=1, keepdims=True)]
            else:
                c, s, x, y, turn = q[:, last - 2 : last - 1], q[:, last - 1 : last], g[:, :1], g[:, 1:2], g[:, -1:]
                if size == 3:
                    parts += [c * x - s * y, s * x + c * y]
                parts += [-s * turn, c * turn]
        return xp.concatenate([*parts, tangent[:, done:]], axis=1) * scales


def _joints(q_names: Sequence[str]) -> Iterator[tuple[tuple[str, ...], int, int]]:
    """Yield each joint with more entries in q than in ν: names of the entries, first entry in q, first entry in ν."""
    at = speed = 0
    while at < len(q_names):
        for names, size in _JOINTS.items():
            entries = q_names[at : at + len(names)]
            if len(entries) == len(names) and all(e.endswith(f" {n}") for e, n in zip(entries, names, strict=True)):
                yield names, at, speed
                at, speed = at + len(names), speed + size
                break
        else:
            at, speed = at + 1, speed + 1


def _package(array: Any) -> Any:
    """Return the package of an array, such as PyTorch or JAX; NumPy for lists and numbers."""
    if hasattr(array, "__array_namespace__"):
        return array.__array_namespace__()
    return sys.modules[type(array).__module__.partition(".")[0]] if hasattr(array, "__dlpack__") else np


@contextmanager
def _readable(name: str) -> Iterator[None]:
    """Name the array in the errors of its package, for example if the array is on a TPU or requires a gradient."""
    try:
        yield
    except (BufferError, RuntimeError, ValueError) as error:
        hint = "give an array of float32 or float64 on the CPU or on an NVIDIA GPU"
        raise InputError(f"cannot be read ({error})", where=name, hint=hint) from None


def _on_gpu(array: Any) -> bool:
    return hasattr(array, "__dlpack_device__") and array.__dlpack_device__()[0] == _CUDA


def _to(xp: Any, array: Any) -> Any:
    """Return an array as an array of NumPy or CuPy, without a copy if possible."""
    if _on_gpu(array):
        return xp.from_dlpack(array)
    return xp.asarray(np.from_dlpack(array) if hasattr(array, "__dlpack__") and _package(array) is not np else array)
