"""Time H with its derivatives by the entries of q: ``framework_peer.py CALL CASE``, with CASE from ``cases.json``.

CALL is ``ip.gpu`` (with arrays of CuPy), ``ip.torch``, ``ip.jax``, or ``ip.jax on CPU``.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from impact_posture.frameworks import gpu

name, case = sys.argv[1], json.loads(sys.argv[2])
batch = gpu.load(Path(case["header"]).parent)
nq, dtype, N = case["nq"], batch.gradient.dtype, np.array([0.0, 0.6, 0.8])
samples = np.fromfile(case["samples"], dtype=np.float64, offset=12).reshape(-1, nq + 4 + case["nv"])[:, :nq]

if name == "ip.gpu":
    import cupy

    put, get, n = cupy.asarray, cupy.asnumpy, cupy.asarray(N, dtype=dtype)

    def call(q: Any) -> Any:
        return batch.value_and_gradient(q, n, in_q=True)

    def wait(_: Any) -> None:
        cupy.cuda.Device().synchronize()

elif name == "ip.torch":
    import torch

    from impact_posture.frameworks.torch_metric import TorchMetric

    torch_metric, n = TorchMetric(batch), torch.tensor(N.astype(dtype), device="cuda")

    def put(rows: Any) -> Any:
        return torch.tensor(rows, device="cuda", requires_grad=True)

    def get(array: Any) -> Any:
        return array.detach().cpu().numpy()

    def call(q: Any) -> Any:
        q.grad = None
        H = torch_metric(q, n)
        H.sum().backward()
        return H, q.grad

    def wait(_: Any) -> None:
        torch.cuda.synchronize()

else:
    import jax

    from impact_posture.frameworks.jax_metric import JaxMetric

    jax.config.update("jax_enable_x64", dtype == np.float64)
    device = jax.devices("cpu" if name.endswith("CPU") else "cuda")[0]
    each = jax.jit(jax.vmap(jax.value_and_grad(JaxMetric(batch)), (0, None)))

    def put(rows: Any) -> Any:
        return jax.device_put(rows, device)

    get, wait, n = np.asarray, jax.block_until_ready, put(N.astype(dtype))

    def call(q: Any) -> Any:
        return each(q, n)


def timed(q: Any, loops: int) -> float:
    """Return the mean time of calls in a row, in s."""
    began = time.perf_counter()
    for _ in range(loops):
        results = call(q)
    wait(results)
    return (time.perf_counter() - began) / loops


first, us = timed(put(samples[:1].astype(dtype)), 1), []
for rows in (1, 4096, 65536, 1 << 20):
    q = put(np.resize(samples, (rows, nq)).astype(dtype))
    timed(q, 3)
    loops = int(np.clip(0.05 / timed(q, 1), 1, 30))
    us.append(1e6 * sorted(timed(q, loops) for _ in range(5))[2])
expected = batch.value_and_gradient(samples.astype(dtype), N, in_q=True)
results = [get(array) for array in call(put(samples.astype(dtype)))]
errors = [np.abs(a - b).max() / np.abs(b).max() for a, b in zip(results, expected, strict=True)]
print(json.dumps({"first_s": first, "us": us, "error_H": float(errors[0]), "error_grad": float(errors[1])}))
