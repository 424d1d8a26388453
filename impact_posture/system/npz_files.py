"""Read NPZ files from users, with a limit on memory."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from impact_posture.system.text_files import open_regular

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

# Largest size of the arrays in a file, bytes: enough for a run of an hour at 1 kHz.
MOST_BYTES = 1 << 32
# Largest magnitude of a number in a file, because squares of larger numbers overflow.
_LARGEST = 1e100


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of an NPZ file.

    Raises:
        OSError: The file cannot be read, or its arrays are larger than :data:`MOST_BYTES`.
        ValueError: The file is not an NPZ file, is damaged, or contains fewer numbers than its header states.
    """
    # Import these modules here, because they slow down ``--help``.
    import zlib
    from zipfile import BadZipFile

    import numpy as np

    try:
        with open_regular(path) as stream:
            file = np.load(stream, allow_pickle=False)
            if isinstance(file, np.ndarray):
                raise ValueError(f"{path.name} holds an array without a name")
            if sum(entry.file_size for entry in file.zip.infolist()) > MOST_BYTES:
                raise OSError(errno.EFBIG, os.strerror(errno.EFBIG), str(path))
            arrays = {name: file[name] for name in file.files}
    except MemoryError:
        # The header of a small file may state any size.
        raise ValueError(f"{path.name} states more numbers than it contains") from None
    except (BadZipFile, EOFError, RuntimeError, zlib.error) as error:
        # A RuntimeError means that the file has another compression or a password.
        raise ValueError(f"{path.name} is damaged: {error}") from None
    # NumPy returns bytes if an entry of the file is not an array.
    if strange := [name for name, array in arrays.items() if not isinstance(array, np.ndarray)]:
        raise ValueError(f"'{strange[0]}' of {path.name} is not an array")
    return arrays


def fitting_arrays(
    arrays: Mapping[str, NDArray[Any]], prefix: str, shapes: Mapping[str, str], **sizes: int
) -> dict[str, NDArray[Any]]:
    """Return the arrays named in ``shapes``, without their ``prefix``, after a check that their shapes agree.

    Args:
        arrays: Arrays of a file.
        prefix: First characters of the names in the file.
        shapes: Name → kind of the numbers and names of the dimensions, such as ``"real n nq"``.  Dimensions
            with the same name must have the same size.  The kinds are ``real`` (finite), ``float`` (also
            NaN or inf), ``bool``, and ``index``, an index along the dimension ``n``.
        sizes: Known sizes of dimensions.

    Raises:
        ValueError: An array is missing, is empty, has another shape or type, or contains numbers of another kind.
    """
    import numpy as np

    for name, form in shapes.items():
        if prefix + name not in arrays:
            raise ValueError(f"the array '{prefix}{name}' is missing")
        array, (kind, *dimensions) = arrays[prefix + name], form.split()
        wanted = [sizes.setdefault(d, size) for d, size in zip(dimensions, array.shape, strict=False)]
        fits = len(dimensions) == array.ndim and wanted == list(array.shape) and array.size > 0
        fits = fits and array.dtype.kind in {"bool": "b", "index": "iu"}.get(kind, "fiu")
        if fits and kind in ("real", "float"):
            limited = np.abs(array) <= _LARGEST
            fits = bool((limited if kind == "real" else limited | ~np.isfinite(array)).all())
        elif fits and kind == "index":
            fits = 0 <= array.min() and array.max() < sizes["n"]
        if not fits:
            raise ValueError(f"the array '{prefix}{name}' does not fit the others or the robot")
    return {name: arrays[prefix + name] for name in shapes}
