"""JAX calls the C code on the CPU, and launches the kernels of a GPU, which are compiled as C++."""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import impact_posture as ip
from impact_posture.codegen.export import Export, write_export
from impact_posture.codegen.export_functions import BLOCK_THREADS
from impact_posture.errors import InputError
from impact_posture.frameworks import jax_metric
from impact_posture.system.libraries import build_library, load_library
from tests.codegen.test_cuda import on_host
from tests.frameworks.conftest import N, Sample, near
from tests.frameworks.test_frameworks import WHOLE, Cupy, of_oracle


def jax_module() -> Any:
    return pytest.importorskip("jax", reason="needs JAX: pip install jax", exc_type=ImportError)


def test_jax_transforms(sample: Sample) -> None:
    jax = jax_module()
    metric = ip.jax.load(sample.out)
    with jax.enable_x64(True):
        # Enough rows for several threads.
        q, n = jax.numpy.asarray(sample.q), jax.numpy.asarray(N)
        H, grad = metric.batch.value_and_gradient(sample.q, N, in_q=True)
        near(metric(q, n), H)
        near(jax.jit(jax.vmap(metric, (0, None)))(q, n), H)
        near(jax.jit(jax.vmap(jax.grad(metric), (0, None)))(q, n), grad)
        near(jax.vmap(jax.jit(jax.vmap(metric)))(q.reshape(20, 30, -1), np.tile(N, (20, 30, 1))).ravel(), H)
        change = jax.numpy.ones_like(q)
        _, along = jax.jvp(lambda at: metric(at, n), (q,), (change,))
        near(along, grad.sum(axis=1))
        mass, slope = metric.batch.objective(sample.q, in_q=True)
        value, back = jax.jit(jax.vmap(jax.value_and_grad(metric.objective)))(q)
        near(value, mass)
        near(back, slope)
        assert metric(q[:0], n).shape == (0,)
        assert np.isnan(metric(q.at[300, 0].set(np.nan), n)).nonzero()[0].tolist() == [300]
        ours, _ = metric.batch.objective(q)
        assert isinstance(ours, jax.Array)
        with pytest.raises(InputError, match="derivative with respect to n"):
            jax.grad(metric, argnums=1)(q[0], n)
    half = metric(np.float32(sample.q), N)
    assert half.dtype == np.float32
    near(half, H, 1e-5)
    for whole in (WHOLE, jax.numpy.asarray(WHOLE, dtype=jax.numpy.bfloat16)):
        assert float(metric(whole, N)[0]) == pytest.approx(of_oracle(sample, np.array(WHOLE[0], float)), rel=0.01)
    with pytest.raises(InputError, match="give shape"):
        metric(sample.q[:, 1:], N)


# The handler for GPUs, with the stream that XLA has on a GPU only.
ON_HOST = """
#include "xla_batch.c"

static XLA_FFI_Error *stream(XLA_FFI_Stream_Get_Args *args)
{
  args->stream = (void *)7;
  return NULL;
}

XLA_FFI_Error *launch_on_host(XLA_FFI_CallFrame *frame)
{
  XLA_FFI_CallFrame copy = *frame;
  XLA_FFI_Api api;
  if (frame->api != NULL) {
    api = *frame->api;
    api.XLA_FFI_Stream_Get = stream;
    copy.api = &api;
  }
  return impact_posture_launch(&copy);
}
"""


