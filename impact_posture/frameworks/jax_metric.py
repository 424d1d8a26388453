"""H and the objective of an export as differentiable functions of JAX.

The C code runs on all CPU cores, through ``jax.pure_callback``.  Arrays on a GPU are copied to the CPU and back.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from impact_posture.errors import InputError
from impact_posture.frameworks import gpu
from impact_posture.system.optional_package import import_extra

if TYPE_CHECKING:
    from impact_posture.robot.robot import Robot


def load(path: str | Path, *, robot: Robot | None = None, frame: str | None = None, free: bool = False) -> JaxMetric:
    """Load an export for JAX; arguments and errors are the same as in :meth:`ImpactGradient.load`.

    Raises:
        InputError: JAX is not installed.
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
        self.batch, self._jax = batch, import_extra("jax")
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

    def _differentiable(self) -> Any:
        """Return the function ``(q, n)`` → ``H``, or the function ``q`` → objective."""
        jax = self._jax

        def on_host(q: Any, *n: Any) -> tuple[Any, Any]:
            q, *normals = (np.asarray(array) for array in (q, *n))
            rows, normals = q.reshape(-1, q.shape[-1]), [array.reshape(-1, 3) for array in normals]
            call = self.batch.value_and_gradient if normals else self.batch.objective
            value, grad = call(rows, *normals, in_q=True)
            return value.reshape(q.shape[:-1]).astype(q.dtype), grad.reshape(q.shape).astype(q.dtype)

        def both(q: Any, *n: Any) -> Any:
            shapes = [jax.ShapeDtypeStruct(shape, q.dtype) for shape in (q.shape[:-1], q.shape)]
            return jax.pure_callback(on_host, shapes, q, *n, vmap_method="broadcast_all")

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
