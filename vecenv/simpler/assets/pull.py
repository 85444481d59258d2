"""Filling the asset tree: from ManiSkill2_real2sim's repository, from three archives, from a folder, or from a mirror.

In: a folder and, if wanted, one source. Out: the files of the manifest, each verified before it gets its name, and a
``Report`` of what was fetched, what was there, and what is missing. Downloads that break off are continued, those that
turn out wrong are begun again, and both are tried a few times; a source that cannot be reached at all is given up
early. Content decides, never the name under which a source offers it: nothing is unpacked to a path that an archive
names, and a server may only redirect to hosts that its source is known to use.
"""

from __future__ import annotations

import bz2
import contextlib
import fcntl
import gzip
import hashlib
import lzma
import shutil
import tarfile
import tempfile
import threading
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import IO, Any, Protocol
from urllib.parse import quote

import httpx
import tenacity

from vecenv.errors import ServiceError
from vecenv.simpler.assets import files as assets
from vecenv.simpler.assets.files import Entry, Manifest, read_manifest

_CHUNK = 1 << 16
_MAX_REDIRECTS = 5
# For files whose size is not known, and for archives.
_LARGEST_FILE, _LARGEST_ARCHIVE = 1 << 29, 1 << 33
_THREADS = 8
# So many files in a row that a server does not deliver for want of a connection, and it counts as unreachable.
_PATIENCE = 3
_PARTIAL = ".partial"


class PullError(ServiceError):
    """The folder or the source cannot be used; the message says why."""


class NotThere(ServiceError):
    """A source does not have a file, or refuses it; asking again is no use."""


class Broken(ServiceError):
    """A transfer broke off or brought the wrong content; asking again may help."""


class Unreachable(Broken):
    """No answer."""


@dataclass(frozen=True, kw_only=True)
class Patience:
    """How long to wait and how often to ask.

    Attributes:
        attempts: tries a file.
        connect: seconds for a connection.
        read: seconds without a byte.
        wait: seconds before the second try; doubled each time, at most thirty.
    """

    attempts: int = 5
    connect: float = 10.0
    read: float = 30.0
    wait: float = 0.5


