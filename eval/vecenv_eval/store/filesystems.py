"""Whether a folder is on a local file system, where SQLite's write-ahead log works.

The log needs memory shared by all processes that use the database, which file systems over a network do not provide.
"""

from __future__ import annotations

import re
from pathlib import Path

# File systems of one machine, as Linux names them; every other one, unknown ones included, may be shared.
LOCAL = frozenset(
    {
        *("ext2", "ext3", "ext4", "xfs", "btrfs", "zfs", "f2fs", "bcachefs", "jfs", "reiserfs", "nilfs2"),
        *("tmpfs", "ramfs", "overlay", "vfat", "exfat", "ntfs3"),
    }
)
MOUNTS = Path("/proc/self/mounts")
UNKNOWN = "unknown"


def file_system(path: Path, mounts: Path = MOUNTS) -> str:
    """The type of the file system that a path is on, such as ``"ext4"`` or ``"nfs4"``.

    Args:
        path: a file or folder; what does not exist yet is where its parent is.
        mounts: the table of mounted file systems.

    Returns:
        ``"unknown"`` where there is no such table.
    """
    wanted = path.resolve()
    best, kind = -1, UNKNOWN
    try:
        lines = mounts.read_text(errors="surrogateescape").splitlines()
    except OSError:
        return UNKNOWN
    for fields in (line.split(" ") for line in lines):
        if len(fields) < 3:
            continue
        point = Path(_unescape(fields[1]))
        depth = len(point.parts)
        if wanted.is_relative_to(point) and depth >= best:  # of two on one place, the later hides the earlier
            best, kind = depth, fields[2]
    return kind


def is_local(kind: str) -> bool:
    """Whether a file system belongs to one machine."""
    return kind in LOCAL


def _unescape(text: str) -> str:
    r"""Spaces and the like are written as ``\040`` in the table."""
    return re.sub(r"\\([0-7]{3})", lambda match: chr(int(match[1], 8)), text)
