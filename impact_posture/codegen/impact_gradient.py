"""A built export as Python functions for a control loop.  Needs numpy and the library, no CasADi."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from impact_posture.codegen.library import build_library, library_path
from impact_posture.codegen.reader import check_library, check_robot, frame_block, read_manifest
from impact_posture.errors import InputError, ManifestMismatch, MetricError, PostureError, SpecError
from impact_posture.libraries import load_library

if TYPE_CHECKING:
    from impact_posture.robot.robot import Robot

Array = NDArray[Any]

_TYPES: dict[str, Any] = {"double": ctypes.c_double, "float": ctypes.c_float}
# What the library must reproduce of its manifest's reference: the compiler's rounding; in float, what is left of
# seven digits after feet at compliance ε (condition about 1/ε).
_SELF_TEST = {"double": 1e-7, "float": 0.1}


class ImpactGradient:
    """``H``, its tangent gradient and their relatives from a compiled export.

    Inputs are copied into buffers that were allocated once; **array results are views on such buffers, overwritten by
    the next call** of the same method: copy what must last.  One object serves one thread; :meth:`copy` makes
    another on the same library for another thread (calls release Python's lock).

    Attributes:
        manifest: The content of ``<prefix>.json``.
        frame: The contact frame that this object is about.
        free: Whether it leaves the supports away.
        nq: Numbers in a configuration.
        nv: Numbers in a gradient.
    """

    manifest: Mapping[str, Any]
    frame: str
    free: bool
    nq: int
    nv: int

    def __init__(
        self, library: ctypes.CDLL, manifest: Mapping[str, Any], frame: str | None = None, *, free: bool = False
    ) -> None:
        """Bind a loaded library; use :meth:`load`."""
        block = frame_block(manifest, frame)
        self.manifest, self.frame, self.free = manifest, str(block["frame"]), free
        self.nq, self.nv = int(manifest["nq"]), int(manifest["nv"])
        # A robot without supports is free as it is.
        self._block = (block.get("free") if free else None) or block
        self._library, self._symbols = library, dict(self._block["symbols"])
        if manifest.get("several") and not free:
            # The problem's own objective is that of all contacts at once, whichever frame is asked about.
            self._symbols |= manifest["several"]["symbols"]
        self._real = _TYPES[manifest["real"]]
        self.dtype = np.dtype(self._real)
        buffers = {"q": self.nq, "n": 3, "grad": self.nv, "own": self.nv, "jump": self.nv, "L": 9}
        kept = {name: (self._real * size)() for name, size in buffers.items()}
        views = {name: np.frombuffer(buffer, dtype=self.dtype) for name, buffer in kept.items()}
        self._q, self._n, self._L = views["q"], views["n"], views["L"].reshape(3, 3)
        self._grad, self._own, self._jump = views["grad"], views["own"], views["jump"]
        self._H, self._value, self._G, self._V = (self._real() for _ in range(4))
        q, n, grad, own, jump, L = (ctypes.byref(kept[name]) for name in ("q", "n", "grad", "own", "jump", "L"))
        H, value, G, V = (ctypes.byref(v) for v in (self._H, self._value, self._G, self._V))
        self._eval, self._eval_arguments = self._function("eval"), (q, n, H, grad)
        self._objective, self._objective_arguments = self._function("objective"), (q, value, own)
        self._alone, self._alone_arguments = self._function("value"), (q, n, H)
        self._jumps, self._jump_arguments = self._function("jump"), (q, n, jump, G, V)
        self._ellipsoid, self._ellipsoid_arguments = self._function("ellipsoid"), (q, L)
        self._batch = self._function("eval_batch")

    @classmethod
    def load(
        cls, path: str | Path, *, robot: Robot | None = None, frame: str | None = None, free: bool = False
    ) -> ImpactGradient:
        """Load an export.  **This runs its code**: load an export of others only if you would run their programs.

        ``lib<prefix>.so`` beside the manifest is used; where there is none **it is built there** with the user's
        compiler (``$CC``, cc, gcc or clang).  A library that was built by this package must be that very file (its
        SHA-256 lies beside it); any library must be whole, name this very manifest, and reproduce its numbers.

        Args:
            path: The export's folder, or its ``<prefix>.json``.
            robot: The robot in hand; the export must be of this very model.
            frame: Which contact frame of an export with several; the first by default.
            free: The robot without its supports, where the export has some.

        Raises:
            SpecError: No export there, or a broken one.
            ManifestMismatch: The export is of another robot, joint order, or convention, or the library is not the
                manifest's; names the difference.
            FrameNotFound: With the frames that it has.
            CompilerError: There is no library, and none can be built.
        """
        manifest, folder = read_manifest(Path(path))
        if robot is not None:
            check_robot(manifest, robot, where=str(path))
        frame_block(manifest, frame)
        prefix = str(manifest["prefix"])
        target = library_path(folder, prefix)
        if not target.is_file():
            build_library(folder, prefix)
        library = load_library(target)
        check_library(library, manifest, where=str(target))
        try:
            found = cls(library, manifest, frame, free=free)
        except AttributeError as error:
            raise SpecError(f"lacks a function ({error})", where=str(target), hint="run codegen again") from None
        found._self_test(str(target))
        return found

    def copy(self) -> ImpactGradient:
        """The same functions with buffers of their own, for another thread."""
        return ImpactGradient(self._library, self.manifest, self.frame, free=self.free)

    # ---- one configuration ------------------------------------------------------------------------------------

    def value_and_gradient(self, q: ArrayLike, n: ArrayLike) -> tuple[float, Array]:
        """``H`` and its tangent gradient, a view of shape (nv,).

        Args:
            q: Configuration, shape (nq,).
            n: Unit normal out of the surface, in the manifest's ``normal_frame``, shape (3,).

        Raises:
            InputError: A number that is not finite.
            PostureError: A quaternion or cosine-sine pair that is not of unit norm.
            MetricError: The result is not finite: the quantity does not exist there.
            ValueError: Another shape.
        """
        self._q[:] = q
        self._n[:] = n
        code = self._eval(*self._eval_arguments)
        if code:
            raise _failure(code)
        return self._H.value, self._grad

    def objective(self, q: ArrayLike) -> tuple[float, Array]:
        """The exported problem's own objective at its own normal, and its tangent gradient, a view of shape (nv,).

        Raises:
            InputError, PostureError, MetricError, ValueError: As :meth:`value_and_gradient`.
        """
        self._q[:] = q
        code = self._objective(*self._objective_arguments)
        if code:
            raise _failure(code)
        return self._value.value, self._own

    def value(self, q: ArrayLike, n: ArrayLike) -> float:
        """``H`` alone.

        Raises:
            InputError, PostureError, MetricError, ValueError: As :meth:`value_and_gradient`.
        """
        self._q[:] = q
        self._n[:] = n
        code = self._alone(*self._alone_arguments)
        if code:
            raise _failure(code)
        return float(self._H.value)

    def jump(self, q: ArrayLike, n: ArrayLike) -> tuple[Array, float, float]:
        """``a = M⁻¹Jᵀn``, a view of shape (nv,), ``G = nᵀJa`` (1/kg) and ``V = H/G²``.

        Raises:
            InputError, PostureError, MetricError, ValueError: As :meth:`value_and_gradient`.
        """
        self._q[:] = q
        self._n[:] = n
        code = self._jumps(*self._jump_arguments)
        if code:
            raise _failure(code)
        return self._jump, self._G.value, self._V.value

    def ellipsoid(self, q: ArrayLike) -> Array:
        """``Λ_c`` in world axes, a view of shape (3, 3).

        Raises:
            InputError, PostureError, MetricError, ValueError: As :meth:`value_and_gradient`.
        """
        self._q[:] = q
        code = self._ellipsoid(*self._ellipsoid_arguments)
        if code:
            raise _failure(code)
        return self._L

    # ---- many configurations ----------------------------------------------------------------------------------

    def value_and_gradient_batch(
        self, q: ArrayLike, n: ArrayLike, out: tuple[Array, Array] | None = None
    ) -> tuple[Array, Array]:
        """``H``, shape (N,), and tangent gradients, shape (N, nv), of many configurations; fresh arrays.

        Rows that cannot be computed (see :meth:`value_and_gradient`) are NaN; no other row suffers.

        Args:
            q: Configurations, shape (N, nq).
            n: Unit normals, shape (N, 3), or one for all, shape (3,).
            out: Contiguous arrays of the library's type to write into, instead of fresh ones.

        Raises:
            InputError: Shapes or types that do not fit.
        """
        q = np.ascontiguousarray(q, dtype=self.dtype)
        if q.ndim != 2 or q.shape[1] != self.nq:
            raise InputError(f"has shape {q.shape}", where="q", hint=f"give shape (N, {self.nq})")
        count = q.shape[0]
        n = np.asarray(n, dtype=self.dtype)
        if n.shape not in ((3,), (count, 3)):
            raise InputError(f"has shape {n.shape}", where="n", hint=f"give shape (3,) or ({count}, 3)")
        n = np.ascontiguousarray(np.broadcast_to(n, (count, 3)))
        H, grad = (np.empty(count, self.dtype), np.empty((count, self.nv), self.dtype)) if out is None else out
        for array, shape in ((H, (count,)), (grad, (count, self.nv))):
            if array.shape != shape or array.dtype != self.dtype or not array.flags.carray:
                raise InputError(
                    f"has shape {array.shape} of {array.dtype}",
                    where="out",
                    hint=f"give contiguous arrays of {self.dtype}, shapes ({count},) and ({count}, {self.nv})",
                )
        pointers = [ctypes.c_void_p(array.ctypes.data) for array in (q, n, H, grad)]
        self._batch(pointers[0], pointers[1], ctypes.c_int(count), pointers[2], pointers[3])
        return H, grad

    # ---- parts ------------------------------------------------------------------------------------------------

    def _function(self, name: str) -> Callable[..., int]:
        function: Callable[..., int] = getattr(self._library, self._symbols[name])
        return function

    def _self_test(self, where: str) -> None:
        test = self._block["self_test"]
        H, grad = self.value_and_gradient(test["q"], test["n"])
        found, expected = np.array([H, *grad]), np.array([test["H"], *test["grad"]])
        difference = float(np.abs(found - expected).max() / np.abs(expected).max())
        # Not ">": that is false for a NaN.
        if not difference <= _SELF_TEST[self.manifest["real"]]:
            raise ManifestMismatch(
                "reference value of H", test["H"], H, where=where, hint="delete the library: it is built again"
            )


def _failure(code: int) -> Exception:
    if code == 1:
        return InputError("is not finite", where="q or n", hint="correct the measurement")
    if code == 2:
        what = "a quaternion or cosine-sine pair is not of unit norm"
        return PostureError(what, where="q", hint="normalize it")
    return MetricError("is not finite", where="the result", hint="the quantity does not exist at this posture")
