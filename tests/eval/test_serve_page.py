"""The page of ``vecenv serve`` in a real browser, before a server whose episodes are counters.

Needs playwright and a Chromium: Debian's package ``chromium``, or ``playwright install chromium``. With
``VECENV_SCREENSHOTS=FOLDER`` what the browser shows is kept there.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
pytest.importorskip("fastapi", reason="needs fastapi: pip install 'vecenv[serve]'")
from support.browser import chromium
from support.panel_server import World, free_port, make_app, playing, serving

WIDE, PHONE = {"width": 1440, "height": 900}, {"width": 400, "height": 800}
HOSTILE = (
    "<img src=x onerror=document.title='owned'><b>put</b> the \u202ebowl</option></select><script>alert(1)</script>"
)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as found:
        yield found


class Page:
    """A tab with the page, and everything it complained about."""

    def __init__(self, browser: Any, world: World, port: int | None = None, **options: Any) -> None:
        self._stack = ExitStack()
        self.world, self.port = world, port or free_port()
        self._stack.enter_context(playing(world))
        self._server = ExitStack()
        self.start()
        self.said: list[str] = []
        self.tab = browser.new_page(**{"viewport": WIDE, **options})
        self.tab.on("console", lambda each: self.said.append(each.text) if each.type in ("error", "warning") else None)
        self.tab.on("pageerror", lambda error: self.said.append(str(error)))
        self.tab.on("request", lambda request: self._local(request.url))
        self.tab.goto(f"http://127.0.0.1:{self.port}/")

    def _local(self, url: str) -> None:
        if not url.startswith((f"http://127.0.0.1:{self.port}/", f"ws://127.0.0.1:{self.port}/", "data:", "blob:")):
            self.said.append(f"asked for {url}")

    def start(self) -> None:
        self._server.enter_context(serving(make_app(self.world), self.port))

    def stop(self) -> None:
        self._server.close()

    def ready(self) -> Page:
        self.tab.wait_for_selector("body[data-ready]", timeout=20_000)
        return self

    def load(self, slots: int = 1, task: str = "0") -> Page:
        self.tab.select_option("#task", task)
        self.tab.fill("#slots", str(slots))
        self.tab.click("#load")
        self.state("ready")
        self.tab.wait_for_selector("#cameras canvas[data-tick]")
        return self

    def text(self, selector: str) -> str:
        return self.tab.locator(selector).text_content()

    def until(self, condition: str) -> None:
        # playwright's own waiting evaluates strings in the page, which the page's policy forbids.
        for _ in range(400):
            if self.tab.evaluate(condition):
                return
            self.tab.wait_for_timeout(50)
        raise AssertionError(f"still not true: {condition}")

    def state(self, name: str) -> None:
        self.until(f"document.getElementById('state').textContent === {name!r}")

    def pixels(self, selector: str) -> str:
        return self.tab.evaluate("selector => document.querySelector(selector).toDataURL()", selector)

    def keep(self, name: str, **options: Any) -> None:
        if folder := os.environ.get("VECENV_SCREENSHOTS"):
            self.tab.screenshot(path=str(Path(folder) / name), **options)

    def close(self) -> None:
        self.tab.close()
        self._server.close()
        self._stack.close()


@pytest.fixture
def opened(browser: Any) -> Iterator[Any]:
    pages: list[Page] = []

    def make(world: World | None = None, **options: Any) -> Page:
        pages.append(Page(browser, world or World(), **options))
        return pages[-1]

    yield make
    for page in pages:
        page.close()


def test_lists_follow_from_the_suite(opened: Any) -> None:
    page = opened().ready()
    assert page.tab.locator("#task option").count() == 4  # three tasks and all of them
    assert page.tab.locator("#episode option").count() == 5
    page.tab.select_option("#suite", "libero_spatial")
    page.until("document.querySelectorAll('#episode option').length === 50")
    assert page.tab.locator("#task option").count() == 11
    page.tab.select_option("#suite", "simpler/widowx")
    page.until("document.querySelectorAll('#episode option').length === 24")
    assert page.said == []


@pytest.mark.parametrize(
    ("task", "episode", "slots", "tasks", "episodes"),
    [("1", "3", 1, "1", "3"), ("0", "2", 3, "0", "2-4"), ("all", "1", 5, "all", "1-2"), ("all", "0", 2, "all", "0")],
)
def test_load_asks_for_what_was_chosen(
    opened: Any, task: str, episode: str, slots: int, tasks: str, episodes: str
) -> None:
    page = opened().ready()
    page.tab.select_option("#task", task)
    page.tab.select_option("#episode", episode)
    page.tab.fill("#slots", str(slots))
    page.tab.locator("#setup summary").click()
    page.tab.fill("#policy-args", 'speed=0.5\nname=fast=er\nkeys=["a"]')
    page.tab.click("#load")
    page.state("ready")
    (body,) = page.world.bodies
    assert body == {
        "suite": "libero_goal",
        "tasks": tasks,
        "episodes": episodes,
        "num_slots": slots,
        "policy": "zero",
        "policy_args": {"speed": 0.5, "name": "fast=er", "keys": ["a"]},
        "env_args": {},
    }
    assert page.said == []


def test_more_slots_than_episodes_is_a_sentence_and_no_request(opened: Any) -> None:
    page = opened().ready()
    page.tab.fill("#slots", "9")
    page.tab.click("#load")
    assert page.text("#problem p") == "There are 5 episodes: from episode 0 on, 5 slots can be filled."
    page.tab.fill("#slots", "2")
    page.tab.locator("#setup summary").click()
    page.tab.fill("#env-args", "lod")
    page.tab.click("#load")
    assert 'Options of the environment: "lod" is not of the form name=value.' in page.text("#problem p")
    assert page.world.bodies == []


def test_a_run_is_played_paused_stepped_and_reset(opened: Any) -> None:
    page = opened().ready().load()
    before = page.pixels("#cameras canvas")
    page.tab.click("#play")
    page.state("playing")
    page.until("parseInt(document.getElementById('steps').textContent) > 4")
    page.tab.click("#play")
    page.state("paused")
    assert page.pixels("#cameras canvas") != before
    tick = page.world.slots[0]["step"]
    page.tab.fill("#ticks", "3")
    page.tab.click("#step")
    page.until(f"document.getElementById('steps').textContent === '{tick + 3} of 60 ticks'")
    assert page.world.slots[0]["step"] == tick + 3
    page.until("document.querySelectorAll('.plot polyline').length === 5")
    assert page.text(".plot >> nth=0 >> text.label.s1").startswith("x ")
    page.tab.click("#reset")
    page.until("document.getElementById('steps').textContent === '0 of 60 ticks'")
    page.state("ready")
    assert page.said == []


def test_the_verdict_and_the_counts_are_shown(opened: Any) -> None:
    page = opened(World(ticks_per_second=400)).ready().load(slots=7, task="all")
    page.tab.click("#play")
    page.state("finished")
    assert page.text("#solved") == "4 of 7 ended"
    assert page.text("#counts") == "0 running4 success2 failure1 fault"
    assert page.text("#verdict") == "success"
    page.tab.fill("#slot", "5")
    page.tab.press("#slot", "Enter")
    assert page.text("#verdict") == "fault: the state is not finite"
    page.tab.locator("#table summary").click()
    page.until("document.querySelectorAll('#table tbody tr').length === 7")
    assert page.tab.locator("#table tbody tr[aria-current] td").first.text_content() == "5"
    page.tab.get_by_role("button", name="Follow slot 1", exact=True).click()
    assert page.text("#verdict") == "failure"
    assert page.said == []


def test_everything_is_reached_with_the_keyboard_alone(opened: Any) -> None:
    page = opened().ready()
    press = page.tab.keyboard.press

    def to(selector: str) -> None:
        for _ in range(40):
            if page.tab.evaluate("selector => document.activeElement.matches(selector)", selector):
                break
            press("Tab")
        else:
            raise AssertionError(f"{selector} is not reached with the tab key")
        style = page.tab.evaluate("getComputedStyle(document.activeElement).outlineStyle")
        assert style != "none", f"{selector} does not show that it has the focus"

    for selector in ("#suite", "#task", "#episode"):
        to(selector)
    press("ArrowDown")  # the list's own key
    assert page.tab.input_value("#episode") == "1"
    to("#slots")
    page.tab.keyboard.type("4") if page.tab.input_value("#slots") == "" else page.tab.keyboard.press("Control+A")
    page.tab.keyboard.type("4")
    press("Enter")
    page.state("ready")
    to("#play")
    press("Space")
    page.state("playing")
    press("Space")
    page.state("paused")
    page.tab.evaluate("document.activeElement.blur()")
    press("Space")
    page.state("playing")
    press("Space")
    page.state("paused")
    ticks = page.world.tick
    press(".")
    page.until(f"document.getElementById('batch').textContent.includes('tick {ticks + 1}')")
    press("ArrowRight")
    assert page.tab.input_value("#slot") == "1"
    assert page.text("#announced").startswith("Slot 1: put the bowl on the plate")
    to("#wall")
    press("End")
    assert page.tab.input_value("#slot") == "3"
    assert page.tab.get_attribute("#wall", "aria-valuetext") == "slot 3, live"
    press("ArrowLeft")
    assert page.tab.input_value("#slot") == "2"
    press("r")
    page.state("ready")
    press("?")
    assert page.tab.locator("#help").is_visible()
    press("Escape")
    assert not page.tab.locator("#help").is_visible()
    assert page.said == []


def test_keys_can_be_switched_off(opened: Any) -> None:
    page = opened().ready().load()
    page.tab.click("#help-open")
    page.tab.uncheck("#shortcuts")
    page.tab.keyboard.press("Escape")
    page.tab.evaluate("document.activeElement.blur()")
    page.tab.keyboard.press(".")
    page.tab.wait_for_timeout(200)
    assert page.world.tick == 0


def test_text_is_never_markup(opened: Any) -> None:
    plan = {
        "slot": 0,
        "instruction": HOSTILE,
        "subtasks": [HOSTILE, "open"],
        "subtask": 0,
        "text": HOSTILE,
        "path": [],
        "waypoints": [{"pos": [0.1, 0.2, 0.3], "quat": [1, 0, 0, 0], "closed": True}],
        "cause": HOSTILE,
        "tick": 3,
    }
    page = opened(World(instruction=HOSTILE, planning=plan)).ready().load(slots=2)
    page.world.slots[1].update(truncated=True, fault=HOSTILE, episode_id=HOSTILE)
    page.tab.locator("#table summary").click()
    page.until("document.querySelectorAll('#table tbody tr').length === 2")
    page.tab.keyboard.press("ArrowRight")
    page.world.refusal = HOSTILE
    page.tab.click("#reset")
    page.until("!document.getElementById('problem').hidden")
    assert page.text("#problem p") == HOSTILE
    assert page.text("#instruction") == HOSTILE
    page.tab.fill("#slot", "0")
    page.tab.press("#slot", "Enter")
    page.until("!document.getElementById('planning').hidden")
    assert page.text("#subtasks li >> nth=0") == HOSTILE
    assert page.tab.title() == "vecenv"
    assert page.tab.locator("main img, main b, main script, .all img, #problem img").count() == 0
    assert [each for each in page.said if "409" not in each] == []


def test_the_plan_is_shown_with_its_present_subtask(opened: Any) -> None:
    stops = [{"pos": [0.1 * i, 0.2, 0.3], "quat": [1, 0, 0, 0], "closed": i > 1} for i in range(3)]
    plan = {
        "slot": 0,
        "instruction": "i",
        "subtasks": ["grasp the bowl", "back to default pose", "move to the plate"],
        "subtask": 4,  # the second one of the second pass
        "text": "back to default pose",
        "path": [],
        "waypoints": stops,
        "cause": "",
        "tick": 12,
    }
    page = opened(World(planning=plan)).ready().load()
    page.until("!document.getElementById('planning').hidden")
    assert page.text("#subtasks [aria-current]") == "back to default pose"
    page.tab.locator("#waypoints summary").click()
    rows = page.tab.locator("#waypoints tr").all_text_contents()
    assert rows[1:] == ["10.0000.2000.300open", "20.1000.2000.300open", "30.2000.2000.300closed"]


def test_a_refusal_is_one_sentence_until_the_next_success(opened: Any) -> None:
    page = opened().ready().load()
    page.world.refusal = "another client drives this: try again when it has let go"
    page.tab.click("#play")
    page.until("!document.getElementById('problem').hidden")
    assert page.text("#problem p") == page.world.refusal
    page.world.refusal = None
    page.tab.click("#play")
    page.state("playing")
    assert page.tab.locator("#problem").is_hidden()


def test_the_error_of_the_session_is_shown(opened: Any) -> None:
    page = opened().ready().load()
    page.world.error = "the policy raised ValueError: no weights"
    page.until("!document.getElementById('problem').hidden")
    assert page.text("#problem p") == page.world.error
    page.tab.click("#problem button")
    page.tab.click("#step")
    page.until("document.getElementById('steps').textContent.startsWith('1 of')")
    assert page.tab.locator("#problem").is_hidden()  # it was read


def test_the_3d_view_is_opened_on_request_and_told_the_slot(opened: Any) -> None:
    page = opened().ready().load(slots=3)
    assert page.tab.locator("#view3d").is_hidden()
    with serving(make_app(World()), free_port()) as address:
        page.world.url_3d = f"{address}/static/style.css"
        page.tab.wait_for_selector("#view3d summary")
        assert page.tab.locator("iframe").count() == 0
        page.tab.click("#view3d summary")
        page.tab.wait_for_selector("#view3d iframe")
        page.until("document.querySelector('#view3d iframe').contentWindow.length === 0")
        page.tab.keyboard.press("ArrowRight")
        page.until("document.getElementById('slot').value === '1'")
        page.tab.wait_for_timeout(200)
        assert page.world.shown[-1] == 1
        assert page.tab.get_attribute("#view3d-link", "href") == page.world.url_3d
    assert page.said == [f"asked for {page.world.url_3d}"]  # and nothing about the page's policy


def test_it_connects_again_when_the_server_comes_back(opened: Any) -> None:
    page = opened().ready().load(slots=2)
    page.stop()
    page.state("no connection")
    page.until("document.getElementById('problem').textContent.includes('does not answer')")
    assert page.tab.get_attribute("#play", "aria-disabled") == "true"
    page.start()
    page.state("ready")
    assert page.tab.locator("#problem").is_hidden()
    page.tab.click("#play")
    page.until("parseInt(document.getElementById('steps').textContent) > 2")


def test_a_token_is_asked_for(opened: Any) -> None:
    page = opened(World(token="correct horse battery"))
    page.tab.wait_for_selector("#login[open]")
    page.tab.fill("#token", "wrong")
    page.tab.press("#token", "Enter")
    page.until("document.getElementById('login-problem').textContent !== ''")
    page.tab.fill("#token", "correct horse battery")
    page.tab.press("#token", "Enter")
    page.ready()
    assert not page.tab.locator("#login").is_visible()
    assert "correct horse" not in page.tab.url


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_fits_a_phone(opened: Any, scheme: str) -> None:
    page = opened(viewport=PHONE, color_scheme=scheme).ready()
    assert page.tab.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    page.load(slots=12, task="all")
    page.tab.locator("#table summary").click()
    page.tab.click("#play")
    page.until("parseInt(document.getElementById('steps').textContent) > 10")
    assert page.tab.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    page.keep(f"serve-phone-{scheme}.png", full_page=True)
    assert page.said == []


def test_light_and_dark(opened: Any) -> None:
    page = opened(color_scheme="dark").ready()

    def brightness() -> int:
        color = page.tab.evaluate("getComputedStyle(document.body).backgroundColor")
        return sum(map(int, color[4:-1].split(",")[:3]))

    assert brightness() < 200
    page.tab.click("#theme")
    assert page.text("#theme") == "Theme: light"
    assert brightness() > 600
    page.tab.reload()
    page.ready()
    assert brightness() > 600
    page.tab.click("#theme")
    assert brightness() < 200


def test_hundreds_of_tiles_are_drawn_within_a_frame(opened: Any) -> None:
    page = opened(World(budget=5000, solves_at=30)).ready()
    page.tab.select_option("#suite", "libero_spatial")
    page.until("document.querySelectorAll('#episode option').length === 50")
    page.load(slots=400, task="all")
    page.until("document.getElementById('wall').dataset.count === '400'")
    page.tab.click("#play")
    page.until("Number(document.getElementById('wall').dataset.frames) > 5")
    times = page.tab.evaluate(
        """async () => {
            const wall = document.getElementById("wall"), times = [], between = [];
            let last = await new Promise(requestAnimationFrame);
            while (times.length < 20) {
                const before = wall.dataset.frames;
                const now = await new Promise(requestAnimationFrame);
                between.push(now - last);
                last = now;
                if (wall.dataset.frames === before) continue;
                const began = performance.now();
                wall.getContext("2d").getImageData(0, 0, 1, 1); // what was drawn so far is painted now
                times.push(Number(wall.dataset.drawMs) + performance.now() - began);
                last = await new Promise(requestAnimationFrame);
            }
            const sorted = (list) => list.sort((a, b) => a - b);
            return { times: sorted(times), between: sorted(between) };
        }"""
    )
    median = times["times"][len(times["times"]) // 2]
    print("draw ms, median and largest", median, times["times"][-1])
    print("ms between frames, median and largest", times["between"][len(times["between"]) // 2], times["between"][-1])
    assert median < 50, f"the wall takes {median} ms to draw"
    columns = int(page.tab.get_attribute("#wall", "data-columns"))
    size = page.tab.locator("#wall").bounding_box()["width"] / columns
    page.tab.locator("#wall").click(position={"x": 2.5 * size, "y": 1.5 * size})
    assert page.tab.input_value("#slot") == str(columns + 2)
    page.keep("serve-wall.png")
    assert [each for each in page.said if "readback" not in each] == []  # of the measurement above
