"""The seal of an exported folder: the size and checksum of each of its files, and a checksum over them all.

In: a folder that ``vecenv compile`` wrote. Out: ``seal.json``, written last; when the folder is opened, an error names
a file that is missing, that is none of the export's, or that has another size or, once it is read, other contents. The
seal is removed before anything else is changed, so a folder without one is an export that was interrupted. Names that
begin with a dot are nobody's: they are neither sealed nor read.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from vecenv.errors import InvalidFile
from vecenv.util import caching

SEAL = "seal.json"
FORMAT = 1
# Files that exports write.
_OURS = re.compile(
    r"index\.json|budgets\.json|starts/\w+\.npz|scenes/[0-9a-f]{64}\.(mjb|json)|"
    r"images/(index\.json|[0-9a-f]{64}\.json|pieces/[0-9a-f]{64})"
)
# Files that are read, and so checked, whenever the folder is opened.
_SMALL = ("index.json", "budgets.json", "images/index.json")


class SealError(InvalidFile):
    """A folder is not as it was when it was sealed; the message names the file."""


@dataclass(frozen=True)
class Seal:
    """A folder's files: path in the folder -> bytes, and SHA-256 in hexadecimal digits."""

    folder: Path
    files: Mapping[str, tuple[int, str]]

    def check(self, name: str) -> None:
        """Check a file's contents.

        Raises:
            SealError: it is none of the export's, cannot be read, or has other contents.
        """
        if name not in self.files:
            raise SealError(f"{self.folder / name}: not a part of the export that {SEAL} names")
        try:
            with (self.folder / name).open("rb") as file:
                found = hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as error:
            raise SealError(f"{self.folder / name}: cannot be read: {error.strerror}") from error
        if found != self.files[name][1]:
            raise SealError(f"{self.folder / name}: damaged: other contents than {SEAL} names")


def break_seal(folder: Path) -> None:
    """Remove the seal, before something in the folder changes."""
    (folder / SEAL).unlink(missing_ok=True)


def write_seal(folder: Path) -> None:
    """Seal what is in a folder.

    Raises:
        SealError: it holds a file that no export writes.
        OSError: a file cannot be read, or the seal not be written.
    """
    files: dict[str, tuple[int, str]] = {}
    for name in sorted(_names(folder)):
        if not _OURS.fullmatch(name):
            raise SealError(f"{folder / name}: not a file of an export; move it elsewhere")
        with (folder / name).open("rb") as file:
            files[name] = (folder / name).stat().st_size, hashlib.file_digest(file, "sha256").hexdigest()
    seal = {"format": FORMAT, "sha256": _checksum(files), "files": files}
    caching.write_file(folder / SEAL, json.dumps(seal, indent=1).encode())


def open_seal(folder: Path) -> Seal:
    """The seal of a folder, whose files are those it names, of those sizes.

    Raises:
        SealError: there is none, it is damaged, or a file is missing, of another size, or none of the export's.
    """
    path = folder / SEAL
    try:
        stored = json.loads(path.read_bytes())
        files = {str(name): (int(size), str(digest)) for name, (size, digest) in stored["files"].items()}
        sound = stored["format"] == FORMAT and stored["sha256"] == _checksum(files)
    except FileNotFoundError as error:
        raise SealError(f"{path}: missing: the export was interrupted, or is an older vecenv's") from error
    except OSError as error:
        raise SealError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise SealError(f"{path}: damaged: not the seal of an export") from error
    if not sound:
        raise SealError(f"{path}: damaged: its checksum is not that of what it names, or its layout is another")
    there = set(_names(folder))
    for name in sorted(set(files) - there):
        raise SealError(f"{folder / name}: missing")
    for name in sorted(there - set(files)):
        raise SealError(f"{folder / name}: not a part of the export that {SEAL} names; move it elsewhere")
    for name, (size, _) in files.items():
        if (folder / name).stat().st_size != size:
            raise SealError(f"{folder / name}: damaged: another size than {SEAL} names")
    seal = Seal(folder, files)
    for name in _SMALL:
        if name in files:
            seal.check(name)
    return seal


def _names(folder: Path) -> Iterator[str]:
    """Paths of a folder's files in it, but for the seal and for names that begin with a dot."""
    for path in folder.rglob("*"):
        inside = path.relative_to(folder)
        if not path.is_dir() and inside.as_posix() != SEAL and not any(part.startswith(".") for part in inside.parts):
            yield inside.as_posix()


def _checksum(files: Mapping[str, tuple[int, str]]) -> str:
    return hashlib.sha256(json.dumps(sorted((name, *each) for name, each in files.items())).encode()).hexdigest()
