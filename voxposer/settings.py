"""Every option of VoxPoser by its name: which model, how it is asked, and all fields of the agent's configs.

In: names and values, as ``--policy-arg`` and YAML files give them. Names of nested options are written with dots
(``planner.max_steps``) or as nested mappings. Out: a :class:`Settings`, which applies them to the options of whichever
robot there is; or one sentence that names the wrong option and those that come close.
"""

from __future__ import annotations

import difflib
import logging
import math
import typing
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar, cast

from vecenv.errors import InvalidInput
from vecenv.util import configs
from voxposer.agent import AgentConfig
from voxposer.language.llm import Llm, LlmConfig
from voxposer.language.lmp_config import CONFIGS
from voxposer.language.prompts import load_prompts
from voxposer.language.saved import SavedReplies, open_llm

_Config = TypeVar("_Config")
# A key is not taken: it would be stored with the results.
_SECRET = "api_key"
_LLM = tuple(each.name for each in fields(LlmConfig) if each.name != _SECRET)
# Of these, those that mean nothing to a rule base.
_OF_MODELS = frozenset({"seed", "timeout_s", "attempts", "api_base", "options", "concurrency"})
# Fields of every language program that may be given for all of them at once.
_OF_LMPS = ("temperature", "max_tokens")
_log = logging.getLogger(__name__)
_SHORT = {
    "perception": "perception.source",
    "segmentation": "perception.camera.segmentation",
    "cameras": "perception.camera.cameras",
}
_LEAST = {"passes": 1, "max_misses": 1, "idle_ticks": 1, "repairs": 0}


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The options of a VoxPoser run.

    Attributes:
        llm: the model.
        replay: folder of saved replies that answer in the model's place, None to ask it.
        prompts_dir: folder of prompts in place of the package's own.
        agent: fields of ``AgentConfig`` that were given, nested ones as mappings.
    """

    llm: LlmConfig = field(default_factory=LlmConfig)
    replay: Path | None = None
    prompts_dir: str | None = None
    agent: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> Settings:
        """The settings of some options; those that are not given are at their defaults.

        Args:
            options: fields of ``LlmConfig`` (but no key), ``temperature`` and ``max_tokens`` of all language programs,
                ``replay``, ``prompts_dir``, and fields of ``AgentConfig``; fields of the configs in it as
                ``perception.map_size`` or as mappings. ``perception``, ``segmentation`` and ``cameras`` are short for
                ``perception.source``, ``perception.camera.segmentation`` and ``perception.camera.cameras``.

        Raises:
            InvalidInput: there is no such option, a value cannot be used, or a folder does not hold what it should.
        """
        given = _nested(_in_full(options))
        if _SECRET in given:
            raise InvalidInput(
                f"option {_SECRET} is not taken, because options are stored with the results: "
                "set the provider's environment variable, such as OPENAI_API_KEY"
            )
        _check_names(given)
        of_llm = {name: given.pop(name) for name in _LLM if name in given}
        of_lmps = {name: given.pop(name) for name in _OF_LMPS if name in given}
        if of_lmps:
            apply(CONFIGS["planner"], of_lmps)  # so that what is wrong with it is said once, without a program's name
            given["lmps"] = _below(dict.fromkeys(CONFIGS, of_lmps), given.get("lmps", {}))
        replay = _folder("replay", given.pop("replay", None))
        prompts_dir = _folder("prompts_dir", given.pop("prompts_dir", None))
        if replay is not None and "model" not in of_llm:
            of_llm["model"] = SavedReplies(replay).model
        if isinstance(of_llm.get("cache"), str):
            of_llm["cache"] = Path(of_llm["cache"])
        settings = cls(
            llm=apply(LlmConfig(), of_llm),
            replay=replay,
            prompts_dir=None if prompts_dir is None else str(prompts_dir),
            agent=given,
        )
        settings.agent_config()
        if settings.llm.is_rule_base and (vain := sorted({*_OF_MODELS & set(of_llm), *of_lmps} - {"max_tokens"})):
            _log.warning("%s: no effect, %s is a rule base and no language model", ", ".join(vain), settings.llm.model)
        _check_prompts(settings.prompts_dir)
        return settings

    def agent_config(self, base: AgentConfig | None = None) -> AgentConfig:
        """The agent's options: those of a robot, with the fields that were given in their place.

        Args:
            base: what the robot needs, the defaults for the Panda if not given.
        """
        config = apply(base or AgentConfig(), self.agent)
        for name, least in _LEAST.items():
            if getattr(config, name) < least:
                raise InvalidInput(f"{name}={getattr(config, name)}: expected at least {least}")
        return config

    def open_llm(self) -> Llm:
        """The model, or saved replies in its place."""
        return open_llm(self.llm, self.replay)

    @property
    def writer(self) -> str:
        """What writes the programs, for reports."""
        what = "rule-based" if self.llm.is_rule_base else ""
        how = "replayed" if self.replay is not None else ""
        return ", ".join(filter(None, (self.llm.model, what, how)))


def apply(base: _Config, values: Mapping[str, Any], where: str = "") -> _Config:
    """A frozen dataclass with some fields replaced; of nested dataclasses, only the fields that are given.

    Args:
        base: what to start from.
        values: name -> value, of a nested dataclass a mapping.
        where: what comes before the names in messages, such as ``"planner."``.

    Raises:
        InvalidInput: a value has the wrong type, is not finite, or the config refuses it.
    """
    kind = cast(Any, type(base))
    hints = typing.get_type_hints(kind)
    made: dict[str, Any] = {}
    for name, value in values.items():
        old: Any = getattr(base, name)
        if is_dataclass(old) and isinstance(value, Mapping):
            made[name] = apply(old, value, f"{where}{name}.")
        elif _is_table(old) and isinstance(value, Mapping):
            assert isinstance(old, Mapping)
            inner = {key: apply(old[key], each, f"{where}{name}.{key}.") for key, each in value.items()}
            made[name] = {**old, **inner}
        elif is_dataclass(old) or _is_table(old):
            raise InvalidInput(f"{where}{name}={value!r}: give its fields, such as {where}{next(_names_in(old, name))}")
        else:
            made[name] = _plain(value, hints[name], f"{where}{name}")
    try:
        simple = {name: value for name, value in made.items() if not (is_dataclass(value) or _is_table(value))}
        needed = {each.name: getattr(base, each.name) for each in fields(kind) if _is_required(each)}
        what = f"option {where}".rstrip(". ") if where else "policy 'voxposer'"
        configs.build(kind, {**needed, **simple}, what=what, error=InvalidInput)
        return replace(cast(Any, base), **made)
    except InvalidInput:
        raise
    except (ValueError, TypeError) as error:
        shown = ", ".join(f"{where}{name}={value!r}" for name, value in values.items())
        raise InvalidInput(f"{shown}: {error}") from error


def _is_required(field: Field[Any]) -> bool:
    return field.default is MISSING and field.default_factory is MISSING


def _below(usual: Any, given: Any) -> Any:
    """What was given, nested mappings filled up with what is usual."""
    if not (isinstance(usual, Mapping) and isinstance(given, Mapping)):
        return given
    return {**usual, **{name: _below(usual.get(name), value) for name, value in given.items()}}


def option_names() -> list[str]:
    """Every option, nested ones with dots."""
    return [*_LLM, *_OF_LMPS, *_SHORT, "replay", "prompts_dir", *_names_in(AgentConfig())]


def _names_in(config: Any, before: str = "") -> Iterator[str]:
    """The names of all fields of a config or a table of configs, down to those that are no configs."""
    pairs = (
        config.items() if isinstance(config, Mapping) else ((f.name, getattr(config, f.name)) for f in fields(config))
    )
    for name, value in pairs:
        full = f"{before}.{name}" if before else name
        if is_dataclass(value) or _is_table(value):
            yield from _names_in(value, full)
        else:
            yield full


def _is_table(value: object) -> bool:
    """Whether a value is a mapping of names to configs."""
    return isinstance(value, Mapping) and bool(value) and all(is_dataclass(each) for each in value.values())


def _in_full(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options with short names in full."""
    short = {name: full for name, full in _SHORT.items() if name in options and not isinstance(options[name], Mapping)}
    camera = short.keys() - {"perception"}
    if camera and options.get("perception", options.get("perception.source")) != "camera":
        raise InvalidInput(f"{' and '.join(sorted(camera))}: options of perception=camera")
    given = {name: value for name, value in options.items() if name not in short}
    for name, full in short.items():
        if full in given:
            raise InvalidInput(f"option {name!r} was given twice, also as {full!r}")
        value = options[name]
        listed = name == "cameras" and isinstance(value, str)
        given[full] = [part.strip() for part in value.split(",")] if listed else value
    return given