@dataclass(frozen=True, kw_only=True)
class Archive:
    """An archive on the web.

    Attributes:
        url: where it is.
        hosts: where the server may redirect to: these hosts and what lies below them.
        holds: paths of the tree begin with one of these, for the archive to be worth asking.
        sha256: of the archive, "" where its publisher names none; its files are verified in any case.
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
    """What ``pull`` did.

    Attributes:
        root: the tree.
        fetched: files that were brought.
        kept: files that were there and intact.
        missing: path -> why it could not be had.
        stand_ins: notes of what stands in for missing files.
        wanting: missing files that nothing stands in for and that something needs.
    """

    root: Path
    fetched: tuple[PurePosixPath, ...]
    kept: tuple[PurePosixPath, ...]
    missing: dict[PurePosixPath, str] = field(default_factory=dict)
    stand_ins: tuple[str, ...] = ()
    wanting: tuple[PurePosixPath, ...] = ()

    @property
    def complete(self) -> bool:
        """Every file is there, or has a stand-in, or is only used by one that is missing too."""
        return not self.wanting

    def lines(self) -> list[str]:
        """The report as text: counts, what stands in for missing files, and which are missed and why."""
        counts = f"{len(self.fetched)} files fetched, {len(self.kept)} were there, {len(self.missing)} missing"
        reasons = [f"missing: {path}: {self.missing[path]}" for path in self.wanting]
        return [f"{self.root}: {counts}", *(f"note: {note}" for note in self.stand_ins), *reasons]


def pull(
    root: Path,
    source: str | None = None,
    *,
    manifest: Manifest | None = None,
    patience: Patience | None = None,
    notice: Callable[[int, int], None] = lambda done, total: None,
) -> Report:
    """Fill a folder with the manifest's files.

    Args:
        root: the folder; made when it is not there.
        source: a folder in the tree's layout, an archive (.zip, .tar, .tar.gz, .tar.xz), or the web address of
            either; the repository and the known archives by default.
        manifest: what to fetch; the package's own by default.
        patience: with servers.
        notice: called with the number of files dealt with and of all files.

    Raises:
        PullError: the source does not exist, the folder cannot be written, or another pull is filling it.
        ManifestError: the manifest is damaged.
    """
    wanted = manifest or read_manifest()
    try:
        root.mkdir(parents=True, exist_ok=True)
        with _alone(root):
            return _Pull(root, wanted, patience or Patience(), notice).run(source)
    except OSError as error:
        raise PullError(f"{root}: {error}") from error


@contextlib.contextmanager
def _alone(root: Path) -> Iterator[None]:
    folder = root / _PARTIAL
    folder.mkdir(exist_ok=True)
    with (folder / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise PullError(f"{root} is being filled by another process") from None
        yield
    if not any(folder.glob("*.part")):
        shutil.rmtree(folder, ignore_errors=True)


class _Pull:
    """One run."""

    def __init__(self, root: Path, manifest: Manifest, patience: Patience, notice: Callable[[int, int], None]) -> None:
        self.root = root
        self.manifest = manifest
        self.patience = patience
        self.notice = notice
        self.missing: dict[PurePosixPath, str] = {}
        self._dealt_with = 0
        self._lock = threading.Lock()

    def run(self, source: str | None) -> Report:
        targets = {entry: self._target(entry) for entry in self.manifest.files}
        kept = {entry for entry, target in targets.items() if entry.matches(target)}
        self._count(len(kept))
        wanted = [entry for entry in targets if entry not in kept]
        timeout = httpx.Timeout(self.patience.read, connect=self.patience.connect)
        with httpx.Client(timeout=timeout, headers={"Accept-Encoding": "identity"}) as client:
            rest = self._from_source(client, source, wanted) if source else self._from_everywhere(client, wanted)
        fetched = [entry.path for entry in wanted if entry not in rest]
        missing = {entry.path: self.missing.get(entry.path, "no source has it") for entry in rest}
        notes = {path: note for path in missing if (note := assets.stand_in_note(path, self.root))}
        wanting = [entry.path for entry in rest if entry.path not in notes and entry.used_by not in missing]
        kept_paths = tuple(entry.path for entry in targets if entry in kept)
        return Report(self.root, tuple(fetched), kept_paths, missing, tuple(notes.values()), tuple(wanting))

    def _from_everywhere(self, client: httpx.Client, wanted: Sequence[Entry]) -> list[Entry]:
        base = REPOSITORY.format(commit=self.manifest.commit)
        rest = self._take(WebFolder(client, base, self._partial, self.patience), wanted)
        for archive in ARCHIVES:
            if any(str(entry.path).startswith(archive.holds) for entry in rest):
                rest = self._from_web_archive(client, archive, rest)
        return rest

    def _from_source(self, client: httpx.Client, source: str, wanted: Sequence[Entry]) -> list[Entry]:
        if source.startswith(("http://", "https://")):
            if _is_archive(httpx.URL(source).path):
                return self._from_web_archive(client, Archive(url=source, hosts=(), holds=("",)), wanted)
            base = source if source.endswith("/") else source + "/"
            return self._take(WebFolder(client, base, self._partial, self.patience), wanted)
        path = Path(source).expanduser()
        if path.is_dir():
            return self._take(Folder(path, self._partial), wanted)
        if not path.is_file():
            raise PullError(f"{source!r} is neither a folder, a file nor a web address")
        return self._from_archive(path, wanted, str(path))

    def _from_web_archive(self, client: httpx.Client, archive: Archive, wanted: Sequence[Entry]) -> list[Entry]:
        part = self._partial(hashlib.sha256(archive.url.encode()).hexdigest())
        accept = _Expected(sha256=archive.sha256, most=_LARGEST_ARCHIVE)
        try:
            _insist(lambda: _download(client, archive.url, part, accept, archive.hosts), self.patience)
            rest = self._from_archive(part, wanted, archive.url)
        except (NotThere, Broken) as error:
            return self._refused(wanted, f"{archive.url}: {error}")
        except PullError as error:
            rest = self._refused(wanted, str(error))
        part.unlink(missing_ok=True)
        return rest

    def _refused(self, wanted: Sequence[Entry], reason: str) -> list[Entry]:
        for entry in wanted:
            self._remember(entry, reason)
        return list(wanted)

    def _from_archive(self, path: Path, wanted: Sequence[Entry], name: str) -> list[Entry]:
        with _open_archive(path, name, self.root / _PARTIAL) as members:
            return self._take(OpenArchive(name, members, self._partial), wanted, threads=1)

    def _take(self, source: Source, wanted: Sequence[Entry], threads: int = _THREADS) -> list[Entry]:
        """Ask a source for files; returns what it did not give. Files of the same content are fetched once."""
        alike: dict[str, list[Entry]] = {}
        for entry in wanted:
            alike.setdefault(entry.key, []).append(entry)
        with ThreadPoolExecutor(threads) as pool:
            got = dict(
                zip(alike, pool.map(lambda entries: self._take_alike(source, entries), alike.values()), strict=True)
            )
        return [entry for entry in wanted if not got[entry.key]]

    def _take_alike(self, source: Source, entries: Sequence[Entry]) -> bool:
        for entry in entries:
            try:
                part = source.fetch(entry)
            except (NotThere, Broken) as error:
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
            shutil.copyfile(part, copy)
            copy.replace(target)
        part.unlink()
        self._count(len(entries))

    def _target(self, entry: Entry) -> Path:
        target = self.root / assets.safe_path(str(entry.path))
        self._inside(target.parent, entry)
        return target

    def _inside(self, folder: Path, entry: Entry) -> None:
        """Links in the tree must not lead out of it."""
        if not folder.resolve().is_relative_to(self.root.resolve()):
            raise PullError(f"{entry.path}: a link in {self.root} leads out of it, to {folder.resolve()}")

    def _partial(self, key: str) -> Path:
        return self.root / _PARTIAL / f"{key}.part"

    def _remember(self, entry: Entry, reason: str) -> None:
        with self._lock:
            earlier = self.missing.get(entry.path)
            self.missing[entry.path] = f"{earlier}; {reason}" if earlier else reason

    def _count(self, number: int) -> None:
        with self._lock:
            self._dealt_with += number
            self.notice(self._dealt_with, len(self.manifest.files))


# ---------------------------------------------------------------------------------------------------------------------
# Sources.

_Partial = Callable[[str], Path]


class Source(Protocol):
    """Where files come from."""

    def fetch(self, entry: Entry) -> Path:
        """A verified copy of a file, for the caller to move.

        Raises:
            NotThere: the source does not have it.
            Broken: the transfer failed.
        """
        ...


class Folder:
    """A folder in the tree's layout."""

    def __init__(self, root: Path, partial: _Partial) -> None:
        self._root, self._partial = root, partial

    def fetch(self, entry: Entry) -> Path:
        """See ``Source.fetch``."""
        found = self._root / entry.path
        if not found.is_file():
            raise NotThere(f"not in {self._root}")
        part = self._partial(entry.key)
        shutil.copyfile(found, part)
        if not entry.matches(part):
            part.unlink()
            raise NotThere(f"{found} has other content than the manifest says")
        return part