class Driver:
    """The function of the CUDA driver that XLA calls.  It computes all rows of a launch on the CPU."""

    def __init__(self, written: Export, library: ctypes.CDLL) -> None:
        pointers = ctypes.c_void_p, ctypes.POINTER(ctypes.c_void_p), ctypes.c_void_p
        kind = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, *[ctypes.c_uint] * 7, *pointers)
        self.cuLaunchKernel = kind(self.launch)
        self.functions = [getattr(library, f"{written.prefix}_{name}_batch") for name in ("eval", "objective")]
        self.rows: list[int] = []
        self.code = 0

    def launch(self, kernel: int, *numbers: Any) -> int:
        *grid_and_block, shared, stream, arguments, extra = numbers
        P, i = ctypes.c_void_p, ctypes.c_int
        # The arguments of <stem>_eval_kernel and of <stem>_objective_kernel.
        kinds = (P, P, i, i, P, P, P) if kernel == 1 else (P, i, P, P, P)
        given = [ctypes.cast(arguments[k], ctypes.POINTER(kind))[0] for k, kind in enumerate(kinds)]
        *inputs, count, value, grad, status = given
        blocks = -(-count // BLOCK_THREADS)
        assert grid_and_block == [blocks, 1, 1, BLOCK_THREADS, 1, 1] and (shared, stream, extra) == (0, 7, None)
        assert inputs[2:] == [count] * (kernel == 1) and status is None
        self.functions[kernel - 1](*map(P, inputs[:2]), count, P(value), P(grad))
        self.rows.append(count)
        return self.code


@pytest.fixture
def driver(sample: Sample, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Driver:
    """Make JAX call the handler for GPUs on the CPU."""
    ffi = jax_module().ffi
    (tmp_path / "on_host.c").write_text(ON_HOST, encoding="utf-8")
    sources = Path(jax_metric.__file__).parent / "c"
    build_library(tmp_path, "on_host", flags=("-std=c11", f"-I{ffi.include_dir()}", f"-I{sources}"))
    handler = load_library(tmp_path / "libon_host.so").launch_on_host
    name = f"on_host_{tmp_path.name}"
    ffi.register_ffi_target(name, ffi.pycapsule(handler), platform="cpu")
    fake = Cupy()
    fake.library = on_host(sample.written, [sample.objective])
    driver = Driver(sample.written, fake.library)
    monkeypatch.setitem(sys.modules, "cupy", fake)
    monkeypatch.setattr(jax_metric, "_target", lambda: name)
    monkeypatch.setattr(jax_metric, "_gpus", lambda jax: [0])
    monkeypatch.setattr(jax_metric, "_cuda_driver", lambda: driver)
    return driver


def test_jax_launches_kernels(sample: Sample, driver: Driver) -> None:
    jax = jax_module()
    metric = ip.jax.load(sample.out)
    H, grad = metric.batch.value_and_gradient(sample.q, N, in_q=True)
    mass, slope = metric.batch.objective(sample.q, in_q=True)
    near(metric(np.float32(sample.q), N), H, 1e-5)
    with jax.enable_x64(True):
        value, back = jax.jit(jax.vmap(jax.value_and_grad(metric), (0, None)))(sample.q, N)
        near(value, H, 1e-11)
        near(back, grad, 1e-11)
        value, back = jax.vmap(jax.value_and_grad(metric.objective))(sample.q)
        near(value, mass, 1e-11)
        near(back, slope, 1e-11)
        assert metric(sample.q[:0], N).shape == (0,)
        assert driver.rows == [600] * 3
        driver.code = 1
        with pytest.raises(RuntimeError, match="cuLaunchKernel failed"):
            metric(sample.q[:2], N)


def test_jax_names_missing_kernels(sample: Sample, driver: Driver) -> None:
    (sample.out / "small.cuh").rename(sample.out / "hidden")
    with pytest.raises(RuntimeError, match="has no CUDA code"):
        np.asarray(ip.jax.load(sample.out)(sample.q, N))
    (sample.out / "hidden").rename(sample.out / "small.cuh")


def test_jax_calls_exports_in_float(sample: Sample, tmp_path: Path) -> None:
    jax = jax_module()
    write_export([sample.objective], tmp_path, prefix="single", single=True, build=True)
    metric = ip.jax.load(tmp_path)
    H, _ = metric.batch.value_and_gradient(sample.q, N)
    with jax.enable_x64(True):
        value = metric(sample.q, N)
        assert value.dtype == float
        near(value, H, 1e-5)
    near(metric(np.float32(sample.q), N), H, 1e-5)
