"""Hooks of mkdocs for the site of `make docs`: pages outside docs/, and links to files that are no pages.

README.md, CONTRIBUTING.md and CHANGELOG.md become pages of the site. A link to another file of the repository, such as
a module, becomes its path as code, because the site is to be complete by itself; one to a file that does not exist is a
warning, which a strict build turns into an error.
"""

from __future__ import annotations

import logging
import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parent.parent
OUTSIDE = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")
# README.md would become the start page of its folder.
RENAMED = {"README.md": "project.md"}
_LINK = re.compile(r"\[([^\]]+)\]\(([^)\s]+)\)")
_FENCE = re.compile(r"^(```.*?^```$)", re.MULTILINE | re.DOTALL)
_log = logging.getLogger("mkdocs.hooks.site")


def on_config(config: Any) -> Any:
    """Put the pages from outside docs/ into the navigation by the names that they get."""
    config["nav"] = _renamed(config["nav"])
    return config


def _renamed(nav: Any) -> Any:
    if isinstance(nav, list):
        return [_renamed(each) for each in nav]
    if isinstance(nav, dict):
        return {title: _renamed(each) for title, each in nav.items()}
    return RENAMED.get(nav, nav)


def on_files(files: Files, config: Any) -> Files:
    """Add the pages from outside docs/."""
    for name in OUTSIDE:
        files.append(
            File.generated(
                config, RENAMED.get(name, name), content=repository_links((ROOT / name).read_text(), name, "")
            )
        )
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Resolve links of the pages of docs/ that lead out of it."""
    if page.file.generated_by:
        return markdown
    return repository_links(markdown, page.file.src_uri, "docs")


def on_post_build(config: Any) -> None:
    """Let the theme's script ask no other host: it does so for diagrams, which no page has, and for old browsers."""
    for path in Path(config["site_dir"]).glob("assets/javascripts/*.js"):
        text = path.read_text()
        path.write_text(re.sub(r"https://unpkg\.com/[^\"']*", "data:text/javascript,", text))


def repository_links(markdown: str, page: str, folder: str) -> str:
    """The text of a page with its links made fit for the site.

    Args:
        markdown: the text.
        page: the page's name for warnings.
        folder: the folder of the repository that links of the page are relative to.
    """

    def replaced(match: re.Match[str]) -> str:
        text, target = match.groups()
        if re.match(r"[a-z]+:|#", target):
            return match.group(0)
        path, hash_sign, anchor = target.partition("#")
        place = posixpath.normpath(posixpath.join(folder, path))
        if place.startswith("docs/"):
            return f"[{text}]({place.removeprefix('docs/')}{hash_sign}{anchor})"
        if place in OUTSIDE:
            return f"[{text}]({RENAMED.get(place, place)}{hash_sign}{anchor})"
        if not (ROOT / place).exists():
            _log.warning("%s: the link to %s leads nowhere", page, target)
        return text if text.startswith("`") else f"{text} (`{place}`)"

    parts = _FENCE.split(markdown)
    return "".join(part if part.startswith("```") else _LINK.sub(replaced, part) for part in parts)
