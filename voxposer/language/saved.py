"""Questions and replies of whole episodes in files, and a model that answers from them without being asked.

In: the trace of an episode (``voxposer.language.lmp_config.Call``). Out: plain objects for a JSON Lines file
(:func:`to_lines`), and :class:`SavedReplies`, which reads such files back and answers the same questions with the same
replies. A text of a conversation that is long, such as a prompt, is stored once a file, under a hash.

A line is ``{"text": HASH, "content": ...}`` or a question: ``episode`` and the fields of ``Call``, ``messages`` with
``text`` in place of a long ``content``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from vecenv.errors import InvalidFile, InvalidInput
from voxposer.language.llm import Llm, LlmConfig
from voxposer.language.lmp_config import Call
from voxposer.language.replies import LlmError, Message, Reply

# The folder of such files in a results folder, and characters from which a text is stored once.
FOLDER = "policy_logs"
_LONG = 400
# Fields of a saved question without which it cannot be answered.
_NEEDED = frozenset({"episode", "messages", "stop", "reply", "model", "finish_reason"})


def to_lines(episode: str, calls: Sequence[Call]) -> list[dict[str, Any]]:
    """The questions of one episode, by its name, as plain objects; long texts come before their first question."""
    lines: list[dict[str, Any]] = []
    known: set[str] = set()
    for call in calls:
        messages = []
        for message in call.messages:
            text = message["content"]
            name = _hash(text)
            if len(text) < _LONG:
                messages.append(dict(message))
                continue
            if name not in known:
                known.add(name)
                lines.append({"text": name, "content": text})
            messages.append({"role": message["role"], "text": name})
        values = {name: value for name, value in vars(call).items() if name not in ("messages", "settings", "stop")}
        lines.append(
            {
                "episode": episode,
                **values,
                "messages": messages,
                "stop": list(call.stop),
                "settings": dict(call.settings),
            }
        )
    return lines


class SavedReplies:
    """The replies in the files of a folder.

    Args:
        folder: a results folder, or a folder with the files themselves.

    Attributes:
        model: the model that wrote them.

    Raises:
        InvalidInput: there are none in the folder, or more than one model wrote them.
        InvalidFile: a line of a file is damaged.
    """

    def __init__(self, folder: Path) -> None:
        files = sorted(folder.rglob(f"{FOLDER}/*.jsonl")) or sorted(folder.glob("*.jsonl"))
        self._of_episode: dict[tuple[str, str], list[Reply]] = {}
        self._of_any: dict[str, list[Reply]] = {}
        models = set()
        for file in files:
            for call in _calls(file):
                if call["reply"] is None:
                    continue
                models.add(call["model"])
                name = _key(call["messages"], call["stop"])
                self._of_episode.setdefault((call["episode"], name), []).append(_reply(call))
                self._of_any.setdefault(name, []).append(_reply(call))
        if len(models) != 1:
            said = f"from several models: {', '.join(sorted(models))}" if models else "no replies of a model"
            raise InvalidInput(f"replay={folder}: the folder holds {said}")
        (self.model,) = models

    def find(self, episode: str, messages: Sequence[Message], stop: Sequence[str]) -> list[Reply]:
        """The replies to a request in an episode, in order; those of any episode if that one has none."""
        name = _key(messages, stop)
        return self._of_episode.get((episode, name)) or self._of_any.get(name, [])


class ReplayedLlm(Llm):
    """A model whose replies are saved; nothing is imported, and no network is used.

    Args:
        config: of the model; its name must be that of the model that wrote the replies.
        saved: the replies.
        episode: whose replies are wanted first.
    """

    def __init__(self, config: LlmConfig, saved: SavedReplies, episode: str = "") -> None:
        super().__init__(replace(config, cache=False))
        self._saved, self._episode = saved, episode
        self._given: dict[str, int] = {}

    def for_episode(self, episode: str) -> ReplayedLlm:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The same for another episode, or for one that begins again."""
        return ReplayedLlm(self.config, self._saved, episode)

    def complete(self, messages: Sequence[Message], *, stop: Sequence[str] = (), **options: Any) -> Reply:
        """The saved answer to a conversation; asked again, the next one, and at last the last one again.

        Raises:
            LlmError: no answer to it is saved, or none that could be used.
        """
        found, name = self._saved.find(self._episode, messages, stop), _key(messages, stop)
        if not found:
            asked = " / ".join(messages[-1]["content"].splitlines()) if messages else ""
            where = f" in {self._episode}" if self._episode else ""
            reason = f"the replay has no saved reply to {asked!r}{where} (request {name})"
            raise LlmError(self.config.model, reason, permanent=True)
        number = self._given.get(name, 0)
        self._given[name] = number + 1
        reply = found[min(number, len(found) - 1)]
        for look, given in (("note", reply), ("check", reply.text)):
            if options.get(look) is not None:
                options[look](given)
        return reply


def open_llm(config: LlmConfig, replay: Path | None = None) -> Llm:
    """The model of a config, or saved replies in its place.

    Raises:
        InvalidInput, InvalidFile: as of :class:`SavedReplies`; or another model than the config's wrote them.
    """
    if replay is None:
        return Llm(config)
    saved = SavedReplies(replay)
    if saved.model != config.model:
        raise InvalidInput(f"replay={replay}: {saved.model} wrote these replies, not {config.model}")
    return ReplayedLlm(config, saved)


def _calls(file: Path) -> Iterator[Mapping[str, Any]]:
    """The questions in a file, their long texts put back."""
    if not file.is_file():
        raise InvalidFile(f"{file} is not a regular file")
    texts: dict[str, str] = {}
    for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), start=1):
        try:
            values = json.loads(line)
            if "text" in values:
                texts[values["text"]] = values["content"]
                continue
            missing = _NEEDED - set(values)
            if missing:
                raise KeyError(", ".join(sorted(missing)))
            messages = [
                {"role": each["role"], "content": texts[each["text"]] if "text" in each else each["content"]}
                for each in values["messages"]
            ]
            yield {**values, "messages": messages}
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise InvalidFile(f"{file}:{number} is no saved question: {type(error).__name__}: {error}") from None


def _reply(call: Mapping[str, Any]) -> Reply:
    return Reply(
        text=call["reply"],
        model=call["model"],
        finish_reason=call["finish_reason"],
        prompt_tokens=call.get("prompt_tokens"),
        completion_tokens=call.get("completion_tokens"),
        cost_usd=call.get("cost_usd"),
        cached=True,
    )


def _key(messages: Sequence[Message], stop: Sequence[str]) -> str:
    """What a reply is found by."""
    return _hash(json.dumps([[dict(message) for message in messages], list(stop)], sort_keys=True))


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]
