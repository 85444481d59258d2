"""How an evaluation stands and how it ended, and the results folders that a config begins or resumes.

Records come in as episodes end; :class:`Progress` goes to whoever watches, :class:`EvalResult` to the caller.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from vecenv_eval.conditions import checked_content
from vecenv_eval.config import ConfigError, EvalConfig, differences
from vecenv_eval.episodes import Episode, Suite
from vecenv_eval.policies import BUILTIN
from vecenv_eval.report import Summary, markdown, summarise
from vecenv_eval.store import CONFIG, Record, ResultStore, StoreError
from vecenv_eval.store.files import parse_json, read_json

# Where ``config.json`` has the policy's name, which is known where the policy is made.
POLICY_NAME = "policy_name"
# In the folder of a campaign (``vecenv_eval.campaign``), whose runs have folders below it.
CAMPAIGN = "campaign.json"
# The engine that starts no program.
LOCAL = "local"
# Arguments of policies that say where a language model is asked, with the user's key.
SENT = frozenset({"api_base", "options"})
# Options that a message repeats, characters.
_MOST_SHOWN = 500


@dataclass(frozen=True, kw_only=True)
class Progress:
    """Where an evaluation stands; handed to ``on_progress`` after every call of the policy.

    Attributes:
        total: episodes asked for.
        done: episodes with a verdict, those of earlier runs included.
        successes, faults, errors: among the episodes so far.
        steps: control ticks executed in this run, summed over slots.
        seconds: seconds this run has spent running episodes.
        batch, num_batches: which stream of episodes is running, of how many.
        setting_up: the environment of the stream is being built, or its episodes are being placed.
        ended: the episodes that have ended since the last call, those that ended in an error included.
        conditions: what episodes run under (``vecenv_eval.conditions``); empty until there is an environment.
    """

    total: int
    done: int
    successes: int
    faults: int
    errors: int
    steps: int
    seconds: float
    batch: int
    num_batches: int
    setting_up: bool
    ended: tuple[Record, ...] = ()
    conditions: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class EvalResult:
    """How an evaluation ended.

    Attributes:
        summary: the numbers, also in ``summary.json``.
        records: the record of each episode that ran.
        folder: the results folder.
        interrupted: it was stopped from the keyboard.
        causes: the errors that ended episodes in this run, without repetition.
    """

    summary: Summary
    records: tuple[Record, ...]
    folder: Path
    interrupted: bool
    causes: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """Every episode has a verdict."""
        return self.summary.complete and not self.interrupted


def begin(config: EvalConfig, folder: Path) -> ResultStore:
    """Open a new results folder for a config.

    Raises:
        StoreError: something is in the way.
    """
    return ResultStore.create(folder, {"config": config.to_dict(), "runs": []})


def open_or_begin(config: EvalConfig, folder: Path) -> ResultStore:
    """The results folder of a config: continued if it is there, so that a command can simply be repeated, else new.

    Raises:
        StoreError: there is something else, or an evaluation with other settings; the message names them.
    """
    if not (folder / CONFIG).is_file():
        return begin(config, folder)
    there, store = read_folder(folder)
    refuse_other_settings(config, there, folder)
    return store


def refuse_other_settings(config: EvalConfig, there: EvalConfig, folder: Path) -> None:
    """Refuse to continue a folder with settings that it was not begun with.

    Raises:
        StoreError: with the settings that differ.
    """
    other = differences(there, config)
    other += [
        f"{name} {getattr(there, name)!r} and {getattr(config, name)!r}"
        for name in ("store", "shard")
        if getattr(there, name) != getattr(config, name)
    ]
    if other:
        raise StoreError(
            f"{folder} is already there and holds another evaluation (there and here: {', '.join(other)}): "
            "name another folder"
        )


def read_folder(folder: Path) -> tuple[EvalConfig, ResultStore]:
    """Open an existing results folder to read it, or to continue it with settings that were given again.

    What its ``config.json`` names (a policy, an engine) is text here: nothing is imported.

    Raises:
        StoreError: it is not a results folder, or it was written by something else.
    """
    store = ResultStore.open(folder)
    try:
        return EvalConfig.from_dict(checked_content(store.config(), folder / CONFIG)["config"]), store
    except KeyError as error:
        raise StoreError(f"{folder / CONFIG} does not hold an evaluation: it has no {error}") from None
    except (TypeError, AttributeError, ConfigError) as error:
        raise StoreError(f"{folder / CONFIG} does not hold an evaluation: {error}") from None


def resume(folder: Path, **changes: Any) -> tuple[EvalConfig, ResultStore]:
    """Open an existing results folder, to run what is missing.

    A results folder is data, perhaps a stranger's: what it names outside vecenv is used only if it is given again
    (`refuse_untold`).

    Args:
        folder: the results folder.
        **changes: fields of ``EvalConfig`` to replace for this run, or to give again; those that are None stay as they
            were.

    Raises:
        ConfigError: something has to be given again, or is not what the folder has.
        StoreError: it is not a results folder, or it was written by something else.
    """
    config, store = read_folder(folder)
    return changed(config, changes, folder), store


def changed(config: EvalConfig, changes: Mapping[str, Any], folder: Path) -> EvalConfig:
    """The config of a folder with the settings that were given; see `resume`.

    Raises:
        ConfigError: something has to be given again, or is not what the folder has.
    """
    given = {key: value for key, value in changes.items() if value is not None}
    refuse_untold(config, given, folder)
    if "engine" in given:  # another engine takes other arguments, and those of a folder may start programs
        given.setdefault("engine_args", {})
    return replace(config, **given)


def refuse_untold(config: EvalConfig, given: Mapping[str, Any], folder: Path) -> None:
    """Refuse to run what only a results folder names, and settings given again that are not the folder's.

    These have to be given again: a policy that is not built in, with its arguments; arguments with which a language
    model is asked elsewhere (`SENT`); and an engine that starts programs, which is any but ``local``.

    Args:
        config: what the folder says.
        given: settings that were given, by field name.
        folder: for messages.

    Raises:
        ConfigError: with the options to add, or with what differs.
    """
    name, arguments = config.policy_name, _plain(config.policy_args)
    if "policy" in given and given["policy"] != name:
        raise ConfigError(f"{folder} was evaluated with policy {name!r}, not {given['policy']!r}: leave out --policy")
    if "policy_args" in given and _plain(given["policy_args"]) != arguments:
        raise ConfigError(
            f"{folder} has other arguments of the policy (there and here: {arguments!r:.200} and "
            f"{_plain(given['policy_args'])!r:.200})"
        )
    if missing := [field for field in untold(config) if field not in given]:
        options = " ".join(_again(config, field) for field in missing)
        how = options if len(options) <= _MOST_SHOWN else f"the options that {CONFIG} says"
        raise ConfigError(
            f"{folder} names {' and '.join(_named(config, field) for field in missing)}, and a results folder does not "
            f"decide what is run: give it again: {how}"
        )


def untold(config: EvalConfig) -> list[str]:
    """The settings of a folder that have to be given again before anything is run; see `refuse_untold`."""
    own, arguments = config.policy_name in BUILTIN, config.policy_args
    needed = {
        "policy": not own,
        "policy_args": bool(arguments) and (not own or bool(SENT & set(arguments))),
        "engine": config.engine != LOCAL,
    }
    return [field for field, wanted in needed.items() if wanted]


def resume_command(folder: Path) -> str:
    """The command that continues a results folder or a campaign: ``"vecenv eval --resume DIR --policy my:Policy"``."""
    command = f"vecenv eval --resume {shlex.quote(str(folder))}"
    try:
        if (folder / CAMPAIGN).is_file():
            config = EvalConfig.from_dict(read_json(folder / CAMPAIGN))
        else:
            config = EvalConfig.from_dict(read_json(folder / CONFIG)["config"])
    except (OSError, ValueError, KeyError, TypeError, StoreError):
        return command
    return " ".join([command, *(_again(config, field) for field in untold(config))])


def _named(config: EvalConfig, field: str) -> str:
    """What a folder names, for a message."""
    what = {
        "policy": f"policy {config.policy_name!r:.100}",
        "policy_args": f"arguments of policy {config.policy_name!r:.100}",
        "engine": f"engine {config.engine!r:.100}",
    }
    return what[field]


def _again(config: EvalConfig, field: str) -> str:
    """The options that give a setting again, as a shell reads them."""
    if field == "policy_args":
        return " ".join(f"--policy-arg {text}" for text in _pairs(config.policy_args))
    own = f"--{field} {shlex.quote(config.policy_name if field == 'policy' else config.engine)}"
    return " ".join([own, *(f"--engine-arg {text}" for text in _pairs(config.engine_args) if field == "engine")])


def _pairs(arguments: Mapping[str, Any]) -> list[str]:
    return [shlex.quote(f"{name}={_as_text(value)}") for name, value in arguments.items()]


def _as_text(value: object) -> str:
    """A value of an option: JSON, or text that is not JSON."""
    if isinstance(value, str):
        try:
            json.loads(value)
        except (ValueError, RecursionError):
            return value
    return json.dumps(value, default=str)


def _plain(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments as ``config.json`` has them."""
    return parse_json(json.dumps(dict(arguments), default=str).encode())


