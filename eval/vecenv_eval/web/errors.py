"""One shape of errors: ``{"error": "one sentence", "field": "name or null"}``; clients never see a traceback."""

from __future__ import annotations

import logging

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from vecenv.errors import InvalidInput, NotFound, VecenvError
from vecenv_eval.panel.state import OutOfTurn

_log = logging.getLogger(__name__)
_SENTENCES = {404: "there is nothing at this address", 405: "this address does not take that method"}
# A sentence is cut off after this many characters: what a client sent may be in it.
_LONGEST = 500


class Refused(HTTPException):
    """A request that is refused, with a status, a sentence, and the field that it is about."""

    def __init__(self, status: int, sentence: str, field: str | None = None, **headers: str) -> None:
        super().__init__(status, sentence, {name.replace("_", "-"): value for name, value in headers.items()})
        self.field = field


def error_body(sentence: str, field: str | None = None) -> dict[str, str | None]:
    """The body of an error."""
    text = " ".join(sentence.split())
    return {"error": text if len(text) <= _LONGEST else text[: _LONGEST - 3] + "...", "field": field}


def install_handlers(app: FastAPI) -> None:
    """Give every error of an application its one shape."""
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(HTTPException, _http)
    app.add_exception_handler(VecenvError, _known)
    app.add_exception_handler(Exception, _unknown)


async def _invalid(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    first = error.errors()[0]
    place = [str(part) for part in first["loc"] if part not in ("body", "query", "path", "header")]
    sentence = f"{'.'.join(place) or 'the body'}: {first['msg']}"
    return JSONResponse(error_body(sentence, place[0] if place else None), 422)


async def _http(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    field = error.field if isinstance(error, Refused) else None
    plain = _SENTENCES.get(error.status_code, str(error.detail))
    sentence = str(error.detail) if isinstance(error, Refused) else plain
    return JSONResponse(error_body(sentence, field), error.status_code, dict(error.headers or {}))


async def _known(request: Request, error: Exception) -> JSONResponse:
    kinds = ((OutOfTurn, 409), (NotFound, 404), (InvalidInput, 422))
    status = next((code for kind, code in kinds if isinstance(error, kind)), 503)
    return JSONResponse(error_body(str(error)), status)


async def _unknown(request: Request, error: Exception) -> JSONResponse:
    _log.error("%s %s failed", request.method, request.url.path, exc_info=error)
    return JSONResponse(error_body("the server failed at this request; its log says how"), 500)
