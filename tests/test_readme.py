"""README.md: what a visitor sees first, and where it leads."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest
from support.paths import REPOSITORY

README = REPOSITORY / "README.md"
TEXT = README.read_text()
FENCES = re.findall(r"^```(\w+)\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL)
COMMANDS = [line.split("#")[0].strip() for _, body in FENCES for line in body.splitlines()]
IMAGES = re.findall(r"!\[([^\]]+)\]\(([^)]+)\)", TEXT)
LINKS = [target for target in re.findall(r"\]\(([^)\s]+)\)", TEXT) if "://" not in target]
# What a code host shows without a click, bytes.
LARGEST_FILM, LARGEST_IMAGE = 4_000_000, 200_000


def test_it_opens_with_a_film_and_an_image_then_has_one_table_and_three_commands() -> None:
    film, image = (TEXT.index(f"]({target})") for _, target in IMAGES)
    tables = [match.start() for match in re.finditer(r"^\|(?:---\|)+$", TEXT, re.MULTILINE)]
    assert len(tables) == 1
    assert film < image < tables[0] < TEXT.index("```")
    assert TEXT.count("\n", 0, film) < 10
    assert [kind for kind, _ in FENCES] == ["bash"]
    assert COMMANDS == ["make eval", "make test", "make docs"]
    assert "\n## " not in TEXT, "what is longer is a page of docs/"


def test_the_film_is_small_plays_for_seconds_and_begins_again() -> None:
    Image = pytest.importorskip("PIL.Image")
    path = REPOSITORY / IMAGES[0][1]
    assert path.stat().st_size <= LARGEST_FILM
    milliseconds = 0
    with Image.open(path) as film:
        assert film.info["loop"] == 0, "0 is for ever"
        for number in range(film.n_frames):
            film.seek(number)
            film.load()
            milliseconds += film.info["duration"]
    assert 5_000 <= milliseconds <= 12_000
    assert (REPOSITORY / IMAGES[1][1]).stat().st_size <= LARGEST_IMAGE


def anchors(page: Path) -> set[str]:
    """The anchors that code hosts give the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("link", LINKS)
def test_its_links_lead_somewhere(link: str) -> None:
    path, _, anchor = link.partition("#")
    target = REPOSITORY / path
    assert target.is_file()
    assert not anchor or anchor in anchors(target)


def test_the_make_targets_exist(repository: Path) -> None:
    targets = [command.split()[1] for command in COMMANDS]
    targets += re.findall(r"`make ([a-z-]+)`", TEXT)
    for target in targets:
        subprocess.run(["make", "--dry-run", target], cwd=repository, check=True, capture_output=True)
