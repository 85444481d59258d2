"""The folder that vecenv caches files in, and writing files there.

The folder is the user's cache folder (``~/.cache/vecenv`` on Linux). ``VECENV_CACHE_DIR`` names another one; set to
nothing, it turns the cache off. Deleting the folder is safe at any time, and any number of processes may share it.
"""

from __future__ import annotations

import hashlib
import logging
import os
import uuid
from pathlib import Path

import platformdirs

VARIABLE = "VECENV_CACHE_DIR"
log = logging.getLogger(__name__)
_DIGEST = hashlib.sha256().digest_size


def folder(kind: str) -> Path | None:
    """Where files of a kind (``"scenes"``, ``"budgets"``, ...) are cached; None when the cache is off.

    The folder may not exist yet.
    """
    chosen = os.environ.get(VARIABLE)
    if chosen is not None:
        return Path(chosen).expanduser() / kind if chosen else None
    default = platformdirs.user_cache_path("vecenv") / kind
    return default if default.is_absolute() else None  # "~" stays in it for a user without a home


def sealed(data: bytes) -> bytes:
    """Data after its SHA-256, as a file of a cache; ``unsealed`` reads it."""
    return hashlib.sha256(data).digest() + data


def unsealed(path: Path) -> bytes | None:
    """The data of a file that ``sealed`` made; None if there is none, or a damaged one, which a warning names."""
    try:
        stored = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        damaged(path, str(error.strerror))
        return None
    digest, data = stored[:_DIGEST], stored[_DIGEST:]
    if hashlib.sha256(data).digest() != digest:
        damaged(path, "its checksum is another")
        return None
    return data


def damaged(path: Path, why: str) -> None:
    """Warn that a file of a cache cannot be used, and that it is made again."""
    log.warning("%s: cannot be used (%s); it is made again", path, why)


def write_file(path: Path, data: bytes) -> None:
    """Write a file so that other processes see the old one, the new one or none, never a part.

    Raises:
        OSError: it cannot be written.
    """
    partial = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        partial.write_bytes(data)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
