"""The page of ``vecenv report`` in a real browser: it draws, asks nobody, and fits a phone, a dark room and paper.

Needs playwright and a Chromium: Debian's package ``chromium``, or ``playwright install chromium``. With
``VECENV_SCREENSHOTS=FOLDER`` what the browser shows is kept there.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.browser import chromium
from support.results_folders import some_records, write_results
from vecenv_eval.report.html import page
from vecenv_eval.report.run import read_run
from vecenv_eval.video.episodes import video_path
from vecenv_eval.video.writer import VideoWriter

api = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
WIDE, PHONE = {"width": 1100, "height": 900}, {"width": 400, "height": 800}


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as found:
        yield found


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    runs = []
    for name, suites in (("base", {"libero_goal": 3, "libero_10": 1}), ("tuned", {"libero_goal": 4, "libero_10": 2})):
        for suite, most in suites.items():
            records = some_records(
                lambda task, episode, most=most: episode < most + task,
                suite=suite,
                tasks=5,
                episodes=8,
                policy_s=0.3,
                images_s=0.2,
            )
            made = write_results(folder / name / suite, records, suite=suite)
            failed = next(record for record in records if not record.success)
            pytest.importorskip("av")
            with VideoWriter(video_path(made, failed.key)) as video:
                for shade in range(10):
                    video.add(np.full((64, 128, 3), 20 * shade, np.uint8))
        runs.append(read_run(folder / name))
    out = folder / "report.html"
    out.write_text(page(*runs, out=out))
    return out


def opened(browser: Any, path: Path, **options: Any) -> tuple[Any, list[str]]:
    """The page once it has drawn, and everything it complained about or asked for."""
    tab, said = browser.new_page(**options), []
    tab.on("console", lambda message: said.append(message.text) if message.type in ("error", "warning") else None)
    tab.on("pageerror", lambda error: said.append(str(error)))
    tab.on(
        "request",
        lambda request: said.append(request.url) if not request.url.startswith(("file:", "data:", "blob:")) else None,
    )
    tab.goto(path.as_uri())
    tab.wait_for_selector("body[data-ready]", state="attached", timeout=60_000)
    return tab, said


def keep(tab: Any, name: str, **options: Any) -> None:
    if folder := os.environ.get("VECENV_SCREENSHOTS"):
        tab.screenshot(path=str(Path(folder) / name), **options)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_draws_without_a_complaint(browser: Any, written: Path, scheme: str) -> None:
    tab, said = opened(browser, written, viewport=WIDE, color_scheme=scheme)
    assert said == []
    assert tab.locator(".chart .main-svg").count() >= 4
    assert tab.locator("article.episode").count() > 10
    background = tab.evaluate("getComputedStyle(document.body).backgroundColor")
    ink = tab.evaluate("document.querySelector('.chart text').style.fill")
    bright = [sum(map(int, color[4:-1].split(",")[:3])) > 382 for color in (background, ink)]
    assert bright == [scheme == "light", scheme == "dark"]
    keep(tab, f"{scheme}.png", full_page=True)
    tab.close()


def test_a_video_plays(browser: Any, written: Path) -> None:
    tab, _ = opened(browser, written, viewport=WIDE)
    state = tab.evaluate(
        """() => new Promise((done) => { const video = document.querySelector("article video");
        video.addEventListener("loadeddata", () => done([video.videoWidth, video.duration]));
        video.addEventListener("error", () => done(video.error.message)); video.load(); video.play(); })"""
    )
    assert state == [128, pytest.approx(0.5)]
    tab.close()


def test_it_fits_a_phone(browser: Any, written: Path) -> None:
    tab, said = opened(browser, written, viewport=PHONE)
    assert said == []
    assert tab.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    keep(tab, "phone.png")
    tab.close()


def test_it_prints(browser: Any, written: Path, tmp_path: Path) -> None:
    tab, _ = opened(browser, written, viewport=WIDE, color_scheme="dark")
    tab.emulate_media(media="print")
    assert tab.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    content = tab.pdf(path=str(tmp_path / "report.pdf"), format="A4")
    assert content.startswith(b"%PDF")
    if folder := os.environ.get("VECENV_SCREENSHOTS"):
        shutil.copy(tmp_path / "report.pdf", folder)
    tab.close()
