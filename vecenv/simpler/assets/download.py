"""Downloads over HTTP that resume, are verified, and follow redirects only to hosts that are allowed.

In: a web address, a partial file and what the content must be. Out: the complete, verified file. An interrupted
download is resumed with a range request, wrong content is deleted, and both are retried. This uses httpx and not pooch
because pooch's downloader begins every file anew and follows redirects to any host.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO, Literal

import httpx
import tenacity

from vecenv.simpler.assets.errors import FileNotInSource, ServerUnreachable, TransferError, reason
from vecenv.simpler.assets.files import Entry

_MAX_REDIRECTS = 5


@dataclass(frozen=True, kw_only=True)
class RetryPolicy:
    """Timeouts and retries of downloads.

    Attributes:
        attempts: tries per file.
        connect: timeout of a connection, seconds.
        read: longest time without a byte, seconds.
        wait: seconds before the second try; doubled each time, at most thirty.
        slowest: bytes a second; a try whose content comes more slowly ends.
        patience: seconds over which that is measured, again and again.
    """

    attempts: int = 5
    connect: float = 10.0
    read: float = 30.0
    wait: float = 0.5
    slowest: float = 1000.0
    patience: float = 30.0


@dataclass(frozen=True, kw_only=True)
class ExpectedContent:
    """What a download must be: a file of the manifest, or any content with this hash.

    Attributes:
        entry: the file; None for an archive.
        sha256: of an archive, hexadecimal; "" for any content.
        max_bytes: longer downloads are rejected.
    """

    entry: Entry | None = None
    sha256: str = ""
    max_bytes: int

    def check(self, part: Path) -> None:
        """Verify a download; wrong content is deleted, a download that is too short is kept so that it can resume.

        Raises:
            TransferError: it is too short or has other content.
        """
        size = part.stat().st_size
        if self.entry and self.entry.size is not None and size < self.entry.size:
            raise TransferError(f"interrupted after {size} of {self.entry.size} bytes")
        wanted = self.entry or (Entry(path=PurePosixPath("archive"), sha256=self.sha256) if self.sha256 else None)
        if wanted and not wanted.matches(part):
            part.unlink()
            raise TransferError("has other content than its hash says")


def make_client(policy: RetryPolicy) -> httpx.Client:
    """An HTTP client with a policy's timeouts that receives files uncompressed."""
    timeout = httpx.Timeout(policy.read, connect=policy.connect)
    return httpx.Client(timeout=timeout, headers={"Accept-Encoding": "identity"})


def download(
    client: httpx.Client,
    url: str,
    part: Path,
    expected: ExpectedContent,
    *,
    hosts: Sequence[str] = (),
    policy: RetryPolicy,
) -> None:
    """Download a file, resuming what an earlier call left in ``part``.

    Args:
        client: from ``make_client``.
        url: the file's address.
        part: partial file; the complete file when this returns.
        expected: what the content must be.
        hosts: redirects may lead to these hosts and their subdomains, and to the address's own host.
        policy: retries.

    Raises:
        FileNotInSource: the server does not have it, or redirects to a host that is not allowed.
        TransferError: all tries failed.
    """
    tenacity.Retrying(
        stop=tenacity.stop_after_attempt(policy.attempts),
        wait=tenacity.wait_exponential(multiplier=policy.wait, max=30),
        retry=tenacity.retry_if_exception_type(TransferError),
        reraise=True,
    )(_try_once, client, url, part, expected, hosts, policy)


def opened(part: Path, mode: Literal["wb", "r+b"]) -> IO[bytes]:
    """Open a partial file to write; never through a link, which would lead to another file.

    Raises:
        OSError: it is a link, or cannot be written.
    """
    flags = os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC | (os.O_CREAT | os.O_TRUNC if mode == "wb" else 0)
    return os.fdopen(os.open(part, flags, 0o666), "wb" if mode == "wb" else "r+b")


