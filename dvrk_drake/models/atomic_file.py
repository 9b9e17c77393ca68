"""Files that are written at once or not at all."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from dvrk_drake.errors import DvrkDrakeError

#: What the disk, not the caller's own code, may answer to a write.
_DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)


@contextmanager
def atomic_write(path: str | Path, mode: str = "w") -> Iterator[IO]:
    """A stream into a temporary file that replaces `path` if the block ends well, and vanishes if not.

    A link stays a link: what it points to is replaced. An existing file keeps its permissions.

    Args:
        path: the file to be.
        mode: "w" for text in UTF-8 without newline translation, or "wb".

    Raises:
        DvrkDrakeError: no such folder, the file cannot be written, or it is no regular file (/dev/null).
    """
    target = Path(os.path.realpath(path))
    exists = os.path.exists(target)
    if exists and not target.is_file():
        raise DvrkDrakeError(f"{path}: is not a regular file, so it cannot be replaced; name a file")
    if exists and not os.access(target, os.W_OK):
        raise DvrkDrakeError(f"{path}: cannot be written: it is read-only")
    permissions = target.stat().st_mode & 0o777 if exists else 0o666 & ~_umask()
    try:
        handle, temporary = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name[:100]}.")
    except OSError as error:
        raise DvrkDrakeError(f"{path}: cannot be written: {error.strerror}") from error
    text: dict[str, Any] = {} if "b" in mode else {"encoding": "utf-8", "newline": ""}
    try:
        with os.fdopen(handle, mode, **text) as stream:
            yield stream
        os.chmod(temporary, permissions)
        try:
            os.replace(temporary, target)
        except OSError as error:
            raise DvrkDrakeError(f"{path}: cannot be written: {error.strerror}") from error
    except BaseException as error:
        with suppress(FileNotFoundError):
            os.unlink(temporary)
        if isinstance(error, OSError) and error.errno in _DISK_ERRORS:
            raise DvrkDrakeError(f"{path}: cannot be written: {error.strerror}") from error
        raise


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
