"""Read NPZ files from users, with a limit on memory."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from impact_posture.system.text_files import open_regular

if TYPE_CHECKING:
    from numpy.typing import NDArray

# Largest size of the arrays in a file, bytes: enough for a run of an hour at 1 kHz.
MOST_BYTES = 1 << 32


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
        raise ValueError(f"{path.name} states more numbers than it has") from None
    except (BadZipFile, EOFError, RuntimeError, zlib.error) as error:
        # A RuntimeError means that the file has another compression or a password.
        raise ValueError(f"{path.name} is damaged: {error}") from None
    # NumPy returns bytes if an entry of the file is not an array.
    if strange := [name for name, array in arrays.items() if not isinstance(array, np.ndarray)]:
        raise ValueError(f"'{strange[0]}' of {path.name} is not an array")
    return arrays
