"""Open regular files, and read text files of limited length."""

from __future__ import annotations

import errno
import os
import stat
from io import BufferedReader, TextIOWrapper
from pathlib import Path

# Largest number of characters in a file.  The result of a long search, the largest file that this package writes, has
# about a million characters.
MOST_CHARACTERS = 1 << 26
# Largest file that is read into memory at once, bytes.
MOST_BYTES = 1 << 30


def open_regular(path: Path) -> BufferedReader:
    """Open a regular file for reading, because a pipe may never open, and a device may have no end.

    The null device is opened too, because it is a usual name for an empty file.

    Raises:
        OSError: The file cannot be opened, or is not a regular file.
    """
    # Without O_NONBLOCK, opening a pipe waits until another process writes into the pipe.
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode) or os.path.samefile(path, os.devnull):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    raise OSError(errno.EINVAL, "it is a pipe or a device, not a regular file", str(path))


def read_bytes(path: Path) -> bytes:
    """Return the content of a regular file.

    Raises:
        OSError: The file cannot be read, or is larger than :data:`MOST_BYTES`.
    """
    with open_regular(path) as file:
        if os.fstat(file.fileno()).st_size > MOST_BYTES:
            raise OSError(errno.EFBIG, os.strerror(errno.EFBIG), str(path))
        return file.read()


def read_text(path: Path) -> str:
    """Return the content of a regular UTF-8 file.

    Raises:
        OSError: The file cannot be read, or is larger than :data:`MOST_CHARACTERS`.
        UnicodeDecodeError: The file is not UTF-8.
    """
    # Some editors write a byte-order mark at the start.
    with TextIOWrapper(open_regular(path), encoding="utf-8-sig") as file:
        text = file.read(MOST_CHARACTERS + 1)
    if len(text) > MOST_CHARACTERS:
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG), str(path))
    return text
