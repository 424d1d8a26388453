"""A built export as Python functions for a control loop, without CasADi and Pinocchio."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from impact_posture.codegen.export_functions import SIGNATURES, lengths
from impact_posture.codegen.manifest_reader import check_library, check_robot, frame_block, read_manifest
from impact_posture.config.checked import checked
from impact_posture.errors import InputError, ManifestMismatch, MetricError, PostureError, SpecError
from impact_posture.system.libraries import build_library, library_path, load_library

if TYPE_CHECKING:
    from impact_posture.robot.robot import Robot

Array = NDArray[Any]

_TYPES: dict[str, Any] = {"double": ctypes.c_double, "float": ctypes.c_float}
# Tolerance for the reference values of the manifest: rounding of the compiler.  In float, feet at compliance ε leave
# few of the seven digits (condition about 1/ε).
_SELF_TEST = {"double": 1e-7, "float": 0.1}


class ImpactGradient:
    """``H``, its tangent gradient and related quantities from a compiled export.

    Every method copies its inputs into buffers that were allocated once.  **Array results are views of buffers, and
    the next call of the same method overwrites them.**  Copy a result that must last.  An object serves one thread.
    :meth:`copy` returns an object for another thread.  Calls release the global interpreter lock.

    Methods for one configuration raise these errors:

    - ``InputError``: A number is not finite.
    - ``PostureError``: A quaternion or cosine-sine pair is not of unit norm.
    - ``MetricError``: The result is not finite, because the quantity does not exist there.
    - ``ValueError``: An input has the wrong shape.

    Attributes:
        manifest: The content of ``<prefix>.json``.
        frame: The contact frame of this object.
        free: Whether this object ignores the supports.
        nq: Length of a configuration.
        nv: Length of a gradient.
        dtype: The number type of the library.
    """

    def __init__(
        self, library: ctypes.CDLL, manifest: Mapping[str, Any], frame: str | None = None, *, free: bool = False
    ) -> None:
        """Bind a loaded library; use :meth:`load`."""
        block = frame_block(manifest, frame)
        self.manifest, self.frame, self.free = manifest, str(block["frame"]), free
        self.nq, self.nv = int(manifest["nq"]), int(manifest["nv"])
        # A robot without supports has no second set of functions.
        block = (block.get("free") if free else None) or block
        symbols = dict(block["symbols"])
        if manifest.get("several") and not free:
            # The problem has one objective, of all contacts together, at every frame.
            symbols |= manifest["several"]["symbols"]
        self._library, self._reference = library, block["self_test"]
        real = _TYPES[manifest["real"]]
        self.dtype = np.dtype(real)
        sizes = lengths(self.nq, self.nv)
        inputs = {name: (real * sizes[name])() for name in ("q", "n")}
        self._q, self._n = (np.frombuffer(buffer, dtype=self.dtype) for buffer in inputs.values())
        self._functions: dict[str, tuple[Callable[[], int], tuple[Array, ...]]] = {}
        for name, (input_names, results) in SIGNATURES.items():
            buffers = [(real * sizes.get(result, 1))() for result in results]
            arguments = [ctypes.byref(buffer) for buffer in (*[inputs[key] for key in input_names], *buffers)]
            views = tuple(np.frombuffer(buffer, dtype=self.dtype) for buffer in buffers)
            self._functions[name] = partial(getattr(library, symbols[name]), *arguments), views
        self._batch = getattr(library, symbols["eval_batch"])

    @classmethod
    @checked
    def load(
        cls, path: str | Path, *, robot: Robot | None = None, frame: str | None = None, free: bool = False
    ) -> ImpactGradient:
        """Load an export.  **This runs its code**, so load an export only if you trust its origin.

        The library is ``lib<prefix>.so`` beside the manifest.  If it is missing, this method **builds it there** with
        the user's compiler (``$CC``, cc, gcc or clang).  If there is a file with its SHA-256, the library must have
        this hash.  It must also name this manifest and reproduce its reference values.

        Args:
            path: The folder of the export, or its ``<prefix>.json``.
            robot: The robot, whose model the export must have.
            frame: The contact frame; by default the first of the export.
            free: Ignore the supports, if the export has some.

        Raises:
            SpecError: The export does not exist or is damaged.
            ManifestMismatch: Robot, joint order or convention differ, or the library belongs to another manifest.
                The error names the difference.
            FrameNotFound: The export has no such frame.  The error lists its frames.
            CompilerError: The library is missing and cannot be built.
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
            gradient = cls(library, manifest, frame, free=free)
        except AttributeError as error:
            raise SpecError(f"lacks a function ({error})", where=str(target), hint="run codegen again") from None
        gradient._self_test(str(target))
        return gradient

    def copy(self) -> ImpactGradient:
        """Return the same functions with new buffers, for another thread."""
        return ImpactGradient(self._library, self.manifest, self.frame, free=self.free)

    @checked
    def check_robot(self, robot: Robot) -> None:
        """Refuse a robot that differs from the export in more than the joint model.

        Raises:
            ManifestMismatch: The robot differs.  The error names the first difference.
        """
        # Only this method needs Pinocchio.
        from impact_posture.robot.joint_model import with_joint_model

        joints = self.manifest["joint_model"]
        check_robot(self.manifest, robot if joints == robot.joint_model else with_joint_model(robot, joints))

    def call(self, name: str, q: ArrayLike, n: ArrayLike | None = None) -> tuple[int, tuple[Array, ...]]:
        """Call a C function of :data:`~impact_posture.codegen.export_functions.SIGNATURES`.

        ``q`` has shape (nq,).  ``n`` is the unit normal out of the surface, in the manifest's ``normal_frame``, shape
        (3,).  Return the code of the function, and views of its results, also if the code is not zero.

        Raises:
            ValueError: An input has the wrong shape.
        """
        function, results = self._functions[name]
        # Assignment alone would broadcast one number to all joints.
        if len(q) != self.nq:  # type: ignore[arg-type]
            raise ValueError(f"q has length {len(q)}, not {self.nq}")  # type: ignore[arg-type]
        self._q[:] = q
        if n is None:
            if "n" in SIGNATURES[name][0]:
                raise ValueError(f"{name} needs a normal")
        else:
            if len(n) != 3:  # type: ignore[arg-type]
                raise ValueError(f"n has length {len(n)}, not 3")  # type: ignore[arg-type]
            self._n[:] = n
        return function(), results

    def _results(self, name: str, q: ArrayLike, n: ArrayLike | None = None) -> tuple[Array, ...]:
        """Return the results of a C function whose code is zero."""
        code, results = self.call(name, q, n)
        if code:
            raise _failure(code)
        return results

    def value_and_gradient(self, q: ArrayLike, n: ArrayLike) -> tuple[float, Array]:
        """Return ``H`` and its tangent gradient, a view of shape (nv,), with ``q`` and ``n`` as in :meth:`call`."""
        # Without self._results, because control loops call this method in every tick.
        code, (H, gradient) = self.call("eval", q, n)
        if code:
            raise _failure(code)
        return H.item(), gradient

    def objective(self, q: ArrayLike) -> tuple[float, Array]:
        """Return the exported objective at its normal, and its tangent gradient, a view of shape (nv,)."""
        value, gradient = self._results("objective", q)
        return value.item(), gradient

    def value(self, q: ArrayLike, n: ArrayLike) -> float:
        """Return ``H`` alone."""
        return float(self._results("value", q, n)[0].item())

    def jump(self, q: ArrayLike, n: ArrayLike) -> tuple[Array, float, float]:
        """Return ``a = M⁻¹Jᵀn``, a view of shape (nv,), ``G = nᵀJa`` (1/kg) and ``V = H/G²``."""
        a, G, V = self._results("jump", q, n)
        return a, G.item(), V.item()

    def ellipsoid(self, q: ArrayLike) -> Array:
        """Return ``Λ_c`` in world axes, a view of shape (3, 3)."""
        return self._results("ellipsoid", q)[0].reshape(3, 3)

    def value_and_gradient_batch(
        self, q: ArrayLike, n: ArrayLike, out: tuple[Array, Array] | None = None
    ) -> tuple[Array, Array]:
        """Return ``H``, shape (N,), and tangent gradients, shape (N, nv), of many configurations in new arrays.

        A row whose configuration would raise an error is NaN, and the other rows are valid.  ``q`` has shape (N, nq),
        and ``n`` shape (N, 3), or (3,) for one normal.  ``out`` has contiguous arrays of the library's type for the
        results.

        Raises:
            InputError: A shape or a type is wrong.
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
                hint = f"give contiguous arrays of {self.dtype}, shapes ({count},) and ({count}, {self.nv})"
                raise InputError(f"has shape {array.shape} of {array.dtype}", where="out", hint=hint)
        pointers = [ctypes.c_void_p(array.ctypes.data) for array in (q, n, H, grad)]
        self._batch(pointers[0], pointers[1], ctypes.c_int(count), pointers[2], pointers[3])
        return H, grad

    def _self_test(self, where: str) -> None:
        test = self._reference
        H, grad = self.value_and_gradient(test["q"], test["n"])
        values, expected = np.array([H, *grad]), np.array([test["H"], *test["grad"]])
        difference = float(np.abs(values - expected).max() / np.abs(expected).max())
        # A comparison by ">" would accept a NaN.
        if not difference <= _SELF_TEST[self.manifest["real"]]:
            hint = "delete the library, which is then built again"
            raise ManifestMismatch("reference value of H", test["H"], H, where=where, hint=hint)


def _failure(code: int) -> Exception:
    if code == 1:
        return InputError("is not finite", where="q or n", hint="correct the measurement")
    if code == 2:
        what = "a quaternion or cosine-sine pair is not of unit norm"
        return PostureError(what, where="q", hint="normalize it")
    return MetricError("is not finite", where="the result", hint="the quantity does not exist at this posture")
