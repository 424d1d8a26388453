"""Read text files of limited length."""

from __future__ import annotations

import errno
import os
from pathlib import Path

# Largest number of characters in a file.  The result of a long search, the largest file that this package writes, has
# about a million characters.
MOST_CHARACTERS = 1 << 26


def read_text(path: Path) -> str:
    """Return the content of a UTF-8 file; raise an error for an endless device such as ``/dev/zero``.

    Raises:
        OSError: The file cannot be read, or is larger than :data:`MOST_CHARACTERS`.
        UnicodeDecodeError: The file is not UTF-8.
    """
    # Some editors write a byte-order mark at the start.
    with path.open(encoding="utf-8-sig") as file:
        text = file.read(MOST_CHARACTERS + 1)
    if len(text) > MOST_CHARACTERS:
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG), str(path))
    return text
