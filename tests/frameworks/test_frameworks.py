"""Batches of H and of the objective: on all cores, in PyTorch, and by CUDA kernels compiled as C++."""

from __future__ import annotations

import ctypes
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import impact_posture as ip
from impact_posture.errors import InputError, SpecError
from tests.codegen.test_cuda import on_host
from tests.frameworks.conftest import N, Sample

# A posture of the robot of ``sample``, written with integers.
WHOLE = [[0] * 6 + [1] + [0] * 2 + [1, 0] + [1, 0] + [0]]


def slopes(function: Any, q: Any) -> Any:
    """Return central differences of a function of one posture in the entries of ``q``."""
    step = 1e-6
    return np.array([(function(q + d) - function(q - d)) / (2 * step) for d in step * np.eye(len(q))])


def of_oracle(sample: Sample, q: Any) -> float:
    """Return H with Pinocchio, at ``q`` with normalized quaternion and angles."""
    return float(sample.objective.oracle.quantities(pin.normalize(sample.objective.robot.model, q)).H)


def test_batches_equal_single_calls_on_all_threads(sample: Sample, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: range(3))
    metric = ip.gpu.load(sample.out, robot=sample.objective.robot)
    H, grad = metric.value_and_gradient(sample.q, N)
    mass, slope = metric.objective(sample.q)
    single = metric.gradient
    for k in (0, 299, 300, 599):
        value, row = single.value_and_gradient(sample.q[k], N)
        np.testing.assert_allclose([H[k], *grad[k]], [value, *row], rtol=0, atol=1e-12 * np.abs(row).max())
        value, row = single.objective(sample.q[k])
        assert mass[k] == value and slope[k].tolist() == row.tolist()
    assert mass[0] == pytest.approx(sample.objective.value(sample.q[0]), rel=1e-10)
    broken = sample.q[:3].copy()
    broken[1, 3:7] *= 2
    assert np.isnan(metric.objective(broken)[0]).tolist() == [False, True, False]
    with pytest.raises(InputError, match="q: has shape"):
        metric.objective(sample.q[0])
    assert metric.objective(WHOLE)[0].dtype == float
    half, _ = metric.value_and_gradient(sample.q[:2].astype(np.float32) * 1.0, N)
    assert half.dtype == np.float32


