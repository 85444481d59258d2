"""A headless Chromium for tests of pages."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import pytest


@contextmanager
def chromium(flags: Sequence[str] = ("--no-sandbox",)) -> Iterator[Any]:
    """The installed one, else playwright's; the test is skipped where there is neither."""
    from playwright import sync_api

    with sync_api.sync_playwright() as playwright:
        try:
            browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=list(flags))
        except sync_api.Error:
            pytest.skip("needs a Chromium: apt-get install chromium, or playwright install chromium")
        yield browser
        browser.close()
