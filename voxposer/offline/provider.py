"""``offline/libero``: a litellm provider that writes LMP programs by rule, with no network and no key.

A chat request as a language model gets it comes in: prompt, the scene's ``objects = [...]`` line and a query. A program
for that query goes out, or an error that says what was not understood. The language of all LIBERO, LIBERO-PRO and
SIMPLER tasks is covered. It is a grammar, not a model, and results made with it say so.

    import litellm
    from voxposer.offline.provider import register

    register()
    litellm.completion(model="offline/libero", messages=[...])

The writer sees only the messages: it reads the LMP off the prompt and the names of objects off the ``objects`` line. It
never sees positions; the programs compare positions when they run.
"""

from __future__ import annotations

import ast
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from voxposer.offline import map_writer
from voxposer.offline.composer_writer import write_composer
from voxposer.offline.names import NotUnderstood
from voxposer.offline.planner_writer import write_planner
from voxposer.offline.query_writer import write_query

PROVIDER, MODEL = "offline", "offline/libero"
_QUERY = re.compile(r"^# Query: (.*)$", re.MULTILINE)
_OBJECTS = re.compile(r"^objects ?= ?(\[.*\])$", re.MULTILINE)
_NAMED = re.compile(r"Queries are for `(\w+)`")
# A token, roughly as in word-piece vocabularies: up to four letters or three digits with the space before, or one sign.
_TOKEN = re.compile(r" ?[^\W\d_]{1,4}| ?\d{1,3}|\s|[^\s\w]|_")

Writer = Callable[[str, Sequence[str]], str]
_WRITERS: Mapping[str, Writer] = {
    "planner": write_planner,
    "composer": lambda query, _: write_composer(query),
    "parse_query_obj": write_query,
    "get_affordance_map": lambda query, _: map_writer.write_affordance(query),
    "get_avoidance_map": lambda query, _: map_writer.write_avoidance(query),
    "get_rotation_map": lambda query, _: map_writer.write_rotation(query),
    "get_velocity_map": lambda query, _: map_writer.write_velocity(query),
    "get_gripper_map": lambda query, _: map_writer.write_gripper(query),
}
# What only the examples of one LMP's prompt call, in the order in which to look for it.
_SIGNATURES = (
    *((f"get_empty_{kind}_map(", f"get_{kind}_map") for kind in ("affordance", "avoidance", "velocity", "gripper")),
    ("get_empty_rotation_map(", "get_rotation_map"),
    ("detect(", "parse_query_obj"),
    ("composer(", "planner"),
    ("execute(", "composer"),
)


def register() -> None:
    """Make ``offline/...`` a provider of litellm; doing it again changes nothing."""
    # Otherwise importing litellm looks for prices on the network.
    os.environ.setdefault("LITELLM_LOCAL_MODEL_COST_MAP", "True")
    import litellm

    known = [entry for entry in litellm.custom_provider_map if entry["provider"] == PROVIDER]
    if not known:
        litellm.custom_provider_map.append({"provider": PROVIDER, "custom_handler": _handler()})
        litellm.utils.custom_llm_setup()


def write(messages: Sequence[Mapping[str, Any]]) -> str:
    """The program that answers a request.

    Args:
        messages: chat messages; the last one ends with the query line.

    Raises:
        NotUnderstood: what about the request or its query is not understood.
    """
    text = "\n".join(_text(message) for message in messages)
    queries = _QUERY.findall(_text(messages[-1])) if messages else []
    if not queries:
        raise NotUnderstood("the last message has no '# Query: ...' line")
    return _WRITERS[_lmp(text)](queries[-1], _objects(_text(messages[-1])))


def cut(program: str, stop: Sequence[str] = (), max_tokens: int | None = None) -> tuple[str, str]:
    """A reply up to the first stop token and the token limit, and why it ends: "stop" or "length"."""
    ends = [program.find(token) for token in stop if token and token in program]
    text = program[: min(ends)] if ends else program
    tokens = list(_TOKEN.finditer(text))
    if max_tokens is not None and len(tokens) > max_tokens:
        return text[: tokens[max_tokens - 1].end() if max_tokens else 0], "length"
    return text, "stop"


def count_tokens(text: str) -> int:
    """About how many tokens a model would see; word pieces, not a particular model's vocabulary."""
    return len(_TOKEN.findall(text))


def _text(message: Mapping[str, Any]) -> str:
    """A message's text; content may come in parts."""
    content = message.get("content") or ""
    if isinstance(content, str):
        return content
    return "\n".join(part.get("text", "") for part in content)


def _lmp(text: str) -> str:
    """Which LMP a request is for: by its name where it is given, else by what the examples call."""
    named = _NAMED.search(text)
    if named and named[1] in _WRITERS:
        return named[1]
    for call, lmp in _SIGNATURES:
        if call in text:
            return lmp
    raise NotUnderstood("the request does not show which LMP it is for")


def _objects(text: str) -> list[str]:
    lines = _OBJECTS.findall(text)
    try:
        names: list[Any] = ast.literal_eval(lines[-1]) if lines else []
    except (SyntaxError, ValueError):
        names = [None]
    if not all(isinstance(name, str) for name in names):
        raise NotUnderstood(f"not a list of names: objects = {lines[-1]}")
    return names


def _handler() -> Any:
    """The provider as an object of litellm's class."""
    import litellm
    from litellm.llms.custom_llm import CustomLLM, CustomLLMError

    class OfflineWriter(CustomLLM):
        """Answers requests by rule."""

        def completion(self, *args: object, **kwargs: Any) -> litellm.ModelResponse:
            messages, options = kwargs["messages"], kwargs.get("optional_params") or {}
            if kwargs["model"].removeprefix(f"{PROVIDER}/") != MODEL.removeprefix(f"{PROVIDER}/"):
                raise CustomLLMError(status_code=404, message=f"there is no {kwargs['model']!r}, only {MODEL}")
            try:
                program = write(messages)
            except NotUnderstood as error:
                raise CustomLLMError(status_code=400, message=f"{MODEL} does not understand: {error}") from error
            return _response(messages, *cut(program, _stops(options), options.get("max_tokens")))

        async def acompletion(self, *args: object, **kwargs: object) -> litellm.ModelResponse:
            return self.completion(*args, **kwargs)

        def streaming(self, *args: object, **kwargs: object) -> Iterator[Any]:
            raise CustomLLMError(status_code=400, message=f"{MODEL} does not stream")

    return OfflineWriter()


def _stops(options: Mapping[str, Any]) -> list[str]:
    stop = options.get("stop") or []
    return [stop] if isinstance(stop, str) else list(stop)


def _response(messages: Sequence[Mapping[str, Any]], text: str, finish: str) -> Any:
    import litellm

    sent, made = sum(count_tokens(_text(message)) for message in messages), count_tokens(text)
    choice = litellm.Choices(finish_reason=finish, message=litellm.Message(role="assistant", content=text))
    usage = litellm.Usage(prompt_tokens=sent, completion_tokens=made, total_tokens=sent + made)
    return litellm.ModelResponse(model=MODEL, choices=[choice], usage=usage)
