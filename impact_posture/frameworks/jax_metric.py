"""H and the objective of an export as differentiable functions of JAX.

Programs that JAX compiles call the C code directly (``jax.ffi``), on all CPU cores.  Arrays on a GPU are copied to
the CPU and back.
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


def load(path: str | Path, *, robot: Robot | None = None, frame: str | None = None, free: bool = False) -> JaxMetric:
    """Load an export for JAX; arguments and errors are the same as in :meth:`ImpactGradient.load`.

    Raises:
        InputError: JAX is not installed, or its version lacks ``jax.ffi``.
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
        gradient = self.batch.gradient
        # The address is valid in this process only, but so is the trace that contains it.
        function = ctypes.cast(gradient.batch_function("eval" if n else "objective"), ctypes.c_void_p).value or 0
        call = self._jax.ffi.ffi_call(self._target, self._results(q), vmap_method="broadcast_all")
        return call(q, *n, function=np.int64(function), single=np.int32(gradient.dtype == np.float32))

    def _callback(self, q: Any, *n: Any) -> Any:
        call = self.batch.value_and_gradient if n else self.batch.objective

        def on_host(*arrays: Any) -> tuple[Any, Any]:
            value, grad = call(*(np.asarray(array).reshape(-1, array.shape[-1]) for array in arrays))
            shape = arrays[0].shape[:-1]
            return value.reshape(shape), grad.reshape(*shape, -1)

        return self._jax.pure_callback(on_host, self._results(q), q, *n, vmap_method="broadcast_all")

    def _results(self, q: Any) -> list[Any]:
        shapes = q.shape[:-1], (*q.shape[:-1], self.batch.gradient.nv)
        return [self._jax.ShapeDtypeStruct(shape, q.dtype) for shape in shapes]

    def _differentiable(self) -> Any:
        """Return the function ``(q, n)`` → ``H``, or the function ``q`` → objective."""
        jax = self._jax

        def compute(q: Any, *n: Any) -> tuple[Any, Any]:
            # NumPy and the C code have no half precision.
            single = jax.numpy.promote_types(q.dtype, jax.numpy.float32)
            rows, *normals = (array.reshape(-1, array.shape[-1]).astype(single) for array in (q, *n))
            rows, scales = self.batch.normalized(jax.numpy, rows)
            value, grad = jax.lax.platform_dependent(rows, *normals, cpu=self._foreign_call, default=self._callback)
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


@cache
def _target() -> str:
    """Compile the function that JAX calls, register it, and return its name."""
    ffi = import_extra("jax.ffi", "jax", "a version of JAX with jax.ffi")
    include, name = Path(ffi.include_dir()), "impact_posture_batch"
    header = (include / "xla" / "ffi" / "api" / "c_api.h").read_text(encoding="utf-8")
    library = cache_folder("xla") / f"lib{source_key([header], 'frameworks')}.so"
    if not is_cached(library):
        # The header needs C11.
        build_library(Path(__file__).parent / "c", "xla_batch", library, ("-std=c11", f"-I{include}"))
    ffi.register_ffi_target(name, ffi.pycapsule(getattr(load_library(library), name)), platform="cpu")
    return name
