"""Draw random postures of exported problems: ``python -m docs.studies.random_draws FOLDER …``.

The program needs NumPy, pydantic, the package ``impact_posture``, and CuPy on a GPU.  CasADi and Pinocchio are not
needed, so another machine can draw the postures.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from docs.studies.build import processor
from impact_posture.frameworks import gpu

# Numbers of best and of first postures that are kept, and of postures of a batch on the CPU and on a GPU.
_KEPT, STARTS, _ROWS, _GPU_ROWS = 1000, 16, 1 << 16, 1 << 20


def random_draws(folder: Path) -> dict[str, Any]:
    """Return the lowest objectives ``values``, increasing, with their postures ``q``, and the ``first`` postures.

    ``median`` is the median of the first batch, and ``within`` counts the postures up to each objective ``counted``.
    ``time`` is the wall time, s, without the compilation of the export, on the GPU or processor ``device``.

    The folder contains an ``export`` and the list ``settings.json``: a posture, the entries of q to draw, their lower
    and upper limits, the objectives ``counted``, the number of postures, the seed.  The file ``draws.npz`` stores the
    draws.  Postures are drawn if this file is missing or has other settings.
    """
    settings, file = (folder / "settings.json").read_text(encoding="utf-8"), folder / "draws.npz"
    if not file.is_file() or np.load(file)["settings"] != settings:
        np.savez(file, settings=settings, **_draw(folder / "export", *json.loads(settings)))
    return dict(np.load(file))


def _draw(
    export: Path, posture: Any, columns: Any, low: Any, high: Any, counted: Any, count: int, seed: int
) -> dict[str, Any]:
    cupy = _gpu()
    xp, rows = (cupy, _GPU_ROWS) if cupy else (np, _ROWS)
    columns, low, high, counted = (xp.asarray(values) for values in (columns, low, high, counted))
    objective, rng = gpu.load(export).objective, xp.random.default_rng(seed)
    q, values, within = xp.tile(xp.asarray(posture), (rows, 1)), xp.zeros(0), xp.zeros(len(counted), dtype=int)
    kept, first, median, invalid = q[:0], q[:0], xp.zeros(()), xp.zeros((), dtype=int)
    objective(q[:1])  # compiles the GPU code
    began = time.perf_counter()
    # No step of this loop needs a number from the GPU, so the host does not wait.
    for drawn in range(0, count, rows):
        q = q[: count - drawn]
        q[:, columns] = low + (high - low) * rng.random((len(q), len(columns)))
        value, _ = objective(q)
        if not drawn:
            first, median = q[:STARTS].copy(), xp.median(value)
        within += (value <= counted[:, None]).sum(axis=1)
        invalid += xp.isnan(value).sum()
        values, kept = xp.concatenate([values, value]), xp.concatenate([kept, q])
        order = xp.argsort(values)[:_KEPT]
        values, kept = values[order], kept[order]
    assert not int(invalid)
    results = {"values": values, "q": kept, "first": first, "median": median, "within": within}
    device = cupy.cuda.runtime.getDeviceProperties(0)["name"].decode() if cupy else processor()["name"]
    took = time.perf_counter() - began
    return {name: array.get() if cupy else array for name, array in results.items()} | {
        "time": took,
        "device": device,
    }


def _gpu() -> Any:
    """Return CuPy if this machine has a GPU and CuPy can use it, else ``None``."""
    try:
        import cupy

        return cupy if cupy.cuda.runtime.getDeviceCount() else None
    except Exception:
        return None


if __name__ == "__main__":
    for name in sys.argv[1:]:
        draws = random_draws(Path(name))
        print(
            f"{name}: lowest objective {draws['values'][0]:.6g}; {draws['device']}, {draws['time']:.1f} s", flush=True
        )
