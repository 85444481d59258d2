"""The page docs/suites.md: every LIBERO suite with its tasks, instructions and images, and LIBERO-PRO's instructions.

python scripts/suite_page.py           # writes the page; images are those of scripts/suite_images.py
python scripts/suite_page.py --check   # exit status 1 if the page is not up to date
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import vecenv

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "suites.md"
IMAGES = ROOT / "docs" / "suites"
SUITES = {
    "libero_spatial": "The same objects in ten arrangements: which bowl is meant is said by where it is.",
    "libero_object": "Ten groceries, one goes into the basket.",
    "libero_goal": "One scene, ten goals.",
    "libero_10": "Ten long tasks of two steps, also called LIBERO-Long.",
    "libero_90": "Ninety short tasks in kitchens, living rooms and studies.",
}
VARIED = {
    "lan": "the instruction in other words",
    "object": "other objects",
    "swap": "objects that changed places",
    "task": "another task in the same scene",
}
HEAD = """# Suites

All suites that LIBERO and LIBERO-PRO have, as `vecenv list` shows them. Every task has 50 stored starts. Images show
the first one, settled, as published, upright and not mirrored (`scripts/suite_images.py`; what policies get is
[turned](rendering.md#which-way-up)). This page is written by `scripts/suite_page.py`. SIMPLER's tasks are in
[SIMPLER](simpler_tasks.md).

```bash
vecenv list
vecenv list libero_goal
```
"""


def lines() -> Iterator[str]:
    """The page's lines."""
    yield HEAD
    yield "| suite | tasks | episodes | what varies |"
    yield "|---|---|---|---|"
    for suite, about in SUITES.items():
        data = vecenv.eval_metadata(suite)
        yield f"| [`{suite}`](#{suite}) | {data['num_tasks']} | {data['num_episodes']:,} | {about} |"
    for suite in SUITES:
        yield from _images(suite)
    yield from _varied()


def _images(suite: str) -> Iterator[str]:
    yield f"\n## {suite}\n"
    yield "| | index | name and instruction |"
    yield "|---|---|---|"
    instructions = vecenv.eval_metadata(suite)["instructions"]
    assert isinstance(instructions, tuple)
    for task, said in zip(vecenv.list_tasks(suite), instructions, strict=True):
        picture = f"![{said}](suites/{suite}/{task.index}.jpg)"
        yield f"| {picture} | {task.index} | `{task.name}`<br>{said} |"


def _varied() -> Iterator[str]:
    yield "\n## LIBERO-PRO\n"
    yield "Sixteen suites that vary four of LIBERO's, ten tasks each: `libero_goal_swap` is `libero_goal` with objects"
    yield "that changed places.\n"
    yield "| suffix | what is varied |"
    yield "|---|---|"
    for suffix, about in VARIED.items():
        yield f"| `_{suffix}` | {about} |"
    for suite in vecenv.list_suites("libero"):
        if suite in SUITES:
            continue
        instructions = vecenv.eval_metadata(suite)["instructions"]
        assert isinstance(instructions, tuple)
        yield f"\n### {suite}\n"
        yield from (f"- {index}: {said}" for index, said in enumerate(instructions))


def main() -> None:
    """Write the page, or compare it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; exit status 1 if the page differs")
    text = "\n".join(lines()) + "\n"
    if not parser.parse_args().check:
        PAGE.write_text(text)
    elif text != PAGE.read_text():
        raise SystemExit("docs/suites.md is not up to date: run python scripts/suite_page.py")


if __name__ == "__main__":
    main()