def _try_once(
    client: httpx.Client,
    url: str,
    part: Path,
    expected: ExpectedContent,
    hosts: Sequence[str],
    policy: RetryPolicy,
) -> None:
    size = part.stat().st_size if part.exists() else 0
    if size >= expected.max_bytes:
        size = 0
    headers = {"Range": f"bytes={size}-"} if size else {}
    try:
        with _follow_redirects(client, httpx.URL(url), headers, hosts) as response:
            if response.status_code == httpx.codes.REQUESTED_RANGE_NOT_SATISFIABLE:
                part.unlink(missing_ok=True)
                raise TransferError("the server has no more bytes than were already received")
            _check_status(response)
            resumed = response.status_code == httpx.codes.PARTIAL_CONTENT and _resumes_at(response, size)
            _write(response, part, size if resumed else 0, expected.max_bytes, policy)
    except httpx.InvalidURL as error:
        raise FileNotInSource(f"not a web address: {error}") from error
    except (httpx.ConnectError, httpx.ConnectTimeout, httpx.PoolTimeout) as error:
        raise ServerUnreachable(f"no connection ({reason(error)})") from error
    except httpx.TransportError as error:
        raise TransferError(reason(error)) from error
    expected.check(part)


@contextlib.contextmanager
def _follow_redirects(
    client: httpx.Client, url: httpx.URL, headers: Mapping[str, str], hosts: Sequence[str]
) -> Iterator[httpx.Response]:
    """The response at the end of the redirects, which may only lead to allowed hosts."""
    first = url
    for _ in range(_MAX_REDIRECTS + 1):
        with client.stream("GET", url, headers=dict(headers)) as response:
            if response.next_request is None:
                yield response
                return
            url = response.next_request.url
            check_redirect(first, url, hosts)
    raise FileNotInSource(f"more than {_MAX_REDIRECTS} redirects")


def check_redirect(first: httpx.URL, to: httpx.URL, hosts: Sequence[str]) -> None:
    """Check that a redirect stays on the first address's host and port, or leads to an allowed host, and keeps HTTPS.

    Raises:
        FileNotInSource: it does not.
    """
    same = (to.host, to.port) == (first.host, first.port)
    allowed = to.port is None and any(to.host == host or to.host.endswith(f".{host}") for host in hosts)
    if not (same or allowed) or to.scheme not in ("https", first.scheme):
        raise FileNotInSource(f"refused to follow a redirect to {to.copy_with(query=None)}")


def _check_status(response: httpx.Response) -> None:
    code = response.status_code
    if code in (httpx.codes.OK, httpx.codes.PARTIAL_CONTENT):
        return
    transient = code >= 500 or code in (httpx.codes.REQUEST_TIMEOUT, httpx.codes.TOO_MANY_REQUESTS)
    raise (TransferError if transient else FileNotInSource)(f"the server answers {code} {response.reason_phrase}")


def _resumes_at(response: httpx.Response, size: int) -> bool:
    if not response.headers.get("Content-Range", "").startswith(f"bytes {size}-"):
        raise TransferError("the server resumes at another byte than requested")
    return True


def _write(response: httpx.Response, part: Path, size: int, max_bytes: int, policy: RetryPolicy) -> None:
    since, at_least = time.monotonic(), size + policy.slowest * policy.patience
    with opened(part, "r+b" if size else "wb") as file:
        file.seek(size)
        for chunk in response.iter_raw():  # with a chunk size, bytes would be held back and lost on an interruption
            size += len(chunk)
            if size > max_bytes:
                file.truncate(0)
                raise TransferError(f"is longer than {max_bytes} bytes")
            file.write(chunk)
            if time.monotonic() - since >= policy.patience:
                if size < at_least:
                    raise TransferError(f"comes more slowly than {policy.slowest:.0f} bytes a second")
                since, at_least = time.monotonic(), size + policy.slowest * policy.patience