class OpenArchive:
    """Members of an archive, known by their content: where they lie in it does not matter."""

    def __init__(self, name: str, members: Members, partial: _Partial) -> None:
        self._name, self._members, self._partial = name, members, partial

    def fetch(self, entry: Entry) -> Path:
        """See ``Source.fetch``."""
        part = self._partial(entry.key)
        for member in self._members.named(entry.path.name, entry.size):
            try:
                with self._members.open(member) as stream, part.open("wb") as file:
                    shutil.copyfileobj(stream, file, _CHUNK)
            except _DAMAGE as error:
                part.unlink(missing_ok=True)
                raise NotThere(f"damaged in {self._name}: {_reason(error)}") from error
            if entry.matches(part):
                return part
            part.unlink()
        raise NotThere(f"not in {self._name}")


class WebFolder:
    """A web address below which files lie as in the tree."""

    def __init__(self, client: httpx.Client, base: str, partial: _Partial, patience: Patience) -> None:
        self._client, self._base, self._partial, self._patience = client, base, partial, patience
        self._unanswered = 0

    def fetch(self, entry: Entry) -> Path:
        """See ``Source.fetch``."""
        if self._unanswered >= _PATIENCE:
            raise Unreachable(f"{httpx.URL(self._base).host} cannot be reached")
        part, url = self._partial(entry.key), self._base + quote(str(entry.path))
        accept = _Expected(entry=entry, most=entry.size or _LARGEST_FILE)
        try:
            _insist(lambda: _download(self._client, url, part, accept, ()), self._patience)
        except Unreachable:
            self._unanswered += 1
            raise
        self._unanswered = 0
        return part


