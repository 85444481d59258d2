"""The words around a query: prompt files, the chat messages of a request, and the code in an answer.

In: an LMP's options, its examples and a query. Out: messages for ``voxposer.language.llm``, and the code that a reply
holds.
"""

from __future__ import annotations

import functools
import re
import textwrap
from collections.abc import Sequence
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path

from voxposer.language.lmp_config import NAMES, LmpConfig
from voxposer.language.replies import Message

_SYSTEM = "You program a robot arm that works at a table. You write short, careful Python and answer with code only."
_TASK = """Queries are for `{name}`. Each is answered by a short program in the manner of these examples:

```
{prompt}
```

Answer every query I send next with the program for it, and nothing else: no imports, no prose (comments are welcome), \
and not the query again. Use what the examples use, in the same way. Coordinates: x runs from back to front, y from \
left to right, z from bottom to top."""
_REPAIR = """That program cannot be used: {error}
Answer the same query again with the whole corrected program, and nothing else."""
_READY = "Understood. Send me a query and I answer with its program."


def chat_messages(config: LmpConfig, prompt: str, context: str, query: str) -> list[Message]:
    """The request for a query: the examples first, then the query with its context line."""
    return [
        {"role": "system", "content": _SYSTEM},
        {"role": "user", "content": _task(config.name, prompt)},
        {"role": "assistant", "content": _READY},
        {"role": "user", "content": lines(context, query_line(config, query))},
    ]


@functools.lru_cache(maxsize=64)
def _task(name: str, prompt: str) -> str:
    """The first message; one object for all questions, because traces keep their messages."""
    return _TASK.format(name=name, prompt=prompt)


def repair_messages(
    config: LmpConfig, asked: Sequence[Message], reply: str, error: str, context: str, query: str
) -> list[Message]:
    """A second request for a query: the first one, its answer, what was wrong with that, and the query again."""
    said = _REPAIR.format(error=" ".join(error.split()))
    return [
        *asked,
        {"role": "assistant", "content": reply},
        {"role": "user", "content": lines(said, context, query_line(config, query))},
    ]


def load_prompts(prompts_dir: str | Path | None = None) -> dict[str, str]:
    """The examples of each LMP, from the package or a folder.

    Raises:
        FileNotFoundError: a prompt is missing.
    """
    where = resources.files("voxposer") / "prompts" if prompts_dir is None else Path(prompts_dir)
    return {name: _prompt_file(where, name).read_text(encoding="utf-8").strip() for name in NAMES}


def _prompt_file(where: Traversable, name: str) -> Traversable:
    files = [where / f"{name}.txt", where / f"{name}_prompt.txt"]
    found = next((file for file in files if file.is_file()), None)
    if found is None:
        raise FileNotFoundError(f"no prompt for {name}: neither {name}.txt nor {name}_prompt.txt is in {where}")
    return found


def code_in(text: str) -> str:
    """The code in a model's answer: what stands in fences, if there are any, without common indentation."""
    fenced = re.findall(r"^[ \t]*```[^\n]*\n(.*?)(?:^[ \t]*```|\Z)", text, re.DOTALL | re.MULTILINE)
    code = "\n".join(block.strip("\n") for block in fenced) if fenced else text.replace("```", "")
    return textwrap.dedent(code.replace("\r\n", "\n").expandtabs(4).strip("\n")).rstrip()


def query_line(config: LmpConfig, query: str) -> str:
    """The line that asks a query."""
    return f"{config.query_prefix}{query}{config.query_suffix}"


def lines(*parts: str) -> str:
    """The parts that are not empty, one a line."""
    return "\n".join(part for part in parts if part)
