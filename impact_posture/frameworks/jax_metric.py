"""H and the objective of an export as differentiable functions of JAX.

Programs that JAX compiles call the C code directly (``jax.ffi``), on all CPU cores.  On an NVIDIA GPU, they launch
the CUDA kernels of the export, which CuPy compiles.  No array leaves the GPU.
"""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from impact_posture.errors import InputError
from impact_posture.frameworks import gpu
from impact_posture.system.libraries import build_library, cache_folder, is_cached, load_library, source_key
from impact_posture.system.optional_package import import_extra

if TYPE_CHECKING:
    from impact_posture.robot.robot import Robot

# Kernels in compiled programs.
_KEPT: list[Any] = []


def load(path: str | Path, *, robot: Robot | None = None, frame: str | None = None, free: bool = False) -> JaxMetric:
    """Load an export for JAX; arguments and errors are the same as in :meth:`ImpactGradient.load`.

    Raises:
        InputError: JAX is not installed, or its version is older than 0.8.
        CompilerError: The function that JAX calls cannot be compiled.
    """
    return JaxMetric(gpu.load(path, robot=robot, frame=frame, free=free))


class JaxMetric:
    """``H`` and the objective of an export for ``jit``, ``vmap``, ``grad`` and ``jvp``; first derivatives only.

    ``q`` has shape (…, nq), and results have shape (…).  The derivative is with respect to the entries of ``q``, as
    in :class:`~impact_posture.frameworks.torch_metric.TorchMetric`.  The tangent gradient of concrete arrays is
    ``metric.batch.value_and_gradient(q, n)``.

    Attributes:
        batch: The same functions without differentiation.
    """

    def __init__(self, batch: gpu.BatchMetric) -> None:
        """Make the functions of a batch differentiable."""
        self.batch, self._jax, self._target = batch, import_extra("jax", "jax", "JAX"), _target()
        self._function = self._differentiable()

    def __call__(self, q: Any, n: Any) -> Any:
        """Return ``H`` for the unit normal ``n``, shape (3,) or (…, 3).

        Raises:
            InputError: ``q`` has the wrong shape, or a derivative with respect to ``n`` is requested.
        """
        q, numpy = self._postures(q), self._jax.numpy
        return self._function(q, numpy.broadcast_to(numpy.asarray(n, dtype=q.dtype), (*q.shape[:-1], 3)))

    def objective(self, q: Any) -> Any:
        """Return the objective of the export, such as the effective mass."""
        return self._function(self._postures(q))

    def _postures(self, q: Any) -> Any:
        """Return ``q`` as floating-point numbers.  Check its shape here, because JAX hides errors of callbacks."""
        q, nq = self._jax.numpy.asarray(q), self.batch.gradient.nq
        if q.shape[-1:] != (nq,):
            raise InputError(f"has shape {q.shape}", where="q", hint=f"give shape (…, {nq})")
        return q.astype(self._jax.numpy.result_type(q, float))

    def _foreign_call(self, q: Any, *n: Any) -> Any:
        """Call the C code on the CPU, or the kernel on a GPU, in the number type of the export."""
        jax, dtype = self._jax, self.batch.gradient.dtype
        # Without this context, JAX may turn double into float.
        with jax.enable_x64(True):
            call = jax.ffi.ffi_call(self._target, self._results(q), vmap_method="broadcast_all")
            inputs = [jax.lax.convert_element_type(array, dtype) for array in (q, *n)]
            results = call(*inputs, **self._attributes("eval" if n else "objective"))
            return [jax.lax.convert_element_type(array, q.dtype) for array in results]

    def _attributes(self, name: str) -> dict[str, Any]:
        """Return what the C code that JAX calls needs: the C function ``name``, its kernels, and their launch.

        The addresses are valid in this process only, but so is the trace that contains them.
        """
        kernels, launch, fault = list[gpu.Kernel](), 0, ""
        if gpus := _gpus(self._jax):
            try:
                kernels = [self.batch.kernel(name, device) for device in range(max(gpus) + 1)]
                launch = _address(_cuda_driver().cuLaunchKernel)
            except InputError as error:
                # The program may be for the CPU, so only its call on a GPU fails.
                fault = str(error)
        # A compiled program may be called after the metric is deleted.
        _KEPT.extend(kernels)
        shape = kernels[0] if kernels else gpu.Kernel(None, 1, 1)
        numbers = {
            "batch": _address(self.batch.gradient.batch_function(name)), "launch": launch, "block": shape.block,
            "rows": shape.rows,
        }  # fmt: skip
        addresses = np.array([kernel.function.ptr for kernel in kernels] or [0], dtype=np.int64)
        return {"fault": fault, "kernels": addresses} | {key: np.int64(number) for key, number in numbers.items()}

    def _results(self, q: Any) -> list[Any]:
        shapes = q.shape[:-1], (*q.shape[:-1], self.batch.gradient.nv)
        return [self._jax.ShapeDtypeStruct(shape, self.batch.gradient.dtype) for shape in shapes]

    def _differentiable(self) -> Any:
        """Return the function ``(q, n)`` → ``H``, or the function ``q`` → objective."""
        jax = self._jax

        def compute(q: Any, *n: Any) -> tuple[Any, Any]:
            # NumPy and the C code have no half precision.
            single = jax.numpy.promote_types(q.dtype, jax.numpy.float32)
            rows, *normals = (array.reshape(-1, array.shape[-1]).astype(single) for array in (q, *n))
            rows, scales = self.batch.normalized(jax.numpy, rows)
            value, grad = self._foreign_call(rows, *normals)
            grad = self.batch.in_coordinates(jax.numpy, rows, scales, grad)
            return value.reshape(q.shape[:-1]).astype(q.dtype), grad.reshape(q.shape).astype(q.dtype)

        both = jax.jit(compute)

        def derivative(inputs: Any, changes: Any) -> tuple[Any, Any]:
            unchanged = [isinstance(change, jax.custom_derivatives.SymbolicZero) for change in changes]
            if not all(unchanged[1:]):
                raise InputError(
                    "the derivative with respect to n is not computed", where="n", hint="stop_gradient(n)"
                )
            value, grad = both(*inputs)
            change = jax.numpy.zeros_like(value) if unchanged[0] else (grad * changes[0]).sum(axis=-1)
            return value, change

        function = jax.custom_jvp(lambda *inputs: both(*inputs)[0])
        function.defjvp(derivative, symbolic_zeros=True)
        return function


