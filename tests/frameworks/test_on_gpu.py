"""Batches on an NVIDIA GPU equal batches on the CPU.  Without a GPU, all tests skip."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import impact_posture as ip
from tests.frameworks.conftest import N, Sample, near


@pytest.fixture(scope="module", autouse=True)
def cupy() -> Any:
    cupy = pytest.importorskip("cupy", reason="needs CuPy: pip install 'impact-posture[cuda]'", exc_type=ImportError)
    try:
        cupy.cuda.runtime.getDeviceCount()
    except cupy.cuda.runtime.CUDARuntimeError as error:
        pytest.skip(f"needs an NVIDIA GPU ({error})")
    return cupy


@pytest.fixture
def torch() -> Any:
    """Return PyTorch, if PyTorch uses the GPU."""
    torch = pytest.importorskip("torch", reason="needs PyTorch: pip install torch", exc_type=ImportError)
    if not torch.cuda.is_available():
        pytest.skip("PyTorch does not use the GPU: install PyTorch with CUDA")
    return torch


@pytest.fixture
def jax(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return JAX, if JAX uses the GPU.  Do not let JAX reserve the memory that other packages need."""
    monkeypatch.setenv("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    jax = pytest.importorskip("jax", reason="needs JAX: pip install jax[cuda13]", exc_type=ImportError)
    if jax.default_backend() != "gpu":
        pytest.skip(f"JAX uses {jax.default_backend()}: pip install jax[cuda13]")
    return jax


@pytest.mark.parametrize("name", ["cupy", "torch", "jax"])
def test_batches(sample: Sample, name: str, request: pytest.FixtureRequest) -> None:
    package = request.getfixturevalue(name)
    puts: dict[str, Callable[[Any], Any]] = {
        "cupy": lambda array: package.asarray(array), "jax": lambda array: package.numpy.asarray(array),
        "torch": lambda array: package.tensor(array, device="cuda"),
    }  # fmt: skip
    metric, put = ip.gpu.load(sample.out), puts[name]
    for dtype, digits in {np.float64: 1e-11, np.float32: 1e-5}.items():
        q = put(sample.q.astype(dtype))
        for in_q in (False, True):
            for n in (N, np.tile(N, (600, 1))):
                results = metric.value_and_gradient(q, put(n), in_q=in_q)
                assert all(type(result) is type(q) and result.device == q.device for result in results)
                for result, expected in zip(results, metric.value_and_gradient(sample.q, n, in_q=in_q), strict=True):
                    near(on_cpu(result), expected, digits)
            for result, expected in zip(
                metric.objective(q, in_q=in_q), metric.objective(sample.q, in_q=in_q), strict=True
            ):
                near(on_cpu(result), expected, digits)
    assert metric.objective(q[:0])[0].shape == (0,)
    broken = sample.q[:300].copy()
    broken[200, 3:7] *= 2
    assert np.isnan(on_cpu(metric.objective(put(broken))[0])).nonzero()[0].tolist() == [200]


def on_cpu(array: Any) -> Any:
    return array.get() if hasattr(array, "get") else np.asarray(array.cpu() if hasattr(array, "cpu") else array)


def test_torch_differentiates(sample: Sample, torch: Any) -> None:
    metric = ip.torch.load(sample.out)
    q = torch.tensor(sample.q, device="cuda", requires_grad=True)
    metric(q, N).sum().backward()
    near(q.grad.cpu(), metric.batch.value_and_gradient(sample.q, N, in_q=True)[1], 1e-11)


def test_jax_transforms(sample: Sample, jax: Any) -> None:
    metric = ip.jax.load(sample.out)
    H, grad = metric.batch.value_and_gradient(sample.q, N, in_q=True)
    mass, slope = metric.batch.objective(sample.q, in_q=True)
    for double, digits in {True: 1e-11, False: 1e-5}.items():
        with jax.enable_x64(double):
            q, n = jax.numpy.asarray(sample.q), jax.numpy.asarray(N)
            call = jax.jit(jax.vmap(jax.value_and_grad(metric), (0, None)))
            call(q, n)
            # No array leaves the GPU.
            with jax.transfer_guard("disallow"):
                value, back = call(q, n)
            assert value.device == q.device
            near(value, H, digits)
            near(back, grad, digits)
            value, back = jax.vmap(jax.value_and_grad(metric.objective))(q)
            near(value, mass, digits)
            near(back, slope, digits)
            assert metric(q[:0], n).shape == (0,)
            assert np.isnan(metric(q.at[300, 0].set(np.nan), n)).nonzero()[0].tolist() == [300]