def test_gradients_in_q_equal_differences_without_a_norm(sample: Sample) -> None:
    metric = ip.gpu.load(sample.out)
    q = sample.q[:3] * np.array([1.0, 1, 1, 1.1, 1.1, 1.1, 1.1, 1, 1, 0.9, 0.9, 1.2, 1.2, 1])
    H, grad = metric.value_and_gradient(q, N, in_q=True)
    for k in range(3):
        assert H[k] == pytest.approx(of_oracle(sample, q[k]), rel=1e-10)
        expected = slopes(lambda at: of_oracle(sample, at), q[k])
        np.testing.assert_allclose(grad[k], expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    _, tangent = metric.value_and_gradient(sample.q[:3], N)
    np.testing.assert_allclose(tangent[0], sample.objective.oracle.gradient_H(sample.q[0]), rtol=1e-6, atol=1e-9)


class OnGpu(np.ndarray):
    """An array of NumPy that names a GPU as its device."""

    def __dlpack_device__(self) -> Any:
        return 2, 0


def as_gpu(array: Any) -> Any:
    return np.array(array).view(OnGpu)


class Cupy:
    """The functions of CuPy that impact_posture calls.  Kernels are the CUDA code, compiled as C++."""

    cuda = SimpleNamespace(Device=lambda number: __import__("contextlib").nullcontext())
    library: ctypes.CDLL

    def __getattr__(self, name: str) -> Any:
        return getattr(np, name)

    @staticmethod
    def from_dlpack(array: Any) -> Any:
        return array.view(np.ndarray)

    def RawModule(self, code: str, options: Any, backend: str, name_expressions: tuple[str, ...]) -> Any:
        assert "_eval_kernel" in code and backend == "nvrtc"
        return self

    def get_function(self, expression: str) -> Any:
        """Return a kernel whose ``ptr`` is the number of a C++ function: 1 for eval, 2 for the objective."""
        name, threads = expression.removesuffix(">").split("_kernel<")
        function = getattr(self.library, f"{name}_rows" if name.endswith("eval") else f"{name}_batch")

        def kernel(grid: Any, block: Any, arguments: Any) -> None:
            q, *normals, count, value, grad, status = arguments
            assert grid[0] * block[0] >= count and block[0] == int(threads) and status == 0
            pointers = [ctypes.c_void_p(array.ctypes.data) for array in (q, *normals[:1], value, grad)]
            pointers.insert(-2, ctypes.c_int(count))
            if normals:
                assert normals[1] == 1
                pointers.append(ctypes.c_void_p(0))
            function(*pointers)

        kernel.ptr = 1 if name.endswith("eval") else 2
        return SimpleNamespace(kernel=kernel)


def test_arrays_on_a_gpu_call_the_kernels(sample: Sample, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the kernels as C++ and NumPy in place of CuPy, because machines of tests seldom have a GPU."""
    fake = Cupy()
    fake.library = on_host(sample.written, [sample.objective])
    monkeypatch.setitem(sys.modules, "cupy", fake)
    monkeypatch.setattr(OnGpu, "__array_namespace__", lambda self: fake, raising=False)
    metric = ip.gpu.load(sample.out)
    for in_q in (False, True):
        on_gpu, on_cpu = (
            [*metric.value_and_gradient(q, N, in_q=in_q), *metric.objective(q, in_q=in_q)]
            for q in (as_gpu(sample.q), sample.q)
        )
        for ours, theirs in zip(on_gpu, on_cpu, strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-11 * np.abs(theirs).max())
    (sample.out / "small.cuh").rename(sample.out / "hidden")
    with pytest.raises(InputError, match="export it with"):
        ip.gpu.load(sample.out).objective(as_gpu(sample.q))
    (sample.out / "hidden").rename(sample.out / "small.cuh")


class Unreadable:
    """An array on another device, which refuses either its device number or its content."""

    def __init__(self, refused: str) -> None:
        self.refused = refused

    def __dlpack_device__(self) -> tuple[int, int]:
        if self.refused == "device":
            raise BufferError("is on a TPU")
        return 10, 0

    def __dlpack__(self, **options: Any) -> Any:
        raise BufferError("is on an AMD GPU")


@pytest.mark.parametrize(("refused", "reason"), [("device", "is on a TPU"), ("content", "is on an AMD GPU")])
def test_arrays_on_other_devices_are_named(sample: Sample, refused: str, reason: str) -> None:
    metric, array = ip.gpu.load(sample.out), Unreadable(refused)
    for name, call in {
        "q": lambda: metric.objective(array),
        "n": lambda: metric.value_and_gradient(sample.q, array),
    }.items():
        with pytest.raises(InputError, match=rf"^{name}: cannot be read \({reason}\); give an array of float32"):
            call()


def test_exports_of_earlier_versions_do_not_name_the_entries_of_q(sample: Sample) -> None:
    gradient = ip.gpu.load(sample.out).gradient
    gradient.manifest = {key: value for key, value in gradient.manifest.items() if key != "q_names"}
    with pytest.raises(SpecError, match="run codegen again"):
        ip.gpu.BatchMetric(gradient, sample.out)


def test_absent_packages_are_named(sample: Sample, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, call in {
        "cupy": lambda: ip.gpu.load(sample.out).objective(as_gpu(sample.q)),
        "jax": lambda: ip.jax.load(sample.out),
    }.items():
        monkeypatch.setitem(sys.modules, name, None)
        with pytest.raises(InputError, match="pip install"):
            call()


# ---- PyTorch ------------------------------------------------------------------------------------------------------


def test_torch_differentiates(sample: Sample) -> None:
    torch = pytest.importorskip("torch", reason="needs PyTorch: pip install torch", exc_type=ImportError)
    metric = ip.torch.load(sample.out)
    q = torch.tensor(sample.q[:4], requires_grad=True)
    assert torch.autograd.gradcheck(lambda at: metric(at, N), [q])
    assert torch.autograd.gradcheck(metric.objective, [q])
    grid = q.detach().reshape(2, 2, -1).requires_grad_()
    normals = torch.tensor(np.tile(N, (2, 2, 1)))
    H = metric(grid, normals)
    assert H.shape == (2, 2) and H.dtype == torch.float64
    H.sum().backward()
    expected = metric.batch.value_and_gradient(sample.q[:4], N, in_q=True)
    np.testing.assert_array_equal(H.detach().reshape(4), expected[0])
    np.testing.assert_array_equal(grid.grad.reshape(4, -1), expected[1])
    single = metric.objective(q.detach().float())
    assert single.dtype == torch.float32 and not single.requires_grad
    tangent = metric.batch.objective(q.detach())
    assert isinstance(tangent[1], torch.Tensor) and tangent[1].shape == (4, sample.objective.robot.nv)
    assert metric(torch.tensor(WHOLE), N).item() == pytest.approx(of_oracle(sample, np.array(WHOLE[0], float)))
    with pytest.raises(InputError, match="detach n"):
        metric(q, torch.tensor(N, requires_grad=True))
    optimizer = torch.optim.Adam([q], 0.05)
    first = metric(q, N).detach()
    for _ in range(20):
        optimizer.zero_grad()
        metric(q, N).sum().backward()
        optimizer.step()
    assert (metric(q, N) < first).all()