def _gpus(jax: Any) -> list[int]:
    """Return the numbers of the NVIDIA GPUs that JAX uses in this process."""
    try:
        return [device.local_hardware_id for device in jax.local_devices(backend="cuda")]
    except RuntimeError:
        # JAX has no such backend.
        return []


def _cuda_driver() -> ctypes.CDLL:
    return ctypes.CDLL("libcuda.so.1")


def _address(function: Any) -> int:
    return ctypes.cast(function, ctypes.c_void_p).value or 0


@cache
def _target() -> str:
    """Compile the functions that JAX calls, register them, and return their name."""
    ffi = import_extra("jax.ffi", "jax", "JAX 0.8")
    if not hasattr(import_extra("jax"), "enable_x64"):
        raise InputError("is older than 0.8", where="JAX", hint="pip install 'impact-posture[jax]'")
    include, name = Path(ffi.include_dir()), "impact_posture_batch"
    header = (include / "xla" / "ffi" / "api" / "c_api.h").read_text(encoding="utf-8")
    library = cache_folder("xla") / f"lib{source_key([header], 'frameworks')}.so"
    if not is_cached(library):
        # The header needs C11.
        build_library(Path(__file__).parent / "c", "xla_batch", library, ("-std=c11", f"-I{include}"))
    functions = load_library(library)
    for platform, function in {"cpu": name, "CUDA": "impact_posture_launch"}.items():
        ffi.register_ffi_target(name, ffi.pycapsule(getattr(functions, function)), platform=platform)
    return name
