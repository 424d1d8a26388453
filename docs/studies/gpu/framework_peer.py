"""Time calls of a kernel from PyTorch through NVRTC: ``framework_peer.py CASE``, with CASE from ``cases.json``."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import cupy
import numpy as np
import torch

case = json.loads(sys.argv[1])
dtype = torch.float64 if case["real"] == "double" else torch.float32
began = time.perf_counter()
name = f"{case['prefix']}_eval_kernel<{case['threads']}>"
module = cupy.RawModule(
    code=Path(case["header"]).read_text(encoding="utf-8"), options=("-std=c++17",), backend="nvrtc",
    name_expressions=(name,),
)  # fmt: skip
kernel = module.get_function(name)
result = {"nvrtc_s": time.perf_counter() - began, "rows": [], "us": []}
n = torch.tensor([0.0, 0.0, 1.0], device="cuda", dtype=dtype)


def evaluate(q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return H and ∇H of each row of q, as a framework would call the kernel."""
    rows, threads = q.shape[0], case["threads"]
    H, grad = (torch.empty(shape, device="cuda", dtype=dtype) for shape in (rows, (rows, case["nv"])))
    pointers = [H.data_ptr(), grad.data_ptr(), 0]
    with cupy.cuda.ExternalStream(torch.cuda.current_stream().cuda_stream):
        arguments = (q.data_ptr(), n.data_ptr(), np.int32(1), np.int32(rows), *pointers)
        kernel((-(-rows // threads),), (threads,), arguments)
    return H, grad


class Metric(torch.autograd.Function):
    """H of each row of q; the gradient is in the tangent space, which is the space of q for a fixed base."""

    @staticmethod
    def forward(context, q):  # type: ignore[no-untyped-def]
        """Compute H, and keep its gradient."""
        H, grad = evaluate(q)
        context.save_for_backward(grad)
        return H

    @staticmethod
    def backward(context, weight):  # type: ignore[no-untyped-def]
        """Multiply the gradient by the derivative of the loss with respect to H."""
        return weight[:, None] * context.saved_tensors[0]


samples = np.fromfile(case["samples"], dtype=np.float64, offset=12).reshape(-1, case["nq"] + 4 + case["nv"])
for rows in (1, 4096, 65536):
    q = torch.tensor(np.resize(samples[:, : case["nq"]], (rows, case["nq"])), device="cuda", dtype=dtype)
    evaluate(q)
    torch.cuda.synchronize()
    times = []
    for _ in range(5):
        began = time.perf_counter()
        for _ in range(30):
            evaluate(q)
        torch.cuda.synchronize()
        times.append((time.perf_counter() - began) / 30 * 1e6)
    result["rows"].append(rows)
    result["us"].append(sorted(times)[2])
if case["nq"] == case["nv"]:
    q = q.clone().requires_grad_(True)
    optimizer = torch.optim.Adam([q], 0.02)
    torch.cuda.synchronize()
    began = time.perf_counter()
    for step in range(300):
        optimizer.zero_grad()
        H = Metric.apply(q)
        if step == 0:
            result["before"] = H.median().item()
        H.sum().backward()
        optimizer.step()
    torch.cuda.synchronize()
    result |= {"adam_s": time.perf_counter() - began, "after": H.median().item()}
print(json.dumps(result))
