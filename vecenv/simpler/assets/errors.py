"""What fetching assets raises; messages name the file, the source and the reason."""

from __future__ import annotations

from vecenv.errors import NotFound, ServiceError


class PullError(ServiceError):
    """The target folder or the source cannot be used."""


class FileNotInSource(NotFound):
    """A server, folder or archive does not have a file, or refuses it; a retry would not help."""


class TransferError(ServiceError):
    """A transfer was interrupted or delivered wrong content; a retry may help."""


class ServerUnreachable(TransferError):
    """No connection to the server."""


def reason(error: BaseException) -> str:
    """The message of an error, or its type if the message is empty."""
    return str(error) or type(error).__name__
