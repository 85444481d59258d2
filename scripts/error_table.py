"""The tables of docs/errors.md: every class of error, what causes it, and what to do.

    python scripts/error_table.py           # writes docs/errors.md
    python scripts/error_table.py --check   # exit status 1 if the page is not up to date

Classes and causes are read from the source (the first sentence of the docstring), so that optional packages need not be
installed. What to do is in scripts/error_cures.toml; a class without an entry, or an entry without a class, is an
error.
"""

from __future__ import annotations

import argparse
import ast
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "errors.md"
PACKAGES = {"vecenv": ROOT / "vecenv", "voxposer": ROOT / "voxposer", "vecenv_eval": ROOT / "eval" / "vecenv_eval"}
BASE = "VecenvError"
# Kinds as they are in vecenv/errors.py -> the exit status of a command that ends with one (vecenv/cli.py).
KINDS = {
    "InvalidInput": 2,
    "NotFound": 2,
    "InvalidFile": 1,
    "MissingDependency": 1,
    "SimulationError": 1,
    "ServiceError": 1,
    BASE: 1,
}
BEGIN, END = "<!-- errors -->", "<!-- end errors -->"

# Module and class -> what to do.
CURES: Mapping[str, str] = tomllib.loads((ROOT / "scripts" / "error_cures.toml").read_text())


@dataclass(frozen=True)
class ErrorClass:
    """A class of error: where it is, the classes that it derives from by name, and the first sentence about it."""

    module: str
    name: str
    bases: tuple[str, ...]
    cause: str

    @property
    def key(self) -> str:
        """Its module and name."""
        return f"{self.module}.{self.name}"


def _module(root: Path, path: Path, package: str) -> str:
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join((package, *(part for part in parts if part != "__init__")))


def _cause(node: ast.ClassDef) -> str:
    paragraph = " ".join((ast.get_docstring(node) or "").split("\n\n")[0].split())
    return paragraph.replace("``", "`")


def error_classes() -> list[ErrorClass]:
    """Public classes that derive from ``VecenvError``, by module; the kinds of vecenv/errors.py are among them."""
    found = [
        ErrorClass(
            _module(root, path, package),
            node.name,
            tuple(ast.unparse(b).split(".")[-1] for b in node.bases),
            _cause(node),
        )
        for package, root in PACKAGES.items()
        for path in sorted(root.rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ClassDef)
    ]
    names, before = {BASE}, 0
    while len(names) > before:
        before = len(names)
        names |= {each.name for each in found if names & set(each.bases)}
    return [each for each in found if (names & set(each.bases) or each.name == BASE) and not each.name.startswith("_")]


def kind_of(error: ErrorClass, classes: Sequence[ErrorClass]) -> str:
    """The class of vecenv/errors.py that an error derives from; ``VecenvError`` if it is none of the six."""
    for base in error.bases:
        if base in KINDS:
            return base
    parents = [each for base in error.bases for each in classes if each.name == base]
    return next(kind for each in parents if (kind := kind_of(each, classes)))


def tables() -> str:
    """The Markdown between the marks of docs/errors.md.

    Raises:
        SystemExit: a class has no cure, or a cure no class.
    """
    classes = error_classes()
    ours = [each for each in classes if each.module != "vecenv.errors"]
    if wrong := {each.key for each in ours} ^ CURES.keys():
        raise SystemExit(f"scripts/error_table.py: no cure, or no such class: {', '.join(sorted(wrong))}")
    lines = ["## Kinds", "", "| class | also a | raised for | exit status |", "|---|---|---|---|"]
    for kind, status in KINDS.items():
        (row,) = [each for each in classes if each.module == "vecenv.errors" and each.name == kind]
        lines.append(f"| `{kind}` | `{row.bases[-1]}` | {row.cause} | {status} |")
    for kind in KINDS:
        rows = sorted((each for each in ours if kind_of(each, ours) == kind), key=lambda each: (each.name, each.module))
        if rows:
            lines += [
                "",
                f"## {kind if kind != BASE else 'Others'}",
                "",
                "| class | cause | what to do |",
                "|---|---|---|",
            ]
            lines += [f"| `{e.name}`<br>`{e.module}` | {e.cause} | {CURES[e.key]} |" for e in rows]
    return "\n".join(lines)


def page() -> str:
    """The whole page with its tables up to date."""
    head, _, rest = PAGE.read_text().partition(BEGIN)
    return f"{head}{BEGIN}\n{tables()}\n{END}{rest.partition(END)[2]}"


def main() -> None:
    """Write the page, or compare it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; exit status 1 if the page differs")
    text = page()
    if not parser.parse_args().check:
        PAGE.write_text(text)
    elif text != PAGE.read_text():
        raise SystemExit("docs/errors.md is not up to date: run python scripts/error_table.py")


if __name__ == "__main__":
    main()