# ---------------------------------------------------------------------------------------------------------------------
# HTTP.


@dataclass(frozen=True, kw_only=True)
class _Expected:
    """What a download has to be: a file of the manifest, or anything with this hash ("" for anything)."""

    entry: Entry | None = None
    sha256: str = ""
    most: int

    def check(self, part: Path) -> None:
        """Delete the download and raise ``Broken`` unless it is right; shorter than expected, it is only ``Broken``."""
        have = part.stat().st_size
        if self.entry and self.entry.size is not None and have < self.entry.size:
            raise Broken(f"broke off after {have} of {self.entry.size} bytes")
        wanted = self.entry or (Entry(path=PurePosixPath("archive"), sha256=self.sha256) if self.sha256 else None)
        if wanted and not wanted.matches(part):
            part.unlink()
            raise Broken("has other content than its hash says")


def _insist(action: Callable[[], None], patience: Patience) -> None:
    tenacity.Retrying(
        stop=tenacity.stop_after_attempt(patience.attempts),
        wait=tenacity.wait_exponential(multiplier=patience.wait, max=30),
        retry=tenacity.retry_if_exception_type(Broken),
        reraise=True,
    )(action)


def _download(client: httpx.Client, url: str, part: Path, expected: _Expected, hosts: Sequence[str]) -> None:
    """Continue or begin the download ``part``, and verify it."""
    have = part.stat().st_size if part.exists() else 0
    if have >= expected.most:
        have = 0
    headers = {"Range": f"bytes={have}-"} if have else {}
    try:
        with _answer(client, httpx.URL(url), headers, hosts) as response:
            if response.status_code == httpx.codes.REQUESTED_RANGE_NOT_SATISFIABLE:
                part.unlink(missing_ok=True)
                raise Broken("the server has no more of it than there is already")
            _check_status(response)
            continued = response.status_code == httpx.codes.PARTIAL_CONTENT and _starts_at(response, have)
            _write(response, part, have if continued else 0, expected.most)
    except httpx.InvalidURL as error:
        raise NotThere(f"not a web address: {error}") from error
    except (httpx.ConnectError, httpx.ConnectTimeout, httpx.PoolTimeout) as error:
        raise Unreachable(f"no connection ({_reason(error)})") from error
    except httpx.TransportError as error:
        raise Broken(_reason(error)) from error
    expected.check(part)


@contextlib.contextmanager
def _answer(
    client: httpx.Client, url: httpx.URL, headers: dict[str, str], hosts: Sequence[str]
) -> Iterator[httpx.Response]:
    """The answer at the end of the redirections, as long as they stay where they may go."""
    first = url
    for _ in range(_MAX_REDIRECTS + 1):
        with client.stream("GET", url, headers=headers) as response:
            if response.next_request is None:
                yield response
                return
            url = response.next_request.url
            _may_go(first, url, hosts)
    raise NotThere(f"more than {_MAX_REDIRECTS} redirections")


def _may_go(first: httpx.URL, to: httpx.URL, hosts: Sequence[str]) -> None:
    same = (to.host, to.port) == (first.host, first.port)
    known = to.port is None and any(to.host == host or to.host.endswith(f".{host}") for host in hosts)
    if not (same or known) or to.scheme not in ("https", first.scheme):
        raise NotThere(f"refused to follow a redirection to {to.copy_with(query=None)}")


