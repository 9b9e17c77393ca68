"""Authentication of LCM messages with a key that both sides have in a file; neither Drake nor LCM is needed for it."""

from __future__ import annotations

import hashlib
import os
import secrets
import stat
from pathlib import Path

from dvrk_drake.errors import KeyFileError
from dvrk_drake.models.files import open_input

#: Shortest and longest key, length of a new one [bytes]; BLAKE2b has no longer keys.
_SHORTEST, _LONGEST, _NEW = 16, 64, 32
#: Length of a message authentication code [bytes].
MAC_SIZE = 16
#: A message without a code ends with its size, zero; one with a code ends with this and the code.
_EMPTY, _SIZE = b"\0", bytes([MAC_SIZE])


class MessageKey:
    """Key that signs and verifies encoded messages: keyed BLAKE2b with a digest of 16 bytes.

    The last two fields of a message are `mac_size` and `mac`. The code covers all bytes before them: the type's
    fingerprint, session, sequence, time and content.
    """

    def __init__(self, key: bytes) -> None:
        """Key of 16 to 64 bytes.

        Raises:
            KeyFileError: the key is shorter or longer.
        """
        if not _SHORTEST <= len(key) <= _LONGEST:
            raise KeyFileError(f"a key has {_SHORTEST} to {_LONGEST} bytes; this one has {len(key)}")
        self._hash = hashlib.blake2b(key=key, digest_size=MAC_SIZE)

    @classmethod
    def load(cls, path: str | Path) -> MessageKey:
        """Key whose bytes are the content of the file at `path`.

        Raises:
            KeyFileError: no such file, other users may access it, or it is too short or too long.
        """
        with open_input(path, KeyFileError) as file:
            mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
            if mode & (stat.S_IRWXG | stat.S_IRWXO):
                raise KeyFileError(f"{path}: other users may access this key (mode {mode:04o}); run: chmod 600 {path}")
            key = file.read(_LONGEST + 1) or b""
        try:
            return cls(key)
        except KeyFileError as error:
            more = "more" if len(key) > _LONGEST else str(len(key))
            raise KeyFileError(
                f"{path}: not a key of {_SHORTEST} to {_LONGEST} bytes, it has {more}; make one: dvrk-drake key FILE"
            ) from error

    def sign(self, data: bytes) -> bytes:
        """Returns the encoded message `data`, which has no code yet, with its code."""
        content = data[: -len(_EMPTY)]
        return content + _SIZE + self._mac(content)

    def verify(self, data: bytes) -> bool:
        """Returns whether `data` ends with the code of the bytes before it."""
        content, size, mac = data[: -MAC_SIZE - 1], data[-MAC_SIZE - 1 : -MAC_SIZE], data[-MAC_SIZE:]
        return size == _SIZE and secrets.compare_digest(self._mac(content), mac)

    def _mac(self, content: bytes) -> bytes:
        state = self._hash.copy()
        state.update(content)
        return state.digest()


def create_key_file(path: str | Path) -> None:
    """Writes a random key of 32 bytes to a new file that only its owner may read and write.

    Raises:
        KeyFileError: the file exists, or it cannot be written.
    """
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    except FileExistsError as error:
        raise KeyFileError(f"{path}: exists already, and a key is not overwritten; name another file") from error
    except (OSError, ValueError) as error:
        raise KeyFileError(f"{path}: cannot be written: {getattr(error, 'strerror', None) or error}") from error
    with open(descriptor, "wb") as file:
        file.write(secrets.token_bytes(_NEW))
