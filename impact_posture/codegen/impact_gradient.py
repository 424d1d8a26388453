"""Call the functions of a compiled export from Python, for control loops; CasADi and Pinocchio are not needed."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
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
# Relative tolerance for rounding errors in the comparison with the reference values of the manifest.  In float, few
# of the seven digits are correct for a robot with supports.  The compliance ε of the supports causes a condition
# number of about 1/ε.
_SELF_TEST = {"double": 1e-7, "float": 0.1}
# Least number of rows of a batch that each thread computes.
_LEAST_ROWS = 256


class ImpactGradient:
    """Compute ``H``, its tangent gradient and related quantities with a compiled export.

    Every method copies its inputs into buffers that were allocated once.  **Array results are views of buffers, which
    the next call of the same method overwrites.**  Copy a result if you need it after the next call.  Use an object
    in one thread only; :meth:`copy` returns an object for another thread.  Calls release the global interpreter lock.

    The methods for one configuration raise these errors:

    - ``InputError``: A number is not finite.
    - ``PostureError``: A quaternion or cosine-sine pair is not of unit norm.
    - ``MetricError``: The result is not finite, because the quantity does not exist at this configuration.
    - ``ValueError``: An input has the wrong shape.

    Attributes:
        manifest: The content of ``<prefix>.json``.
        frame: Name of the contact frame of this object.
        free: Whether this object ignores the supports of the robot.
        nq: Length of a configuration.
        nv: Length of a gradient.
        dtype: NumPy type of the numbers in the library.
        symbols: Name of a function in the manifest → its C name for this frame.
    """

    def __init__(
        self, library: ctypes.CDLL, manifest: Mapping[str, Any], frame: str | None = None, *, free: bool = False
    ) -> None:
        """Bind the functions of a loaded library.  To load an export, use :meth:`load` instead."""
        block = frame_block(manifest, frame)
        self.manifest, self.frame, self.free = manifest, str(block["frame"]), free
        self.nq, self.nv = int(manifest["nq"]), int(manifest["nv"])
        # If the robot has no supports, the export has no separate functions without supports.
        block = (block.get("free") if free else None) or block
        symbols = dict(block["symbols"])
        if manifest.get("several") and not free:
            # This objective is the worst case over all contacts, so it is the same for every frame.
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
        # Exports of earlier versions have no batch of the objective.
        names = {"eval": symbols["eval_batch"], "objective": symbols.get("objective_batch")}
        self._batches = {name: getattr(library, symbol) for name, symbol in names.items() if symbol}
        self.symbols = symbols

    @classmethod
    @checked
    def load(
        cls, path: str | Path, *, robot: Robot | None = None, frame: str | None = None, free: bool = False
    ) -> ImpactGradient:
        """Load an export.  **Loading runs the code of the export**, so load an export only if you trust its origin.

        The library is ``lib<prefix>.so`` in the folder of the manifest.  If the library is missing, this method
        **builds the library in this folder** with the compiler of the user (``$CC``, cc, gcc or clang).  If the
        folder has a file with the SHA-256 of the library, the hash must agree.  The library must contain the hash of
        this manifest, and must reproduce the reference values of the manifest.

        Args:
            path: The folder of the export, or its ``<prefix>.json``.
            robot: If given, the export must be for this robot model.
            frame: The contact frame; by default, the first frame of the export.
            free: Ignore the supports of the robot; no effect if the export has no supports.

        Raises:
            SpecError: The export does not exist or is damaged.
            ManifestMismatch: The robot, the joint order or a convention of the export differs, or the library belongs
                to another manifest.  The error names the first difference.
            FrameNotFound: The export has no such frame.  The error lists the frames of the export.
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
        """Return an object with the same functions and separate buffers, for use in another thread."""
        return ImpactGradient(self._library, self.manifest, self.frame, free=self.free)

    @checked
    def check_robot(self, robot: Robot) -> None:
        """Check that the export is for this robot; a different joint model is allowed.

        Raises:
            ManifestMismatch: The export is for another robot; the error names the first difference.
        """
        # Import here, because only this method needs Pinocchio.
        from impact_posture.robot.joint_model import with_joint_model

        joints = self.manifest["joint_model"]
        check_robot(self.manifest, robot if joints == robot.joint_model else with_joint_model(robot, joints))

    def call(self, name: str, q: ArrayLike, n: ArrayLike | None = None) -> tuple[int, tuple[Array, ...]]:
        """Call a C function of :data:`~impact_posture.codegen.export_functions.SIGNATURES`.

        ``q`` has shape (nq,).  ``n`` is the unit normal out of the surface, shape (3,), in the axes that the key
        ``normal_frame`` of the manifest names.  Return the error code of the function, and views of its results.
        Views are returned even if the code is not zero.

        Raises:
            ValueError: An input has the wrong shape.
        """
        function, results = self._functions[name]
        # Check the length, because NumPy would broadcast an array with one number to all joints.
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
        """Call a C function and return views of its results; raise an error if the C function reports one."""
        code, results = self.call(name, q, n)
        if code:
            raise _failure(code)
        return results

    def value_and_gradient(self, q: ArrayLike, n: ArrayLike) -> tuple[float, Array]:
        """Return ``H`` and its tangent gradient, a view of shape (nv,), at ``q`` and ``n`` (see :meth:`call`)."""
        # Control loops call this method in every tick, so it does not use the slower self._results.
        code, (H, gradient) = self.call("eval", q, n)
        if code:
            raise _failure(code)
        return H.item(), gradient

    def objective(self, q: ArrayLike) -> tuple[float, Array]:
        """Return the objective for the normal of the export, and its tangent gradient, a view of shape (nv,)."""
        value, gradient = self._results("objective", q)
        return value.item(), gradient

    def value(self, q: ArrayLike, n: ArrayLike) -> float:
        """Return ``H`` without its gradient."""
        return float(self._results("value", q, n)[0].item())

    def jump(self, q: ArrayLike, n: ArrayLike) -> tuple[Array, float, float]:
        """Return ``a = M⁻¹Jᵀn``, a view of shape (nv,), ``G = nᵀJa`` (1/kg) and ``V = H/G²``."""
        a, G, V = self._results("jump", q, n)
        return a, G.item(), V.item()

    def ellipsoid(self, q: ArrayLike) -> Array:
        """Return ``Λ_c`` in world axes, a view of shape (3, 3)."""
        return self._results("ellipsoid", q)[0].reshape(3, 3)

    def value_and_gradient_batch(
        self, q: ArrayLike, n: ArrayLike, out: tuple[Array, Array] | None = None, *, threads: int = 1
    ) -> tuple[Array, Array]:
        """Return ``H``, shape (N,), and tangent gradients, shape (N, nv), for N configurations.

        ``q`` has shape (N, nq).  ``n`` has shape (N, 3), or (3,) if all configurations have the same normal.  ``out``
        can provide two contiguous arrays of type :attr:`dtype` for the results; by default, new arrays are returned.
        If a configuration is invalid, its rows are NaN; the rows of all other configurations are valid.  The rows are
        divided among ``threads`` threads.

        Raises:
            InputError: A shape or a type is wrong.
        """
        q, n = np.ascontiguousarray(q, dtype=self.dtype), np.asarray(n, dtype=self.dtype)
        self.check_shapes(q, n)
        n = np.ascontiguousarray(np.broadcast_to(n, (len(q), 3)))
        return self._batch("eval", (q, n), out, threads)

    def objective_batch(
        self, q: ArrayLike, out: tuple[Array, Array] | None = None, *, threads: int = 1
    ) -> tuple[Array, Array]:
        """Return the objective, shape (N,), and its tangent gradients, as in :meth:`value_and_gradient_batch`.

        Raises:
            InputError: A shape or a type is wrong.
            SpecError: An earlier version wrote the export, which therefore lacks this function.
        """
        q = np.ascontiguousarray(q, dtype=self.dtype)
        self.check_shapes(q)
        return self._batch("objective", (q,), out, threads)

    def batch_function(self, name: str) -> Any:
        """Return the C function for batches of ``eval`` or ``objective``.

        Raises:
            SpecError: An earlier version wrote the export, which therefore lacks this function.
        """
        if name not in self._batches:
            raise SpecError(f"has no {name}_batch", where=str(self.manifest["prefix"]), hint="run codegen again")
        return self._batches[name]

    def check_shapes(self, q: Array, n: Array | None = None) -> None:
        """Raise ``InputError`` unless ``q`` has shape (N, nq), and ``n`` has shape (3,) or (N, 3)."""
        if q.ndim != 2 or q.shape[1] != self.nq:
            raise InputError(f"has shape {q.shape}", where="q", hint=f"give shape (N, {self.nq})")
        if n is not None and n.shape not in ((3,), (len(q), 3)):
            raise InputError(f"has shape {n.shape}", where="n", hint=f"give shape (3,) or ({len(q)}, 3)")

    def _batch(
        self, name: str, inputs: tuple[Array, ...], out: tuple[Array, Array] | None, threads: int
    ) -> tuple[Array, Array]:
        count, call = len(inputs[0]), self.batch_function(name)
        value, grad = (np.empty(count, self.dtype), np.empty((count, self.nv), self.dtype)) if out is None else out
        for array, shape in ((value, (count,)), (grad, (count, self.nv))):
            if array.shape != shape or array.dtype != self.dtype or not array.flags.carray:
                hint = f"give contiguous arrays of {self.dtype}, shapes ({count},) and ({count}, {self.nv})"
                raise InputError(f"has shape {array.shape} of {array.dtype}", where="out", hint=hint)

        def part(first: int, last: int) -> None:
            arrays = [ctypes.c_void_p(array[first:last].ctypes.data) for array in (*inputs, value, grad)]
            call(*arrays[: len(inputs)], ctypes.c_int(last - first), *arrays[len(inputs) :])

        # Each thread computes one contiguous part.  The threads run in parallel, because ctypes releases the
        # interpreter lock during a call.
        bounds = np.linspace(0, count, max(1, min(threads, count // _LEAST_ROWS)) + 1).astype(int)
        if len(bounds) == 2:
            part(0, count)
        else:
            with ThreadPoolExecutor(len(bounds) - 1) as pool:
                list(pool.map(part, bounds[:-1], bounds[1:]))
        return value, grad

    def _self_test(self, where: str) -> None:
        test = self._reference
        H, grad = self.value_and_gradient(test["q"], test["n"])
        values, expected = np.array([H, *grad]), np.array([test["H"], *test["grad"]])
        difference = float(np.abs(values - expected).max() / np.abs(expected).max())
        # The test is "not <=" instead of ">", because ">" is False for NaN.
        if not difference <= _SELF_TEST[self.manifest["real"]]:
            hint = "delete the library, so that it is built again"
            raise ManifestMismatch("reference value of H", test["H"], H, where=where, hint=hint)


def _failure(code: int) -> Exception:
    if code == 1:
        return InputError("is not finite", where="q or n", hint="correct the measurement")
    if code == 2:
        what = "a quaternion or cosine-sine pair is not of unit norm"
        return PostureError(what, where="q", hint="normalize it")
    return MetricError("is not finite", where="the result", hint="the quantity does not exist at this posture")
