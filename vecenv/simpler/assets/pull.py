"""Filling the asset tree: from ManiSkill2_real2sim's repository, from three archives, from a folder, or from a mirror.

In: a folder and, optionally, one source. Out: the files of the manifest, each verified before it gets its name, and a
``Report`` of what was fetched, what was there, and what is missing. A server that cannot be reached is given up early.
Files are identified by their content, never by the name under which a source offers them. Downloads are in
``download.py``, archives in ``archives.py``.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import shutil
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Protocol, TypeAlias
from urllib.parse import quote

import httpx

from vecenv.simpler.assets import files as assets
from vecenv.simpler.assets.archives import DAMAGE, Members, copy_at_most, is_archive, open_archive
from vecenv.simpler.assets.download import ExpectedContent, RetryPolicy, download, make_client, opened
from vecenv.simpler.assets.errors import FileNotInSource, PullError, ServerUnreachable, TransferError, reason
from vecenv.simpler.assets.files import Entry, Manifest, read_manifest

# Bytes; for files whose size is not known, and for archives.
_MAX_FILE, _MAX_ARCHIVE = 1 << 29, 1 << 33
_THREADS = 8
# After so many files in a row for which there is no connection, a server counts as unreachable.
_MAX_UNREACHABLE = 3
_PARTIAL_FOLDER = ".partial"


@dataclass(frozen=True, kw_only=True)
class Archive:
    """An archive on the web.

    Attributes:
        url: its address.
        hosts: hosts that the server may redirect to, with their subdomains.
        holds: prefixes of the paths in the tree that the archive may have.
        sha256: of the archive, "" where its publisher gives none; its files are verified in any case.
    """

    url: str
    hosts: tuple[str, ...]
    holds: tuple[str, ...]
    sha256: str = ""


REPOSITORY = "https://raw.githubusercontent.com/simpler-env/ManiSkill2_real2sim/{commit}/"
_GITHUB = ("github.com", "githubusercontent.com")
# As mani-skill 3.0.1 names them in mani_skill/utils/assets/data.py.
ARCHIVES = (
    Archive(
        url="https://huggingface.co/datasets/haosulab/ManiSkill_bridge_v2_real2sim/resolve/main/"
        "bridge_v2_real2sim_dataset.zip",
        hosts=("huggingface.co", "hf.co"),
        holds=("data/",),
        sha256="618512a205b4528cafecdad14b1788ed1130879f3064deb406516ed5b9c5ba92",
    ),
    Archive(
        url="https://github.com/haosulab/ManiSkill-WidowX250S/archive/refs/tags/v0.2.0.zip",
        hosts=_GITHUB,
        holds=("mani_skill2_real2sim/assets/descriptions/widowx_description/",),
    ),
    Archive(
        url="https://github.com/haosulab/ManiSkill-GoogleRobot/archive/refs/tags/v0.1.0.zip",
        hosts=_GITHUB,
        holds=("mani_skill2_real2sim/assets/descriptions/googlerobot_description/",),
    ),
)


@dataclass(frozen=True)
class Report:
    """Result of ``pull``.

    Attributes:
        root: the tree.
        fetched: files that were fetched.
        kept: files that were there and intact.
        missing: path -> why the file could not be fetched.
        stand_ins: notes about stand-ins for missing files.
        wanting: missing files that have no stand-in and that are needed.
    """

    root: Path
    fetched: tuple[PurePosixPath, ...]
    kept: tuple[PurePosixPath, ...]
    missing: dict[PurePosixPath, str] = field(default_factory=dict)
    stand_ins: tuple[str, ...] = ()
    wanting: tuple[PurePosixPath, ...] = ()

    @property
    def complete(self) -> bool:
        """Whether every file is there, has a stand-in, or is only used by a file that is missing too."""
        return not self.wanting

    def lines(self) -> list[str]:
        """The report as text: counts, stand-ins of missing files, and which needed files are missing and why."""
        counts = f"{len(self.fetched)} files fetched, {len(self.kept)} were there, {len(self.missing)} missing"
        reasons = [f"missing: {path}: {self.missing[path]}" for path in self.wanting]
        return [f"{self.root}: {counts}", *(f"note: {note}" for note in self.stand_ins), *reasons]


def pull(
    root: Path,
    source: str | None = None,
    *,
    manifest: Manifest | None = None,
    retry: RetryPolicy | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Report:
    """Fill a folder with the manifest's files.

    Args:
        root: the folder; created if it does not exist.
        source: a folder in the tree's layout, an archive (.zip, .tar, .tar.gz, .tar.xz), or the web address of
            either; the repository and the known archives by default.
        manifest: files to fetch; the package's own list by default.
        retry: timeouts and retries.
        progress: called with the number of finished files and of all files.

    Raises:
        PullError: the source does not exist, the folder cannot be written, or another pull is filling it.
        ManifestError: the manifest is damaged.
    """
    if source is not None and not source.strip():
        raise PullError(f"source={source!r}: expected a folder, an archive or a web address")
    wanted = manifest or read_manifest()
    try:
        root.mkdir(parents=True, exist_ok=True)
        with _locked(root):
            return _Pull(root, wanted, retry or RetryPolicy(), progress).run(source)
    except OSError as error:
        raise PullError(f"{root}: {error}") from error


@contextlib.contextmanager
def _locked(root: Path) -> Iterator[None]:
    folder = root / _PARTIAL_FOLDER
    if folder.is_symlink():
        raise PullError(f"{folder} is a link; partial downloads are not written through it: remove it")
    folder.mkdir(exist_ok=True)
    with opened(folder / "lock", "wb") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise PullError(f"{root} is being filled by another process") from None
        yield
    if not any(folder.glob("*.part")):
        shutil.rmtree(folder, ignore_errors=True)


class _Pull:
    """One run."""

    def __init__(
        self, root: Path, manifest: Manifest, policy: RetryPolicy, progress: Callable[[int, int], None]
    ) -> None:
        self.root = root
        self.manifest = manifest
        self.policy = policy
        self.progress = progress
        self.missing: dict[PurePosixPath, str] = {}
        self._finished = 0
        self._lock = threading.Lock()

    def run(self, source: str | None) -> Report:
        targets = {entry: self._target(entry) for entry in self.manifest.files}
        kept = {entry for entry, target in targets.items() if entry.matches(target)}
        self._count(len(kept))
        wanted = [entry for entry in targets if entry not in kept]
        with make_client(self.policy) as client:
            if source is None:
                rest = self._from_known_sources(client, wanted)
            else:
                rest = self._from_source(client, source, wanted)
        fetched = [entry.path for entry in wanted if entry not in rest]
        missing = {entry.path: self.missing.get(entry.path, "no source has it") for entry in rest}
        notes = {path: note for path in missing if (note := assets.stand_in_note(path, self.root))}
        wanting = [entry.path for entry in rest if entry.path not in notes and entry.used_by not in missing]
        kept_paths = tuple(entry.path for entry in targets if entry in kept)
        return Report(self.root, tuple(fetched), kept_paths, missing, tuple(notes.values()), tuple(wanting))

    def _from_known_sources(self, client: httpx.Client, wanted: Sequence[Entry]) -> list[Entry]:
        base = REPOSITORY.format(commit=self.manifest.commit)
        rest = self._take(WebFolder(client, base, self._partial, self.policy), wanted)
        for archive in ARCHIVES:
            if any(str(entry.path).startswith(archive.holds) for entry in rest):
                rest = self._from_web_archive(client, archive, rest)
        return rest

    def _from_source(self, client: httpx.Client, source: str, wanted: Sequence[Entry]) -> list[Entry]:
        if source.startswith(("http://", "https://")):
            if is_archive(httpx.URL(source).path):
                return self._from_web_archive(client, Archive(url=source, hosts=(), holds=("",)), wanted)
            base = source if source.endswith("/") else source + "/"
            return self._take(WebFolder(client, base, self._partial, self.policy), wanted)
        path = Path(source).expanduser()
        if path.is_dir():
            return self._take(Folder(path, self._partial), wanted)
        if not path.is_file():
            raise PullError(f"{source!r} is neither a folder, a file nor a web address")
        return self._from_archive(path, wanted, str(path))

    def _from_web_archive(self, client: httpx.Client, archive: Archive, wanted: Sequence[Entry]) -> list[Entry]:
        part = self._partial(hashlib.sha256(archive.url.encode()).hexdigest())
        expected = ExpectedContent(sha256=archive.sha256, max_bytes=_MAX_ARCHIVE)
        try:
            download(client, archive.url, part, expected, hosts=archive.hosts, policy=self.policy)
            rest = self._from_archive(part, wanted, archive.url)
        except (FileNotInSource, TransferError) as error:
            return self._refused(wanted, f"{archive.url}: {error}")
        except PullError as error:
            rest = self._refused(wanted, str(error))
        part.unlink(missing_ok=True)
        return rest

    def _refused(self, wanted: Sequence[Entry], why: str) -> list[Entry]:
        for entry in wanted:
            self._remember(entry, why)
        return list(wanted)

    def _from_archive(self, path: Path, wanted: Sequence[Entry], name: str) -> list[Entry]:
        with open_archive(path, name, self.root / _PARTIAL_FOLDER) as members:
            return self._take(OpenArchive(name, members, self._partial), wanted, threads=1)

    def _take(self, source: Source, wanted: Sequence[Entry], threads: int = _THREADS) -> list[Entry]:
        """Fetch files from a source; returns those that it does not have. Equal contents are fetched once."""
        by_content: dict[str, list[Entry]] = {}
        for entry in wanted:
            by_content.setdefault(entry.key, []).append(entry)
        with ThreadPoolExecutor(threads) as pool:
            results = pool.map(lambda entries: self._take_content(source, entries), by_content.values())
            found = dict(zip(by_content, results, strict=True))
        return [entry for entry in wanted if not found[entry.key]]

    def _take_content(self, source: Source, entries: Sequence[Entry]) -> bool:
        """Fetch one content from a source that may have it at any of the entries' paths."""
        for entry in entries:
            try:
                part = source.fetch(entry)
            except (FileNotInSource, TransferError) as error:
                self._remember(entry, str(error))
            else:
                self._put(part, entries)
                return True
        return False

    def _put(self, part: Path, entries: Sequence[Entry]) -> None:
        copy = part.with_suffix(".copy")
        for entry in entries:
            target = self._target(entry)
            target.parent.mkdir(parents=True, exist_ok=True)
            _copy(part, copy)
            copy.replace(target)
        part.unlink()
        self._count(len(entries))

    def _target(self, entry: Entry) -> Path:
        """Where a file goes; links in the tree must not lead out of it."""
        target = self.root / assets.safe_path(str(entry.path))
        folder = target.parent.resolve()
        if not folder.is_relative_to(self.root.resolve()):
            raise PullError(f"{entry.path}: a link in {self.root} leads out of it, to {folder}")
        return target

    def _partial(self, key: str) -> Path:
        return self.root / _PARTIAL_FOLDER / f"{key}.part"

    def _remember(self, entry: Entry, why: str) -> None:
        with self._lock:
            earlier = self.missing.get(entry.path)
            self.missing[entry.path] = f"{earlier}; {why}" if earlier else why

    def _count(self, number: int) -> None:
        with self._lock:
            self._finished += number
            self.progress(self._finished, len(self.manifest.files))


