"""The page of ``vecenv voxposer show`` in a real browser: it draws every figure, asks nobody, and fits narrow windows.

Needs playwright and a Chromium, as ``tests/eval/test_report_browser.py`` does. With ``VECENV_SCREENSHOTS=FOLDER`` what
the browser shows is kept there.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support.browser import chromium
from test_voxposer_show import shown

from voxposer.show import render_page

api = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
# 3D figures need WebGL, which Chromium computes in software where there is no GPU.
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium(FLAGS) as found:
        yield found


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("show") / "page.html"
    path.write_text(render_page(shown()), encoding="utf-8")
    return path


@pytest.mark.parametrize(("scheme", "width"), [("light", 1375), ("dark", 1375), ("light", 420)])
def test_every_figure_is_drawn_without_errors_or_requests(browser: Any, page: Path, scheme: str, width: int) -> None:
    tab, said = browser.new_page(viewport={"width": width, "height": 1100}, color_scheme=scheme), []
    tab.on("console", lambda message: said.append(message.text) if message.type == "error" else None)
    tab.on("pageerror", lambda error: said.append(str(error)))
    tab.on("request", lambda request: said.append(request.url) if request.url.startswith("http") else None)
    tab.goto(page.as_uri())
    tab.wait_for_selector("body[data-ready]", state="attached", timeout=60_000)
    charts = tab.eval_on_selector_all(".chart", "all => all.map(each => each.id)")
    assert charts == ["scene-1", "maps-1", "grip-1"]
    for chart in charts:
        tab.evaluate(f"document.getElementById('{chart}').scrollIntoView()")
        tab.wait_for_selector(f"#{chart} .main-svg", timeout=60_000)
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    if folder := os.environ.get("VECENV_SCREENSHOTS"):
        tab.wait_for_timeout(2000)
        tab.screenshot(path=str(Path(folder) / f"show_{scheme}_{width}.png"), full_page=True)
    tab.close()
    assert said == []


def test_a_link_to_a_program_opens_it(browser: Any, page: Path) -> None:
    tab = browser.new_page()
    tab.goto(page.as_uri())
    assert not tab.evaluate("document.getElementById('call-2').open")
    tab.click("a[href='#call-2']")
    tab.wait_for_selector("#call-2[open]")
    tab.close()
