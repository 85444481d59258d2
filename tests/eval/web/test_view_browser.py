"""The page of ``vecenv view`` in a real browser: it draws, asks its own server alone, scrubs, compares and follows.

With ``VECENV_SCREENSHOTS=FOLDER`` what the browser shows is kept there.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.browser import chromium
from support.results_folders import some_records, write_results
from support.viewing import viewing
from vecenv_eval.demos.schema import Recording
from vecenv_eval.demos.write import write_demos
from vecenv_eval.live import pack, write_frame
from vecenv_eval.store import ResultStore
from vecenv_eval.video.episodes import video_path
from vecenv_eval.video.writer import VideoWriter

pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
pytest.importorskip("fastapi")
pytest.importorskip("av")
WIDE, PHONE = {"width": 1280, "height": 900}, {"width": 400, "height": 800}
EVIL = "<img src=x onerror=\"document.body.dataset.evil='1'\"><script>document.body.dataset.evil='2'</script>"
CONFIG = {"suite": "libero_goal", "policy": "random", "tasks": "0-3", "episodes": 30}


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as found:
        yield found


def make_run(folder: Path, most: int) -> Path:
    """Four tasks of 20 episodes; the first ones are filmed, one has recorded actions, one a hostile instruction."""
    records = some_records(lambda task, episode: (7 * episode + task) % 10 < most, tasks=4, episodes=20)
    records[5] = replace(records[5], fault="non-finite state", success=False)
    records[6] = replace(records[6], instruction=EVIL, error=EVIL)
    write_results(folder, records, config=CONFIG)
    for record in records[:3]:
        with VideoWriter(video_path(folder, record.key)) as video:
            for shade in range(31):
                image = np.full((96, 192, 3), 8 * shade, np.uint8)
                video.add(image)
    actions = np.sin(np.linspace(0, 6, 30 * 7)).reshape(30, 7)
    state = np.zeros(40)
    recording = Recording(
        episode=0, success=False, fault="", actions=actions, init_state=state, final_state=state, states=None
    )
    write_demos(ResultStore(folder).demos_path("libero_goal", 0), "libero_goal", 0, "open the drawer", [recording])
    return folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("runs")
    return [make_run(folder / name, most) for name, most in (("base", 4), ("tuned", 7))]


@contextmanager
def opened(browser: Any, folders: list[Path], **options: Any) -> Iterator[tuple[Any, list[str]]]:
    """The page once it shows the runs, and everything it complained about or asked of others."""
    with viewing(*folders) as client:
        tab, said = browser.new_page(**{"viewport": WIDE, **options}), []
        tab.on("console", lambda message: said.append(message.text) if message.type in ("error", "warning") else None)
        tab.on("pageerror", lambda error: said.append(str(error)))
        own = (client.url, client.url.replace("http", "ws"), "data:", "blob:")
        tab.on("request", lambda request: None if request.url.startswith(own) else said.append(request.url))
        tab.goto(f"{client.url}/view")
        tab.wait_for_selector("body[data-ready]", state="attached", timeout=60_000)
        try:
            yield tab, said
        finally:
            tab.close()


def keep(tab: Any, name: str) -> None:
    if folder := os.environ.get("VECENV_SCREENSHOTS"):
        tab.screenshot(path=str(Path(folder) / name))


def shown_tick(tab: Any, tick: int, images: int = 1) -> None:
    """Wait until so many images show a tick."""
    tab.wait_for_function(
        "([tick, count]) => document.querySelectorAll(`.image[data-tick='${tick}']`).length === count",
        arg=[tick, images],
        timeout=20_000,
    )


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_draws_without_a_complaint(browser: Any, runs: list[Path], scheme: str) -> None:
    with opened(browser, runs[:1], color_scheme=scheme) as (tab, said):
        assert said == []
        assert tab.locator("#tasks tbody tr").count() == 5
        assert tab.locator("#tasks .interval .at").count() == 5
        assert tab.locator(".run .rate").inner_text().startswith(f"{100 * 31 / 79:.1f}%")
        background = tab.evaluate("getComputedStyle(document.body).backgroundColor")
        assert (sum(map(int, background[4:-1].split(",")[:3])) > 382) == (scheme == "light")
        keep(tab, f"view-{scheme}.png")


def test_a_token_is_asked_for_and_kept_out_of_the_address(browser: Any, runs: list[Path]) -> None:
    with viewing(runs[0], token="correct horse battery") as client:
        tab = browser.new_page(viewport=WIDE)
        tab.goto(f"{client.url}/view")
        tab.wait_for_selector("#login[open]")
        for token in ("wrong", "correct horse battery"):
            tab.fill("#token", token)
            tab.press("#token", "Enter")
            if token == "wrong":
                tab.wait_for_function("() => document.getElementById('login-problem').textContent !== ''")
        tab.wait_for_selector("body[data-ready]", state="attached")
        assert not tab.locator("#login").is_visible()
        assert tab.locator("#episodes tbody tr").count() == 50
        assert tab.url == f"{client.url}/view"
        tab.close()


def test_failures_come_first_and_lists_have_pages(browser: Any, runs: list[Path]) -> None:
    with opened(browser, runs[:1]) as (tab, _):
        verdicts = tab.locator("#episodes tbody .verdict")
        assert verdicts.all_inner_texts()[:3] == ["error", "fault", "failed"]
        assert tab.locator("#page").inner_text() == "1 to 50 of 80"
        tab.locator("#after").click()
        tab.wait_for_function("() => document.querySelector('#page').textContent === '51 to 80 of 80'")
        tab.locator("#show").select_option("fault")
        tab.wait_for_function("() => document.querySelector('#found').textContent === '1 episode'")
        tab.locator("#show").select_option("all")
        tab.locator("#text").fill("libero_goal/3/")
        tab.wait_for_function("() => document.querySelector('#found').textContent === '20 episodes'")
        assert set(tab.locator("#episodes button.row").all_inner_texts()) == {f"libero_goal/3/{i}" for i in range(20)}


def test_an_episode_is_scrubbed_with_keys_and_slider(browser: Any, runs: list[Path]) -> None:
    with opened(browser, runs[:1]) as (tab, said):
        tab.locator("#order").select_option("number")
        tab.wait_for_function("() => document.querySelector('#episodes button.row')?.textContent === 'libero_goal/0/0'")
        tab.keyboard.press("Escape")
        tab.locator("#episodes-title").focus()
        tab.keyboard.press("j")
        shown_tick(tab, 0)
        assert tab.locator(".plot").count() == 3
        tab.keyboard.press("ArrowRight")
        shown_tick(tab, 1)
        tab.keyboard.press("Shift+ArrowRight")
        shown_tick(tab, 11)
        assert "tick 11:" in tab.locator(".plot svg").first.get_attribute("aria-label")
        tab.locator("#tick").fill("25")
        shown_tick(tab, 25)
        bright = tab.evaluate(
            """() => { const image = document.querySelector('.image'), canvas = document.createElement('canvas');
            canvas.width = canvas.height = 1; const pen = canvas.getContext('2d'); pen.drawImage(image, 0, 0, 1, 1);
            return pen.getImageData(0, 0, 1, 1).data[0]; }"""
        )
        assert bright == pytest.approx(200, abs=8)
        tab.keyboard.press("End")
        shown_tick(tab, 30)
        tab.locator("#episode-title").focus()
        tab.keyboard.press(" ")
        tab.wait_for_function("() => document.querySelector('#play').textContent === 'Pause'")
        tab.wait_for_function("() => +document.querySelector('#tick').value > 3")
        tab.keyboard.press(" ")
        tab.keyboard.press("j")
        tab.wait_for_function("() => document.querySelector('#which').textContent === 'libero_goal/0/1'")
        tab.keyboard.press("Escape")
        assert tab.locator("#episode").is_hidden()
        assert said == []


def test_two_runs_are_scrubbed_together(browser: Any, runs: list[Path]) -> None:
    with opened(browser, runs) as (tab, said):
        assert "McNemar" in tab.locator("#verdict-of-pairs").inner_text()
        found = int(tab.locator("#found").inner_text().split()[0])
        assert found == tab.locator("#episodes tbody tr").count() > 10
        rows = tab.locator("#episodes tbody tr").all_inner_texts()
        assert all(("failed" in row) and ("solved" in row) for row in rows)
        tab.locator("#show").select_option("all")
        tab.wait_for_function("() => document.querySelector('#found').textContent === '80 episodes'")
        tab.locator("#episodes button.row").first.click()
        shown_tick(tab, 0, images=2)
        tab.locator("#tick").fill("12")
        shown_tick(tab, 12, images=2)
        assert tab.locator(".pane").count() == 2
        keep(tab, "view-two.png")
        assert said == []


def test_text_from_files_is_text(browser: Any, runs: list[Path]) -> None:
    with opened(browser, runs[:1]) as (tab, said):
        assert EVIL in tab.locator("#episodes tbody").inner_text()
        tab.locator("#episodes button.row").first.click()
        tab.wait_for_selector("#episode:not([hidden])")
        assert tab.locator("#episode-title").inner_text() == EVIL
        assert tab.evaluate("document.body.dataset.evil ?? ''") == ""
        assert said == []


def test_it_fits_a_phone(browser: Any, runs: list[Path]) -> None:
    with opened(browser, runs, viewport=PHONE) as (tab, said):
        width = "document.documentElement.scrollWidth"
        assert tab.evaluate(width) <= PHONE["width"]
        tab.locator("#show").select_option("all")
        tab.locator("#episodes button.row").first.click()
        shown_tick(tab, 0, images=2)
        assert tab.evaluate(width) <= PHONE["width"]
        keep(tab, "view-phone.png")
        assert said == []


def test_a_running_evaluation_is_followed(browser: Any, tmp_path: Path) -> None:
    from PIL import Image

    folder = write_results(tmp_path / "run", some_records(lambda *_: False)[:4], config=CONFIG, ended=False)
    buffer = io.BytesIO()
    Image.fromarray(np.full((96, 192, 3), 120, np.uint8)).save(buffer, "JPEG")
    names = ("ticks", "verdicts", "episodes", "instructions")
    told = dict(zip(names, ([3, 4], ["live", "failure"], ["libero_goal/0/4", "x"], ["open", ""]), strict=True))
    numbers = {"pid": 1, "time": 1.0, "num_slots": 2, "steps_per_s": 2.0, "tile": 96, "columns": 8, "slots": [0, 1]}
    with opened(browser, [folder]) as (tab, said):
        assert tab.locator("#running").is_hidden()
        for number in (1, 2):
            head = {"type": "wall", "process": "box-1", "host": "box", "number": number, **numbers, **told}
            write_frame(folder, "box-1", pack(head, buffer.getvalue()))
            tab.wait_for_selector(f"#walls canvas[data-frames='{number}']", timeout=20_000)
        assert "libero_goal/0/4" in tab.locator("#walls").inner_text()
        assert tab.locator("#state").inner_text() == "running"
        ResultStore.open(folder).append(some_records(lambda *_: True)[4:])
        tab.wait_for_function("() => document.querySelector('#found').textContent === '10 episodes'", timeout=20_000)
        assert tab.locator(".run .rate").inner_text().startswith("60.0%")
        write_frame(folder, "box-1", None)
        tab.wait_for_selector("#running", state="hidden", timeout=20_000)
        assert said == []
