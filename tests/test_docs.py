"""The pages of the documentation: their examples run or at least parse, the site builds, and tables match the code."""

from __future__ import annotations

import contextlib
import dataclasses
import html.parser
import importlib.util
import inspect
import io
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest
from support.browser import chromium
from support.examples import Example, check_command, check_python, commands, examples
from support.paths import REPOSITORY

import vecenv
from vecenv import contract

DOCS = REPOSITORY / "docs"
PAGES = sorted([*DOCS.glob("*.md"), REPOSITORY / "examples" / "README.md"])
EXAMPLES = [example for page in PAGES for example in examples(page)]
SHELL = [e for e in EXAMPLES if e.language in ("bash", "") and re.search(r"^(vecenv|make|pip|python) ", e.body, re.M)]
PARSED = [e for e in EXAMPLES if e.language == "python" and (e.kind in ("parsed", "file") or e.heavy)]
RUN = [e for e in EXAMPLES if not e.heavy and (e.kind == "run" or (e.language == "python" and not e.mark))]
HEAVY = [e for e in EXAMPLES if e.heavy]


@pytest.mark.parametrize("example", SHELL, ids=str)
def test_commands_have_options_that_exist(example: Example) -> None:
    for words in commands(example.body):
        check_command(words)


@pytest.mark.parametrize(
    "line",
    [
        "vecenv eval --suite libero_object --no-such-option",
        "vecenv eval --suite libero_objects",
        "vecenv eval --suite libero_object --protocol openpie",
        "vecenv evaluate",
        "make tests",
        "pip install 'vecenv[evals]'",
        "python examples/no.py",
        "vecenvs list",
    ],
)
def test_wrong_commands_are_found(line: str) -> None:
    (words,) = commands(line)
    with pytest.raises((Exception, SystemExit)):
        check_command(words)


@pytest.mark.parametrize("example", PARSED, ids=str)
def test_python_that_is_not_run_compiles_and_imports_what_exists(example: Example) -> None:
    check_python(example)
    assert example.kind in ("file", "run") or re.match(r"parsed: \w", example.mark), "say why it is not run"


def test_every_mark_is_known() -> None:
    for example in EXAMPLES:
        assert example.kind in ("", "run", "file", "parsed"), f"{example}: {example.mark}"
    marks = sum(page.read_text().count("<!-- example:") for page in PAGES)
    assert marks == sum(bool(example.mark) for example in EXAMPLES), "a mark that stands before no example"


