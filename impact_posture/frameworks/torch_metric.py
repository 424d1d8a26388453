"""H and the objective of an export as differentiable functions of PyTorch, on the CPU or on a GPU."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from impact_posture.errors import InputError
from impact_posture.frameworks import gpu
from impact_posture.system.optional_package import import_extra

if TYPE_CHECKING:
    from impact_posture.robot.robot import Robot


def load(
    path: str | Path, *, robot: Robot | None = None, frame: str | None = None, free: bool = False
) -> TorchMetric:
    """Load an export for PyTorch; arguments and errors are the same as in :meth:`ImpactGradient.load`.

    Raises:
        InputError: PyTorch is not installed.
    """
    return TorchMetric(gpu.load(path, robot=robot, frame=frame, free=free))


class TorchMetric:
    """``H`` and the objective of an export, differentiable with respect to ``q`` once.

    ``q`` has shape (…, nq), and results have shape (…).  The derivative is with respect to the entries of ``q``.  For
    a floating base, the function is ``H(u(q))``, where ``u`` normalizes the quaternion.  Therefore, an optimizer may
    change the four numbers of the quaternion freely.  The tangent gradient, shape (N, nv), is
    ``metric.batch.value_and_gradient(q.detach(), n)``.

    Attributes:
        batch: The same functions without differentiation.
    """

    def __init__(self, batch: gpu.BatchMetric) -> None:
        """Make the functions of a batch differentiable."""
        self.batch, self._apply = batch, _operator().apply

    def __call__(self, q: Any, n: Any) -> Any:
        """Return ``H`` for the unit normal ``n``, shape (3,) or (…, 3), which must not require a gradient.

        Raises:
            InputError: ``n`` requires a gradient, or :meth:`BatchMetric.value_and_gradient` raises the error.
        """
        if getattr(n, "requires_grad", False):
            raise InputError("the derivative with respect to n is not computed", where="n", hint="detach n")
        return self._apply(q, n, self.batch)

    def objective(self, q: Any) -> Any:
        """Return the objective of the export, such as the effective mass."""
        return self._apply(q, None, self.batch)


@cache
def _operator() -> Any:
    torch = import_extra("torch")

    def forward(context: Any, q: Any, n: Any, batch: gpu.BatchMetric) -> Any:
        rows = q.detach().reshape(-1, q.shape[-1])
        if n is None:
            value, grad = batch.objective(rows, in_q=True)
        else:
            normals = torch.as_tensor(n, dtype=torch.float64, device=q.device)
            if normals.ndim > 1:
                normals = normals.expand(*q.shape[:-1], 3).reshape(-1, 3)
            value, grad = batch.value_and_gradient(rows, normals, in_q=True)
        context.save_for_backward(grad.reshape(q.shape))
        return value.reshape(q.shape[:-1])

    def backward(context: Any, weight: Any) -> tuple[Any, None, None]:
        return weight[..., None] * context.saved_tensors[0], None, None

    once = torch.autograd.function.once_differentiable(backward)
    methods = {"forward": staticmethod(forward), "backward": staticmethod(once)}
    return type("ImpactMetric", (torch.autograd.Function,), methods)