def _nested(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options as nested mappings: ``{"planner.max_steps": 9}`` is ``{"planner": {"max_steps": 9}}``."""
    nested: dict[str, Any] = {}
    for name, value in options.items():
        *above, last = str(name).split(".")
        here = nested
        for part in above:
            here = here.setdefault(part, {})
            if not isinstance(here, dict):
                raise InvalidInput(f"option {name!r} is inside {part!r}, which was given a value")
        value = _nested(value) if isinstance(value, Mapping) and last != "options" else value
        if isinstance(here.get(last), dict) and isinstance(value, dict) and not here[last].keys() & value.keys():
            here[last] = {**here[last], **value}
        elif last in here:
            raise InvalidInput(f"option {name!r} was given twice")
        else:
            here[last] = value
    return nested


def _check_names(given: Mapping[str, Any]) -> None:
    """Refuse names that there are not, with those that come close."""
    known = option_names()
    folders = {".".join(name.split(".")[:depth]) for name in known for depth in range(1, name.count(".") + 1)}
    for name in _given_names(given):
        if name not in known and name not in folders:
            raise InvalidInput(f"policy 'voxposer' has no option {name!r}: {_hint(name, known)}")


def _given_names(given: Mapping[str, Any], before: str = "") -> Iterator[str]:
    for name, value in given.items():
        full = f"{before}{name}"
        if isinstance(value, Mapping) and full != "options":
            yield from _given_names(value, f"{full}.")
        else:
            yield full


def _hint(name: str, known: list[str]) -> str:
    """The options that come close to a name: by all of it, or by its last part."""
    last = {each: each.rsplit(".", 1)[-1] for each in known}
    alike = difflib.get_close_matches(name.rsplit(".", 1)[-1], sorted(set(last.values())), n=2, cutoff=0.75)
    ends = [each for part in alike for each in known if last[each] == part]
    close = list(dict.fromkeys([*difflib.get_close_matches(name, known, n=2), *ends]))[:4]
    if close:
        return f"did you mean {', '.join(close)}?"
    first = list(dict.fromkeys(each.split(".")[0] for each in known))
    return f"there are {', '.join(first)}, and fields of these, such as planner.max_steps"


def _plain(value: Any, hint: Any, where: str) -> Any:
    """A value of YAML or JSON as the type of a field has it: lists where tuples are, numbers that are finite."""
    if isinstance(value, list):
        hint = next((part for part in typing.get_args(hint) if typing.get_origin(part) is tuple), hint)
    if isinstance(value, list) and typing.get_origin(hint) is tuple:
        inner = [each for each in typing.get_args(hint) if each is not Ellipsis]
        parts = inner if len(inner) == len(value) else inner[:1] * len(value)
        return tuple(_plain(each, part, where) for each, part in zip(value, parts, strict=True))
    if isinstance(value, float) and not math.isfinite(value):
        raise InvalidInput(f"{where}={value}: expected a finite number")
    return value


def _folder(name: str, value: object) -> Path | None:
    """A folder that is there, or None."""
    if value is None:
        return None
    if not isinstance(value, str | Path) or not Path(value).is_dir():
        raise InvalidInput(f"{name}={value!r}: there is no such folder")
    return Path(value)


def _check_prompts(prompts_dir: str | None) -> None:
    try:
        load_prompts(prompts_dir)
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidInput(f"prompts_dir={prompts_dir!r}: {error}") from None