def _check_status(response: httpx.Response) -> None:
    code = response.status_code
    if code in (httpx.codes.OK, httpx.codes.PARTIAL_CONTENT):
        return
    transient = code >= 500 or code in (httpx.codes.REQUEST_TIMEOUT, httpx.codes.TOO_MANY_REQUESTS)
    raise (Broken if transient else NotThere)(f"the server answers {code} {response.reason_phrase}")


def _starts_at(response: httpx.Response, have: int) -> bool:
    if not response.headers.get("Content-Range", "").startswith(f"bytes {have}-"):
        raise Broken("the server continues at another place than asked")
    return True


def _write(response: httpx.Response, part: Path, have: int, most: int) -> None:
    with part.open("r+b" if have else "wb") as file:
        file.seek(have)
        for chunk in response.iter_raw():  # a chunk size would hold bytes back, and lose them where it breaks off
            have += len(chunk)
            if have > most:
                file.truncate(0)
                raise Broken(f"is longer than {most} bytes")
            file.write(chunk)


def _reason(error: Exception) -> str:
    return str(error) or type(error).__name__


# ---------------------------------------------------------------------------------------------------------------------
# Archives.

_SUFFIXES = (".zip", ".tar", ".tar.gz", ".tgz", ".tar.xz", ".tar.bz2")
_PACKED: dict[bytes, Callable[[Path], IO[bytes]]] = {
    b"\x1f\x8b": gzip.open,  # type: ignore[dict-item]
    b"\xfd7zXZ\x00": lzma.open,
    b"BZh": bz2.open,
}
# What the standard library raises on a damaged, encrypted or foreign archive.
_DAMAGE = (zipfile.BadZipFile, tarfile.TarError, zlib.error, lzma.LZMAError, EOFError, RuntimeError, OSError)


def _is_archive(name: str) -> bool:
    return name.endswith(_SUFFIXES)


class Members:
    """Regular files of an archive."""

    def __init__(self, sizes: Iterable[tuple[Any, str, int]], opener: Callable[[Any], IO[bytes]]) -> None:
        self.open = opener
        self._named: dict[str, list[tuple[Any, int]]] = {}
        for member, name, size in sizes:
            self._named.setdefault(PurePosixPath(name).name, []).append((member, size))

    def named(self, name: str, size: int | None) -> list[Any]:
        """Members with a file name, and a size where it is known."""
        most = _LARGEST_FILE if size is None else size
        return [member for member, has in self._named.get(name, ()) if has <= most and size in (None, has)]


@contextlib.contextmanager
def _open_archive(path: Path, name: str, scratch: Path) -> Iterator[Members]:
    """The files of a zip or tar archive; a compressed tar is unpacked into ``scratch`` for the while.

    Raises:
        PullError: it is neither, or damaged.
    """
    with contextlib.ExitStack() as stack:
        try:
            if zipfile.is_zipfile(path):
                members = _zip_members(stack.enter_context(zipfile.ZipFile(path)))
            else:
                plain = stack.enter_context(_unpacked(path, scratch))
                members = _tar_members(stack.enter_context(tarfile.open(fileobj=plain, mode="r:")))
        except _DAMAGE as error:
            raise PullError(f"{name} is not an archive that can be read: {_reason(error)}") from error
        yield members


@contextlib.contextmanager
def _unpacked(path: Path, scratch: Path) -> Iterator[IO[bytes]]:
    with path.open("rb") as file:
        start = file.read(8)
        opener = next((opener for magic, opener in _PACKED.items() if start.startswith(magic)), None)
        if opener is None:
            file.seek(0)
            yield file
            return
    with tempfile.TemporaryFile(dir=scratch) as plain:
        with opener(path) as stream:
            shutil.copyfileobj(stream, plain, _CHUNK)
        plain.seek(0)
        yield plain


def _zip_members(archive: zipfile.ZipFile) -> Members:
    infos = [info for info in archive.infolist() if not info.is_dir()]
    return Members([(info, info.filename, info.file_size) for info in infos], archive.open)


def _tar_members(archive: tarfile.TarFile) -> Members:
    def opened(info: tarfile.TarInfo) -> IO[bytes]:
        stream = archive.extractfile(info)
        assert stream is not None  # only of regular files
        return stream

    return Members([(info, info.name, info.size) for info in archive if info.isfile()], opened)
