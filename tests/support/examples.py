"""Fenced examples of Markdown pages, and what is checked of a command line without running it.

An example may have a mark in the line before it, ``<!-- example: MARK -->``:

* ``run``: commands are run in the page's folder (Python is run without a mark);
* ``run, heavy: WHY``: so are these, in a test marked heavy;
* ``file NAME``: written to the page's folder, for the examples below it;
* ``parsed: WHY``: Python that is only compiled and whose imports are looked up.

Commands without a mark are parsed: options of ``vecenv``, make targets, extras, files.
"""

from __future__ import annotations

import ast
import importlib
import itertools
import re
import shlex
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer.main

import vecenv
from support.paths import REPOSITORY
from vecenv import cli, protocols, registry
from vecenv.errors import MissingDependency

OURS = ("vecenv", "voxposer", "vecenv_eval")
# Programs of others, whose options are not ours to check.
OTHERS = ("cd", "curl", "export", "jq", "lerobot-eval", "tar")
_FENCE = re.compile(
    r"^(?:<!-- example: (?P<mark>.+?) -->\n)?^(?P<indent> *)```(?P<language>\w*)\n(?P<body>.*?)^ *```$",
    re.MULTILINE | re.DOTALL,
)


@dataclass(frozen=True)
class Example:
    """One fenced block: its page, line, language, text, mark, and what the ``text`` block right after it says."""

    page: Path
    line: int
    language: str
    body: str
    mark: str = ""
    expected: str | None = None

    def __str__(self) -> str:
        return f"{self.page.name}:{self.line}"

    @property
    def kind(self) -> str:
        """The first word of the mark."""
        return re.split(r"[\s,:]", self.mark)[0]

    @property
    def heavy(self) -> bool:
        return self.mark.startswith("run, heavy: ")


def examples(page: Path) -> list[Example]:
    """The fenced blocks of a page, in order."""
    text = page.read_text()
    matches = list(_FENCE.finditer(text))
    found = []
    for match, following in itertools.zip_longest(matches, matches[1:]):
        said = None
        if following and following["language"] == "text" and not text[match.end() : following.start()].strip():
            said = following["body"]
        line = text.count("\n", 0, match.start()) + 1
        found.append(Example(page, line, match["language"], match["body"], match["mark"] or "", said))
    return found


def commands(body: str) -> Iterator[list[str]]:
    """The commands of a shell example, each split into words; variables before them and what follows a pipe are left
    out.
    """
    for line in body.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        while words and re.match(r"[A-Z_]+=", words[0]):
            words = words[1:]
        if words:
            yield words[: words.index("|")] if "|" in words else words


def check_command(words: Sequence[str]) -> None:
    """Raise for a command that cannot be right."""
    program, *arguments = words
    match program:
        case "vecenv":
            parse_vecenv(arguments)
        case "make":
            targets = re.findall(r"^([a-z-]+):", (REPOSITORY / "Makefile").read_text(), re.MULTILINE)
            assert arguments[0] in targets, f"make has no target {arguments[0]}"
        case "pip":
            _check_pip(arguments)
        case "python":
            folders = (REPOSITORY, REPOSITORY / "examples")
            assert any((folder / arguments[0]).exists() for folder in folders), f"no file {arguments[0]}"
        case "pytest":
            for word in arguments:
                assert not word.startswith("tests/") or (REPOSITORY / word).exists(), f"no file {word}"
        case _:
            assert program in OTHERS, f"what is {program}?"


def parse_vecenv(arguments: Sequence[str]) -> None:
    """Parse a command line of ``vecenv``, as it would be, without running the command."""
    command: Any = typer.main.get_command(cli.build_app())
    rest, context, name = list(arguments), None, "vecenv"
    while True:
        context = command.make_context(name, rest, parent=context)
        if not hasattr(command, "resolve_command"):
            break
        name, command, rest = command.resolve_command(context, [*context._protected_args, *context.args])
    values = context.params
    given = values.get("suite") or []
    suites = given.split(",") if isinstance(given, str) else given
    for suite in suites:
        assert suite in vecenv.list_suites(), f"no suite {suite}"
    if suites and isinstance(values.get("protocol"), str):
        protocols.protocol(values["protocol"], registry.family_name(suites[0]))


def _check_pip(arguments: Sequence[str]) -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    for word in arguments:
        if match := re.search(r"(?:^\.|vecenv)\[([\w,-]+)\]", word):
            unknown = set(match[1].split(",")) - project["optional-dependencies"].keys()
            assert not unknown, f"no extra {unknown}"


def check_python(example: Example) -> None:
    """Raise for Python that does not compile, or that imports what this project does not have."""
    tree = ast.parse(example.body, str(example))
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in OURS:
            try:
                module = importlib.import_module(node.module)
            except MissingDependency:
                continue  # it exists, and needs a package that is not here
            for alias in node.names:
                if not hasattr(module, alias.name):
                    importlib.import_module(f"{node.module}.{alias.name}")
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "vecenv":
            assert hasattr(vecenv, node.attr), f"vecenv has no {node.attr}"