def write_results(
    store: ResultStore,
    suite: Suite,
    planned: Sequence[Episode],
    policy: str,
    *,
    interrupted: bool = False,
    causes: Sequence[str] = (),
) -> EvalResult:
    """Write ``summary.json`` and ``report.md`` of all records in a folder, and return both.

    Args:
        store: the results folder.
        suite: the suite.
        planned: every episode of the evaluation.
        policy: name of the policy.
        interrupted, causes: see `EvalResult`.
    """
    records = store.records()
    summary = summarise(
        records.values(),
        planned,
        suite=suite.name,
        policy=policy,
        instructions=suite.instructions,
        conditions=store.config().get("conditions", {}),
    )
    store.write_summary(summary.to_dict(), markdown(summary))
    return EvalResult(
        summary=summary,
        records=tuple(records[key] for key in planned if key in records),
        folder=store.folder,
        interrupted=interrupted,
        causes=tuple(causes),
    )


def count(records: Iterable[Record]) -> dict[str, int]:
    """The counts of :class:`Progress` among records: done, successes, faults and errors."""
    records = list(records)
    errors = sum(bool(record.error) for record in records)
    return {
        "done": len(records) - errors,
        "successes": sum(record.success for record in records),
        "faults": sum(bool(record.fault) for record in records),
        "errors": errors,
    }


def campaign_of(folder: Path) -> Path | None:
    """The folder of the campaign that a results folder belongs to (``DIR/SUITE`` or ``DIR/seed-0/SUITE``), if any."""
    above = folder.resolve().parents[:2]
    return next((place for place in above if (place / CAMPAIGN).is_file()), None)
