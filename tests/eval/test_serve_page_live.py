"""The page in a real browser before the server as it is: a session is chosen, driven and watched.

Needs playwright and a Chromium, as ``test_serve_page``. With ``VECENV_SCREENSHOTS=FOLDER`` what is shown is kept there.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
pytest.importorskip("fastapi", reason="needs fastapi: pip install 'vecenv[serve]'")
from support.browser import chromium
from support.live_world import session
from vecenv_eval.panel.session import Session
from vecenv_eval.web.app import create_app
from vecenv_eval.web.server import running
from vecenv_eval.web.settings import ServeSettings

WIDE = {"width": 1440, "height": 900}


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as found:
        yield found


class Tab:
    """A tab and everything it complained about."""

    def __init__(self, browser: Any, url: str) -> None:
        self.said: list[str] = []
        self.page = browser.new_page(viewport=WIDE)
        self.page.on("console", lambda each: self.said.append(each.text) if each.type in ("error", "warning") else None)
        self.page.on("pageerror", lambda error: self.said.append(str(error)))
        self.page.goto(url)
        self.page.wait_for_selector("body[data-ready]")

    def until(self, condition: str, seconds: float = 30) -> None:
        for _ in range(int(20 * seconds)):
            if self.page.evaluate(condition):
                return
            self.page.wait_for_timeout(50)
        raise AssertionError(f"still not true: {condition}; {self.text('#state')}: {self.text('#problem p')}")

    def state(self, name: str, seconds: float = 30) -> None:
        self.until(f"document.getElementById('state').textContent === {name!r}", seconds)

    def text(self, selector: str) -> str:
        return self.page.locator(selector).first.text_content()

    def image(self) -> str:
        return self.page.evaluate("document.querySelector('#cameras canvas').toDataURL()")


def drive(tab: Tab, live: Session, seconds: float) -> None:
    """Step, play, pause and reset what is loaded, and see it on the page."""
    tab.state("ready", seconds)
    tab.page.wait_for_selector("#cameras canvas[data-tick='0']", timeout=1000 * seconds)
    tab.until("document.getElementById('wall').dataset.count === '2'", seconds)
    before = tab.image()
    tab.page.fill("#ticks", "4")
    tab.page.click("#step")
    tab.state("paused", seconds)
    tab.until("document.getElementById('steps').textContent.startsWith('4 of ')", seconds)
    tab.page.wait_for_selector("#cameras canvas[data-tick='4']", timeout=1000 * seconds)
    assert tab.image() != before
    assert live.state().tick == 4
    tab.page.select_option("#speed", "2")
    tab.until("document.getElementById('speed').value === '2'")
    tab.page.click("#play")
    tab.state("playing")
    tab.until("parseInt(document.getElementById('steps').textContent) > 4", seconds)
    tab.page.click("#play")
    tab.state("paused", seconds)
    assert live.state().state == "paused"
    tab.page.keyboard.press("ArrowRight")
    tab.page.wait_for_selector("#cameras canvas[data-slot='1']", timeout=1000 * seconds)
    assert tab.text("#episode-id") == live.state().slots[1].episode_id
    tab.page.click("#reset")
    tab.state("ready", seconds)
    tab.until("document.getElementById('steps').textContent.startsWith('0 of ')", seconds)
    assert live.state().tick == 0


def choose(tab: Tab, suite: str, task: str) -> None:
    tab.page.select_option("#suite", suite)
    tab.until(f"document.querySelector('#task option[value=\"{task}\"]') !== null")
    tab.page.select_option("#task", task)
    tab.page.select_option("#episode", "1")
    tab.page.fill("#slots", "2")
    tab.page.select_option("#policy", "zero")
    tab.page.click("#load")


def test_a_batch_is_driven_to_its_verdicts(browser: Any) -> None:
    with session(config=None) as live, running(create_app(live)) as server:
        tab = Tab(browser, server.url)
        assert tab.text("#state") == "idle"
        assert not tab.page.locator("#play").is_visible()
        choose(tab, "libero_goal", "1")
        drive(tab, live, 30)
        assert [(slot.task, slot.episode) for slot in live.state().slots] == [(1, 1), (1, 2)]
        tab.page.select_option("#speed", "")
        tab.page.click("#play")
        tab.state("finished")
        ended = live.state()
        assert tab.text("#solved") == f"{ended.successes} of {ended.finished} ended"
        assert ended.finished == 2
        assert tab.text("#counts").startswith("0 running")
        assert tab.said == []
        tab.page.close()


def test_a_second_reader_watches_and_is_refused_with_a_sentence(browser: Any) -> None:
    with session() as live, running(create_app(live)) as server:
        live.wait_until("ready", timeout=30)
        first, second = Tab(browser, server.url), Tab(browser, server.url)
        first.page.click("#step")
        second.until("document.getElementById('steps').textContent.startsWith('1 of ')")
        second.until("document.getElementById('batch').textContent.includes('driven by another client')")
        second.page.click("#step")
        second.until("!document.getElementById('problem').hidden")
        assert "another client drives this" in second.text("#problem p")
        assert live.state().tick == 1
        first.page.close()  # lets go
        second.until("!document.getElementById('batch').textContent.includes('another client')")
        second.page.click("#step")
        second.until("document.getElementById('steps').textContent.startsWith('2 of ')")
        second.page.close()


def test_the_server_asks_for_its_token(browser: Any) -> None:
    settings = ServeSettings(token="correct-horse-battery")
    with session() as live, running(create_app(live, settings)) as server:
        page = browser.new_page(viewport=WIDE)
        page.goto(server.url)
        page.wait_for_selector("#login[open]")
        page.fill("#token", "correct-horse-battery")
        page.press("#token", "Enter")
        page.wait_for_selector("body[data-ready]")
        page.wait_for_selector("#cameras canvas[data-tick='0']")
        page.close()


@pytest.mark.heavy
def test_libero_is_driven(browser: Any) -> None:
    pytest.importorskip("OpenGL")
    with Session() as live, running(create_app(live)) as server:
        tab = Tab(browser, server.url)
        choose(tab, "libero_goal", "8")
        drive(tab, live, 120)
        assert tab.text("#instruction") == "put the bowl on the plate"
        assert tab.said == []
        if folder := os.environ.get("VECENV_SCREENSHOTS"):
            tab.page.screenshot(path=str(Path(folder) / "serve-libero.png"))
        tab.page.close()