def _copy(source: Path, to: Path) -> None:
    """Copy a file, of at most ``_MAX_FILE`` bytes, and not through a link."""
    with source.open("rb") as stream, opened(to, "wb") as file:
        copy_at_most(stream, file, _MAX_FILE)


# ---------------------------------------------------------------------------------------------------------------------
# Sources.

_PartialFile: TypeAlias = Callable[[str], Path]


class Source(Protocol):
    """A place that files are fetched from."""

    def fetch(self, entry: Entry) -> Path:
        """A verified copy of a file, for the caller to move.

        Raises:
            FileNotInSource: the source does not have it.
            TransferError: the transfer failed.
        """
        ...


class Folder:
    """A folder in the tree's layout."""

    def __init__(self, root: Path, partial: _PartialFile) -> None:
        self._root, self._partial = root, partial

    def fetch(self, entry: Entry) -> Path:
        """See ``Source.fetch``."""
        found = self._root / entry.path
        if not found.is_file():
            raise FileNotInSource(f"not in {self._root}")
        part = self._partial(entry.key)
        _copy(found, part)
        if not entry.matches(part):
            part.unlink()
            raise FileNotInSource(f"{found} has other content than the manifest says")
        return part


class OpenArchive:
    """The members of an archive, identified by their content; their folders do not matter."""

    def __init__(self, name: str, members: Members, partial: _PartialFile) -> None:
        self._name, self._members, self._partial = name, members, partial

    def fetch(self, entry: Entry) -> Path:
        """See ``Source.fetch``."""
        part = self._partial(entry.key)
        for member in self._members.named(entry.path.name, entry.size, _MAX_FILE):
            try:
                with member.open() as stream, opened(part, "wb") as file:
                    copy_at_most(stream, file, min(member.size, _MAX_FILE))
            except DAMAGE as error:
                part.unlink(missing_ok=True)
                raise FileNotInSource(f"damaged in {self._name}: {reason(error)}") from error
            if entry.matches(part):
                return part
            part.unlink()
        raise FileNotInSource(f"not in {self._name}")


class WebFolder:
    """A web address below which files lie as in the tree."""

    def __init__(self, client: httpx.Client, base: str, partial: _PartialFile, policy: RetryPolicy) -> None:
        self._client, self._base, self._partial, self._policy = client, base, partial, policy
        self._unreachable = 0

    def fetch(self, entry: Entry) -> Path:
        """See ``Source.fetch``."""
        if self._unreachable >= _MAX_UNREACHABLE:
            raise ServerUnreachable(f"{httpx.URL(self._base).host} cannot be reached")
        part, url = self._partial(entry.key), self._base + quote(str(entry.path))
        expected = ExpectedContent(entry=entry, max_bytes=entry.size or _MAX_FILE)
        try:
            download(self._client, url, part, expected, policy=self._policy)
        except ServerUnreachable:
            self._unreachable += 1
            raise
        self._unreachable = 0
        return part