def run(example: Example, folder: Path, namespace: dict[str, Any]) -> None:
    """Run one example and compare what it prints, if the page says that."""
    if example.kind == "file":
        (folder / example.mark.split()[1]).write_text(example.body)
        return
    if example.language == "python":
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(example.body, str(example), "exec"), namespace)
        assert example.expected is None or printed.getvalue() == example.expected
        return
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    for words in commands(example.body):
        done = subprocess.run(
            words, cwd=folder, env={**os.environ, "PATH": path}, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, f"{example}: {' '.join(words)}\n{done.stdout}\n{done.stderr}"


@pytest.mark.parametrize("page", sorted({e.page for e in RUN}), ids=lambda page: page.name)
def test_examples_run_and_print_what_the_page_says(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, Any] = {}
    for example in examples(page):
        if example in RUN or example.kind == "file":
            run(example, tmp_path, namespace)


@pytest.mark.heavy
@pytest.mark.parametrize("example", HEAVY, ids=str)
def test_heavy_examples_run(example: Example, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    run(example, tmp_path, {})


# -- tables ------------------------------------------------------------------------------------------------------------


def first_cells(page: str, heading: str) -> list[list[str]]:
    """The rows of the table under a heading, without its head."""
    section = (DOCS / page).read_text().split(f"\n## {heading}\n")[1].split("\n## ")[0]
    rows = [line for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in row.strip("|").split(" | ")] for row in rows[2:]]


def test_the_contract_lists_every_method_with_its_arguments() -> None:
    methods = {
        name: value
        for name, value in vars(contract.BatchEnv).items()
        if inspect.isfunction(value) and not name.startswith("_")
    }
    rows = {cells[0].strip("`").split("(")[0]: cells for cells in first_cells("contract.md", "Methods")}
    assert rows.keys() == methods.keys()
    for name, method in methods.items():
        signature = inspect.signature(method)
        shown = ["*" if p.kind is p.KEYWORD_ONLY else "" for p in signature.parameters.values()]
        words = [p for p in signature.parameters if p != "self"]
        if "*" in shown:
            words.insert(shown.index("*") - 1, "*")
        assert rows[name][0] == f"`{name}({', '.join(words)})`"
        assert rows[name][2].strip(" |`") == str(signature.return_annotation)


def test_the_contract_lists_every_attribute_and_field() -> None:
    text = (DOCS / "contract.md").read_text()
    (line,) = re.findall(r"^Attributes: (.*)\.$", text, re.MULTILINE)
    properties = {name for name, value in vars(contract.BatchEnv).items() if isinstance(value, property)}
    assert set(line.replace("`", "").split(", ")) == properties | set(contract.BatchEnv.__annotations__)
    for name, fields in first_cells("contract.md", "What they return"):
        kind = getattr(contract, name.strip("`"))
        inherited = {f.name for f in dataclasses.fields(contract.Control)} if "those of" in fields else set()
        assert {f.name for f in dataclasses.fields(kind)} == inherited | set(re.findall(r"`([a-z_]+)`", fields))


def script(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(f"scripts_{name}", REPOSITORY / "scripts" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_every_error_is_in_the_table(monkeypatch: pytest.MonkeyPatch) -> None:
    table = script("error_table")
    assert table.page() == table.PAGE.read_text(), "run python scripts/error_table.py"
    known = {each.key for each in table.error_classes()}
    pending = [vecenv.VecenvError]
    while pending:  # every class that this process has imported, however it came about
        for each in (found := pending.pop()).__subclasses__():
            pending.append(each)
        ours = found.__module__.split(".")[0] in table.PACKAGES and not found.__name__.startswith("_")
        assert not ours or f"{found.__module__}.{found.__name__}" in known
    monkeypatch.setattr(table, "CURES", {key: cure for key, cure in table.CURES.items() if "UnknownSuite" not in key})
    with pytest.raises(SystemExit, match=r"no cure.*vecenv\.libero\.tasks\.suites\.UnknownSuite"):
        table.tables()


def test_the_page_of_suites_is_up_to_date() -> None:
    suites = script("suite_page")
    assert "\n".join(suites.lines()) + "\n" == suites.PAGE.read_text(), "run python scripts/suite_page.py"
    assert sum(path.stat().st_size for path in suites.IMAGES.rglob("*.jpg")) < 3e6


# -- the site ----------------------------------------------------------------------------------------------------------


class Page(html.parser.HTMLParser):
    """Of a page: what it loads, where it links to, and its anchors."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.links: list[str] = []
        self.anchors: set[str] = {""}
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {key: value or "" for key, value in attrs}
        self.anchors |= {values[key] for key in ("id", "name") if key in values}
        if tag == "a" and "href" in values:
            self.links.append(values["href"])
        elif tag == "link":
            self.loads.append(values["href"])
        self.loads += [values[key] for key in ("src", "srcset", "poster", "data") if key in values]


def build(site: Path, config: Path = REPOSITORY / "mkdocs.yml") -> subprocess.CompletedProcess[str]:
    command = [
        sys.executable,
        "-m",
        "mkdocs",
        "build",
        "--strict",
        "--config-file",
        str(config),
        "--site-dir",
        str(site),
    ]
    return subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> dict[Path, Page]:
    pytest.importorskip("mkdocs")
    pytest.importorskip("material")
    folder = tmp_path_factory.mktemp("site")
    done = build(folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return {path: Page(path) for path in folder.rglob("*.html")}


def test_every_page_is_in_the_site(site: dict[Path, Page]) -> None:
    names = {path.stem for path in site}
    assert {page.stem for page in DOCS.glob("*.md")} | {"project", "CONTRIBUTING", "CHANGELOG"} <= names


def test_pages_load_nothing_from_elsewhere(site: dict[Path, Page]) -> None:
    (folder,) = {path.parent for path in site if path.name == "index.html"}
    for path, page in site.items():
        for target in page.loads:
            assert not urlsplit(target).scheme or target.startswith("data:"), f"{path.name} loads {target}"
    for path in [*folder.rglob("*.css"), *folder.rglob("*.js"), *folder.rglob("*.html")]:
        text = path.read_text()
        assert not re.search(r"unpkg\.com|googleapis|gstatic|google-analytics|cdnjs|jsdelivr", text), path
        assert path.suffix != ".css" or not re.search(r"(?:url\(|@import\s*)[\"']?(?:https?:)?//", text), path


def test_links_of_the_site_lead_somewhere(site: dict[Path, Page]) -> None:
    for path, page in site.items():
        if path.name == "404.html":  # its links are absolute: a server shows it anywhere
            continue
        for link in page.links + page.loads:
            parts = urlsplit(link)
            if parts.scheme:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            assert target.is_file(), f"{path.name}: {link}"
            if target in site:
                assert unquote(parts.fragment) in site[target].anchors, f"{path.name}: {link}"


@pytest.mark.parametrize(
    "text", ["[a](missing.md)", "[a](contract.md#no-such-heading)", "[a](../vecenv/no_such_module.py)", "![a](no.jpg)"]
)
def test_a_broken_link_fails_the_build(text: str, tmp_path: Path) -> None:
    pytest.importorskip("material")
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "index.md").write_text(f"# A\n\n{text}\n")
    (tmp_path / "docs" / "contract.md").write_text("# The contract\n")
    config = (REPOSITORY / "mkdocs.yml").read_text().split("\nnav:")[0]
    config = config.replace("scripts/site_hooks.py", str(REPOSITORY / "scripts" / "site_hooks.py"))
    (tmp_path / "mkdocs.yml").write_text(config)
    done = build(tmp_path / "site", tmp_path / "mkdocs.yml")
    assert done.returncode != 0
    assert "WARNING" in done.stderr


@pytest.mark.parametrize("width", [400, 1200])
def test_the_folder_works_without_a_server(site: dict[Path, Page], width: int) -> None:
    pytest.importorskip("playwright")
    (index,) = [path for path in site if path.name == "index.html"]
    with chromium() as browser:
        page = browser.new_page(viewport={"width": width, "height": 800})
        asked: list[str] = []
        page.on("request", lambda request: asked.append(request.url))
        errors: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(index.as_uri())
        page.keyboard.press("/")
        page.keyboard.type("quarantined")
        page.locator(".md-search-result__item a").first.wait_for()
        assert page.locator(".md-search-result__item").count() >= 1
        assert all(url.startswith(("file:", "data:", "about:", "blob:")) for url in asked), asked
        assert not errors
