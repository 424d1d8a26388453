"""Call the C functions of a built export and return their return codes, for tests."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.codegen.manifest_reader import read_manifest
from impact_posture.system.libraries import build_library, library_path, load_library
from impact_posture.system.scratch_folder import scratch_folder

Vector = NDArray[Any]


@dataclass(frozen=True)
class Exported:
    """C functions of one frame.  Result buffers are filled with NaN before a call and copied after the call."""

    gradient: ImpactGradient

    def free(self) -> Exported:
        """Return the exported functions that ignore the supports."""
        gradient = self.gradient
        return Exported(ImpactGradient(gradient._library, gradient.manifest, gradient.frame, free=True))

    def eval(self, q: Vector, n: Vector) -> tuple[int, float, Vector]:
        code, (H, gradient) = self._call("eval", q, n)
        return code, float(H[0]), gradient

    def objective(self, q: Vector) -> tuple[int, float, Vector]:
        code, (value, gradient) = self._call("objective", q)
        return code, float(value[0]), gradient

    def value(self, q: Vector, n: Vector) -> tuple[int, float]:
        code, (H,) = self._call("value", q, n)
        return code, float(H[0])

    def jump(self, q: Vector, n: Vector) -> tuple[int, Vector, float, float]:
        code, (a, G, V) = self._call("jump", q, n)
        return code, a, float(G[0]), float(V[0])

    def _call(self, name: str, *inputs: Vector) -> tuple[int, tuple[Vector, ...]]:
        # A copy has separate buffers, so that several threads may call the functions at once.
        gradient = self.gradient.copy()
        for result in gradient._functions[name][1]:
            result[:] = np.nan
        return gradient.call(name, *inputs)


@contextmanager
def built(folder: Path, prefix: str, flags: tuple[str, ...] = ()) -> Iterator[Exported]:
    """Build an export in a temporary folder and bind its first frame."""
    manifest, _ = read_manifest(folder / f"{prefix}.json")
    with scratch_folder() as scratch:
        library = load_library(build_library(folder, prefix, library_path(scratch, prefix), flags))
        yield Exported(ImpactGradient(library, manifest))
