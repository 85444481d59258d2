"""Who may call the server: tokens, names, origins, headers, sizes, rates, and what the log shows."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi.testclient import TestClient
from hypothesis import given
from hypothesis import strategies as st
from support import streams
from vecenv_eval.panel.session import Session
from vecenv_eval.web.app import create_app
from vecenv_eval.web.limits import Buckets, is_deeper
from vecenv_eval.web.server import running
from vecenv_eval.web.settings import ServeError, ServeSettings, is_loopback, new_token, read_token

TOKEN = "0123456789abcdef-token"
BEARER = {"Authorization": f"Bearer {TOKEN}"}


@pytest.fixture(scope="module")
def live() -> Iterator[Session]:
    with Session() as live:
        yield live


def client(live: Session, base: str = "http://127.0.0.1:8000", **settings: Any) -> TestClient:
    return TestClient(create_app(live, ServeSettings(**settings)), base_url=base)


# -- tokens ------------------------------------------------------------------------------------------------------------


def test_with_a_token_only_health_and_the_page_are_open(live: Session) -> None:
    asked = client(live, token=TOKEN)
    assert asked.get("/api/health").status_code == 200
    for path in ("/api/session", "/api/catalog", "/api/openapi.json", "/api/nodes", "/api/nothing"):
        answer = asked.get(path)
        assert answer.status_code == 401, path
        assert answer.headers["www-authenticate"] == "Bearer"
    assert asked.get("/api/session", headers=BEARER).status_code == 200


@pytest.mark.parametrize(
    "header",
    [
        "Bearer wrong-token-of-some-length",
        f"Basic {TOKEN}",
        TOKEN,
        "Bearer",
        f"Bearer {TOKEN}x",
        f"Bearer {TOKEN[:-1]}",
        "Bearer \xff",
    ],
)
def test_a_wrong_token_is_refused(live: Session, header: str) -> None:
    asked = client(live, token=TOKEN)
    assert asked.get("/api/session", headers={"Authorization": header.encode("latin-1")}).status_code == 401  # type: ignore[dict-item]


def test_a_token_in_the_address_is_not_looked_at(live: Session) -> None:
    assert client(live, token=TOKEN).get(f"/api/session?token={TOKEN}").status_code == 401


def test_a_login_gives_a_cookie_that_is_not_the_token(live: Session) -> None:
    asked = client(live, token=TOKEN)
    answer = asked.post("/api/login", json={"token": TOKEN})
    cookie = answer.headers["set-cookie"]
    assert TOKEN not in cookie
    assert "HttpOnly" in cookie
    assert "samesite=strict" in cookie.lower()
    assert asked.get("/api/session").status_code == 200
    # Another server, even with the same token, does not know the cookie.
    other = client(live, token=TOKEN)
    other.cookies.update(asked.cookies)
    assert other.get("/api/session").status_code == 401


def test_who_guesses_is_not_heard_for_a_while_and_who_has_the_cookie_is(live: Session) -> None:
    asked = client(live, token=TOKEN, logins_per_minute=3)
    assert asked.post("/api/login", json={"token": TOKEN}).status_code == 200
    cookies, asked.cookies = asked.cookies, type(asked.cookies)()
    answers = [asked.post("/api/login", json={"token": f"guess-{n}-of-a-token"}).status_code for n in range(5)]
    assert answers == [401, 401, 401, 429, 429]
    assert asked.get("/api/session", headers=BEARER).status_code == 429
    asked.cookies = cookies
    assert asked.get("/api/session").status_code == 200


def test_streams_need_the_token_too(live: Session) -> None:
    with running(create_app(live, ServeSettings(token=TOKEN))) as server:
        login = httpx.post(f"{server.url}/api/login", json={"token": TOKEN})
        cookie = {"Cookie": login.headers["set-cookie"].partition(";")[0]}
        assert streams.status(server) == 403
        assert streams.status(server, {"Authorization": "Bearer wrong-token-of-some-length"}) == 403
        assert streams.status(server, BEARER) == 101
        assert streams.status(server, cookie) == 101


def test_streams_look_at_names_and_origins_too(live: Session) -> None:
    with running(create_app(live)) as server:
        assert streams.status(server) == 101
        assert streams.status(server, {"Origin": server.url}) == 101
        assert streams.status(server, {"Origin": "http://evil.org"}) == 403
        assert streams.status(server, {"Origin": "null"}) == 403


def test_other_addresses_than_loopback_need_a_token() -> None:
    with pytest.raises(ServeError, match="a token is needed"):
        ServeSettings(host="0.0.0.0")
    with pytest.raises(ServeError, match="at least 16"):
        ServeSettings(token="short")
    assert ServeSettings(host="0.0.0.0", token=new_token()).token


@pytest.mark.parametrize(
    ("host", "expected"),
    [
        ("127.0.0.1", True),
        ("127.1.2.3", True),
        ("::1", True),
        ("[::1]", True),
        ("localhost", True),
        ("a.localhost", True),
        ("0.0.0.0", False),
        ("::", False),
        ("192.168.0.5", False),
        ("localhost.evil.org", False),
        ("127.0.0.1.evil.org", False),
        ("", False),
    ],
)
def test_what_is_loopback(host: str, expected: bool) -> None:
    assert is_loopback(host) is expected


def test_tokens_come_from_a_file_or_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("VECENV_TOKEN", raising=False)
    assert read_token(None) is None
    monkeypatch.setenv("VECENV_TOKEN", f" {TOKEN}\n")
    assert read_token(None) == TOKEN
    (tmp_path / "token").write_text(f"{TOKEN}2\n")
    assert read_token(tmp_path / "token") == f"{TOKEN}2"
    (tmp_path / "empty").write_text("\n")
    for name, text in (("empty", "is empty"), ("missing", "cannot be read")):
        with pytest.raises(ServeError, match=text):
            read_token(tmp_path / name)


# -- names and origins -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "host",
    ["evil.org", "evil.org:8000", "127.0.0.1.evil.org", "192.168.0.5", "", "127.0.0.1@evil.org", "localhost:x", "a b"],
)
def test_a_name_that_is_not_the_servers_is_refused(live: Session, host: str) -> None:
    assert client(live).get("/api/health", headers={"Host": host}).status_code == 421


@pytest.mark.parametrize("host", ["127.0.0.1:1", "localhost", "LOCALHOST:8000", "[::1]:8000", "vecenv.localhost"])
def test_names_of_this_machine_are_its_own(live: Session, host: str) -> None:
    assert client(live).get("/api/health", headers={"Host": host}).status_code == 200


def test_on_other_addresses_any_address_is_known_and_names_only_if_they_were_given(live: Session) -> None:
    asked = client(live, host="0.0.0.0", token=TOKEN, allowed_hosts=("lab.example",))
    for host, status in (("10.0.0.7:80", 200), ("lab.example", 200), ("evil.org", 421)):
        assert asked.get("/api/health", headers={"Host": host}).status_code == status


@pytest.mark.parametrize(
    ("origin", "status"),
    [
        ("http://127.0.0.1:8000", 200),
        ("http://127.0.0.1:8001", 403),
        ("https://127.0.0.1:8000", 403),
        ("http://localhost:8000", 403),
        ("http://evil.org", 403),
        ("null", 403),
        ("http://127.0.0.1:8000.evil.org", 403),
        ("http://friend.example:1", 200),
    ],
)
def test_only_the_servers_own_pages_may_call(live: Session, origin: str, status: int) -> None:
    asked = client(live, allowed_origins=("http://friend.example:1",))
    assert asked.get("/api/health", headers={"Origin": origin}).status_code == status


def test_headers_forbid_what_a_page_does_not_need(live: Session) -> None:
    for path in ("/", "/api/health", "/api/nothing"):
        headers = client(live).get(path).headers
        assert "default-src 'self'" in headers["content-security-policy"]
        assert "frame-ancestors 'none'" in headers["content-security-policy"]
        assert "unsafe" not in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["referrer-policy"] == "no-referrer"
        assert "access-control-allow-origin" not in headers
    assert client(live).get("/api/health").headers["cache-control"] == "no-store"


@pytest.mark.parametrize(
    "path", ["/static/../app.py", "/static/%2e%2e/app.py", "/static/..%2fapp.py", "/static//etc/passwd"]
)
def test_files_outside_of_the_page_are_not_served(live: Session, tmp_path: Path, path: str) -> None:
    folder = tmp_path / "static"
    folder.mkdir()
    (folder / "page.js").write_text("1")
    (tmp_path / "app.py").write_text("secret")
    asked = TestClient(create_app(live, static=folder), base_url="http://127.0.0.1")
    assert asked.get("/static/page.js").text == "1"
    answer = asked.get(path)
    assert answer.status_code == 404
    assert "secret" not in answer.text


# -- sizes and rates ---------------------------------------------------------------------------------------------------


def test_a_body_that_is_too_large_is_refused_before_it_is_read_to_its_end(live: Session) -> None:
    asked = client(live, max_body=1000)

    def chunks() -> Iterator[bytes]:
        for _ in range(100):
            yield b"x" * 100

    assert asked.post("/api/login", content=b"x" * 2000).status_code == 413
    assert asked.post("/api/login", content=chunks()).status_code == 413
    assert asked.post("/api/login", content=b"x", headers={"Content-Length": "9" * 30}).status_code == 413


def test_deep_nesting_is_refused_before_it_is_parsed(live: Session) -> None:
    answer = client(live).post("/api/login", content=b'{"token":' + b"[" * 100_000)
    assert answer.status_code == 422
    assert "nested" in answer.json()["error"]


@pytest.mark.parametrize(
    ("text", "deep"),
    [
        ("[" * 5 + "]" * 5, True),
        ("[" * 4 + "]" * 4, False),
        ("[]" * 50, False),
        ('{"a": {"b": [[[1]]]}}', True),
        ('["[[[[[["]', False),
        ('["\\"[[[[[["]', False),
        ('["a\\\\", [[[[1]]]]]', True),
        ('"[[[[[[', False),
    ],
)
def test_how_deep_a_text_is(text: str, deep: bool) -> None:
    assert is_deeper(text.encode(), 4) is deep


@given(
    st.recursive(
        st.none() | st.text() | st.integers(),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    )
)
def test_depth_is_that_of_the_value(value: Any) -> None:
    import json

    def depth(each: Any) -> int:
        inner = each.values() if isinstance(each, dict) else each if isinstance(each, list) else None
        return 0 if inner is None else 1 + max(map(depth, inner), default=0)

    text, real = json.dumps(value).encode(), depth(value)
    assert not is_deeper(text, real)
    assert real == 0 or is_deeper(text, real - 1)


def test_too_many_requests_are_refused(live: Session) -> None:
    asked = client(live, requests_per_second=0.5)
    statuses = [asked.get("/api/health").status_code for _ in range(8)]
    assert statuses == [200] * 5 + [429] * 3


def test_buckets_fill_again_and_forget_old_clients() -> None:
    now = [0.0]
    buckets = Buckets(1.0, 2.0, clock=lambda: now[0])
    assert [buckets.take("a") for _ in range(3)] == [True, True, False]
    assert buckets.take("b")
    now[0] = 1.5
    assert [buckets.take("a") for _ in range(2)] == [True, False]
    for number in range(20_000):
        buckets.take(str(number))
    assert len(buckets._left) <= 10_000


# -- log ---------------------------------------------------------------------------------------------------------------


def test_the_access_log_has_no_secret_and_no_forged_line(live: Session, caplog: pytest.LogCaptureFixture) -> None:
    asked = client(live, token=TOKEN)
    with caplog.at_level(logging.INFO, "vecenv_eval.web.access"):
        asked.get(f"/api/session?token={TOKEN}", headers=BEARER)
        asked.get("/api/a%0d%0aforged")
        asked.post("/api/login", json={"token": TOKEN})
    lines = [record.getMessage() for record in caplog.records if record.name == "vecenv_eval.web.access"]
    assert len(lines) == 3
    assert all(TOKEN not in line and "\n" not in line and "\r" not in line for line in lines)
    assert "GET '/api/session' 200" in lines[0]
