"""What to evaluate and how: one frozen dataclass, from which the command line and YAML files follow.

Settings come in as keyword arguments, as a mapping (:meth:`EvalConfig.from_dict`), from a YAML file
(:meth:`EvalConfig.load`) or as options of ``vecenv eval``, which are generated from the fields. To add a setting, add a
field with its sentence; nothing else has to be changed for it to be an option, to be read and to be written. This
module imports neither NumPy nor a simulator, because ``vecenv --help`` reads it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import Field, asdict, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import vecenv
from vecenv.errors import InvalidInput
from vecenv.util.names import unknown

if TYPE_CHECKING:
    from _typeshed import DataclassInstance
    from pydantic_core import ErrorDetails

ALL = "all"
VIDEO_CHOICES = ("none", "failures", "all")
STORE_CHOICES = ("jsonl", "sqlite")
TRACKERS = ("tensorboard", "trackio", "wandb")
NO_TRACKER = "none"
# Policies that know a benchmark's scenes, by the family of suites they are made for.
SCRIPTED = {"libero": "pick_place", "simpler": "simpler_scripted"}
_KEY = "setting"
# Of a file of settings: bytes, and values when its aliases are written out.
_MOST_BYTES, _MOST_VALUES = 1 << 24, 200_000
_Settings = TypeVar("_Settings", bound="DataclassInstance")


class ConfigError(InvalidInput):
    """The evaluation was asked for something that does not exist or does not fit together."""


@dataclass(frozen=True)
class Setting:
    """What is known about a field of a config beyond its type and default.

    Attributes:
        help: a sentence about it.
        default: what the default means, where its value does not say it.
        minimum: the smallest number allowed.
        flag: its option on the command line without ``--``, where that is not the field's name.
        resumable: it may change when a results folder is resumed, because no verdict depends on it.
        decides: two results folders with other values of it are about other evaluations; never so if ``resumable``.
    """

    help: str
    default: str = ""
    minimum: int | None = None
    flag: str = ""
    resumable: bool = False
    decides: bool = True


def setting(field: Field[Any]) -> Setting:
    """The setting behind a field of a config."""
    return field.metadata[_KEY]


def option_name(field: Field[Any]) -> str:
    """The option of ``vecenv eval`` for a field: ``"--max-steps"``."""
    return f"--{setting(field).flag or field.name.replace('_', '-')}"


def _about(
    help: str,
    *,
    default: str = "",
    minimum: int | None = None,
    flag: str = "",
    resumable: bool = False,
    decides: bool = True,
) -> dict[str, Setting]:
    return {_KEY: Setting(help, default, minimum, flag, resumable, decides and not resumable)}


def default_policy(suite: str) -> str:
    """The scripted policy that is made for a suite."""
    return SCRIPTED[vecenv.family(suite)]


@dataclass(frozen=True, kw_only=True)
class EvalConfig:
    """What to evaluate, and how. The sentence of each field is beside it.

    Raises:
        ConfigError: a number is below its minimum.
    """

    # Numbers in YAML may stand for text: ``episodes: 5`` means ``"5"``.
    __pydantic_config__: ClassVar[dict[str, bool]] = {"coerce_numbers_to_str": True}

    suite: str = field(
        metadata=_about("Suite to evaluate, or several: a,b,c; `vecenv list` names them.", default="required")
    )
    policy: str | None = field(
        default=None,
        metadata=_about(
            "random, zero, voxposer (programs by a rule base, or by --policy-arg model=...), pick_place (LIBERO), "
            "simpler_scripted, or your own module:Class.",
            default="the suite's scripted one",
        ),
    )
    tasks: str = field(default=ALL, metadata=_about("all, or indices, ranges, names and patterns: 0,3,5-7 or pick*."))
    episodes: str | Sequence[int] = field(
        default=ALL, metadata=_about("all (the protocol's), a count, or indices and ranges: 0,3,5-7.")
    )
    policy_args: Mapping[str, Any] = field(
        default_factory=dict,
        metadata=_about("key=value for the policy, a.b=value for a nested one; repeatable.", flag="policy-arg"),
    )
    protocol: str = field(default="seed", metadata=_about("Evaluation protocol; `vecenv list --protocols` has them."))
    backend: str = field(default="native", metadata=_about("Physics backend."))
    max_steps: int | None = field(
        default=None,
        metadata=_about("Step budget of an episode, control ticks.", default="the protocol's", minimum=1),
    )
    seed: int | None = field(default=None, metadata=_about("Seed of environment and policy.", default="the protocol's"))
    seeds: str | None = field(
        default=None, metadata=_about("Several seeds, each a run of its own: 0,1,2.", default="one seed")
    )
    image_size: int | None = field(
        default=None, metadata=_about("Side of camera images, pixels (LIBERO).", default="the protocol's", minimum=1)
    )
    lod: str | None = field(
        default=None, metadata=_about("Level of detail of images: original, exact or fast (LIBERO).", default="exact")
    )
    colors: str | None = field(
        default=None, metadata=_about("Colors of images: published or current (LIBERO).", default="published")
    )
    cameras: str | Sequence[str] | None = field(
        default=None,
        metadata=_about(
            "Cameras that policies, videos and LeRobot data get; repeatable, or a,b.",
            default="all of the scene; videos and data: agentview,wrist",
        ),
    )
    env_args: Mapping[str, Any] = field(
        default_factory=dict, metadata=_about("key=value for vecenv.make; repeatable.", flag="env-arg")
    )
    num_envs: int | None = field(
        default=None,
        metadata=_about("Most episodes that run at once.", default="what fits into memory", minimum=1, resumable=True),
    )
    num_threads: int | None = field(
        default=None,
        metadata=_about(
            "Threads of the physics (SIMPLER: processes).", default="the backend's", minimum=1, resumable=True
        ),
    )
    record: bool = field(
        default=False, metadata=_about("Keep the executed actions, for `vecenv replay`.", resumable=True)
    )
    record_states: bool = field(
        default=False, metadata=_about("Keep the states too; implies --record.", resumable=True)
    )
    retries: int = field(
        default=1,
        metadata=_about(
            "How often episodes that ended in an error run again in the same run.", minimum=0, resumable=True
        ),
    )
    video: str = field(
        default="none",
        metadata=_about("Write one mp4 an episode into DIR/videos: failures, all or none.", resumable=True),
    )
    record_lerobot: bool = field(
        default=False, metadata=_about("Write the run as a LeRobot dataset into DIR/lerobot.", resumable=True)
    )
    live: bool = field(
        default=False, metadata=_about("Show the newest images of running episodes to `vecenv view`.", resumable=True)
    )
    store: str = field(
        default="jsonl",
        metadata=_about("Where rows are kept: jsonl (a text file) or sqlite (a database).", decides=False),
    )
    shard: str | None = field(
        default=None,
        metadata=_about(
            "Run part i of n of the episodes: i/n; `vecenv merge` joins the parts.", default="all", decides=False
        ),
    )
    track: str = field(
        default=NO_TRACKER,
        metadata=_about("Experiment trackers to log to: wandb, trackio, tensorboard, or several: a,b.", resumable=True),
    )
    fail_fast: bool = field(default=False, metadata=_about("Stop when an error ends episodes.", resumable=True))
    engine: str = field(
        default="local",
        metadata=_about("Where episodes run: local, ray (actors) or submitit (Slurm jobs).", resumable=True),
    )
    engine_args: Mapping[str, Any] = field(
        default_factory=dict,
        metadata=_about("key=value for the engine; repeatable.", flag="engine-arg", resumable=True),
    )

    def __post_init__(self) -> None:
        if self.video not in VIDEO_CHOICES:
            raise ConfigError(f"video={self.video!r}: expected one of {', '.join(VIDEO_CHOICES)}")
        if self.store not in STORE_CHOICES:
            raise ConfigError(f"store={self.store!r}: expected one of {', '.join(STORE_CHOICES)}")
        parse_shard(self.shard)
        if self.cameras is not None and not self.camera_names:
            raise ConfigError(f"cameras={self.cameras!r}: no camera is named")
        for name in self.trackers:
            if name not in TRACKERS:
                raise ConfigError(unknown("tracker", name, TRACKERS))
        for each in fields(self):
            value, minimum = getattr(self, each.name), setting(each).minimum
            if minimum is not None and value is not None and value < minimum:
                raise ConfigError(f"{each.name} must be at least {minimum}, not {value}")

    @property
    def suites(self) -> tuple[str, ...]:
        """The suites to evaluate."""
        return tuple(dict.fromkeys(name.strip() for name in self.suite.split(",") if name.strip()))

    @property
    def all_seeds(self) -> tuple[int | None, ...]:
        """The seeds to run, (None,) for the one that is usual.

        Raises:
            ConfigError: something that is no whole number.
        """
        if self.seeds is None:
            return (self.seed,)
        if self.seed is not None:
            raise ConfigError("give seed or seeds, not both")
        try:
            return tuple(dict.fromkeys(int(text) for text in self.seeds.split(",")))
        except ValueError:
            raise ConfigError(f"seeds {self.seeds!r}: write whole numbers with commas: 0,1,2") from None

    @property
    def trackers(self) -> tuple[str, ...]:
        """The experiment trackers to log to."""
        names = (name.strip() for name in self.track.split(","))
        return tuple(dict.fromkeys(name for name in names if name not in ("", NO_TRACKER)))

    @property
    def policy_name(self) -> str:
        """The policy to run: the one given, else the suite's scripted one."""
        return self.policy or default_policy(self.suites[0])

    @property
    def camera_names(self) -> tuple[str, ...]:
        """The cameras asked for, without repetition; () where the suite's own hold."""
        given = [self.cameras] if isinstance(self.cameras, str) else self.cameras or ()
        return tuple(dict.fromkeys(name.strip() for text in given for name in text.split(",") if name.strip()))

    @property
    def records(self) -> bool:
        """Whether executed actions are kept."""
        return self.record or self.record_states

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> EvalConfig:
        """A config from plain values, by field name.

        Raises:
            ConfigError: there is no such field, a value has the wrong type, or the suite is missing.
        """
        return from_values(cls, values, "setting")

    def to_dict(self) -> dict[str, Any]:
        """Plain values by field name, with the policy that is run; :meth:`from_dict` reads them back."""
        return {**asdict(self), "policy": self.policy_name}

    @classmethod
    def load(cls, path: Path) -> EvalConfig:
        """Read a YAML file.

        Raises:
            ConfigError: it cannot be read, or its settings make no config.
        """
        return cls.from_dict(read_settings(path))

    def save(self, path: Path) -> None:
        """Write a YAML file with every setting; its folder is made."""
        import yaml

        path.parent.mkdir(parents=True, exist_ok=True)
        values = self.to_dict()
        for name in ("episodes", "cameras"):
            if isinstance(values[name], tuple):
                values[name] = list(values[name])
        path.write_text(yaml.safe_dump(values, sort_keys=False))


def from_values(cls: type[_Settings], values: Mapping[str, Any], what: str) -> _Settings:
    """A dataclass from plain values, by field name.

    Args:
        cls: the dataclass.
        values: a value for each field that is given.
        what: what a field is called in messages, such as ``"setting"``.

    Raises:
        ConfigError: there is no such field, a value has the wrong type, or one is missing.
    """
    from pydantic import TypeAdapter, ValidationError

    names = [each.name for each in fields(cls)]
    for name in values:
        if name not in names:
            raise ConfigError(unknown(what, str(name), names))
    try:
        return TypeAdapter(cls).validate_python(dict(values))
    except ValidationError as error:
        raise ConfigError("; ".join(map(_problem, error.errors()))) from None


def parse_shard(text: str | None) -> tuple[int, int]:
    """Read ``"2/5"`` as (2, 5): the second of five parts; None is the whole, (1, 1).

    Raises:
        ConfigError: it is not of this form, or there is no such part.
    """
    if text is None:
        return 1, 1
    match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text.strip())
    part, parts = (int(match[1]), int(match[2])) if match else (0, 0)
    if not 1 <= part <= parts:
        raise ConfigError(f"shard={text!r}: expected i/n with 1 <= i <= n, such as 2/5")
    return part, parts


def differences(first: EvalConfig, second: EvalConfig, *, but: Collection[str] = ()) -> list[str]:
    """Where two configs are about other evaluations: ``"max_steps 20 and 10"``, one text a setting.

    Args:
        first, second: the configs.
        but: settings to leave out.
    """
    one, two = (json.loads(json.dumps(config.to_dict(), default=str)) for config in (first, second))
    decisive = [each.name for each in fields(EvalConfig) if setting(each).decides and each.name not in but]
    return [f"{name} {_text(one[name])} and {_text(two[name])}" for name in decisive if one[name] != two[name]]


def _text(value: object) -> str:
    return "not set" if value is None else f"{value!r:.100}"


def _problem(error: ErrorDetails) -> str:
    """What pydantic found wrong with one field, or what the config itself raised."""
    return f"{error['loc'][0]}: {error['msg']}" if error["loc"] else str(error.get("ctx", {})["error"])


def read_settings(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file: some of the settings of a config, unchecked.

    Raises:
        ConfigError: the file cannot be read, or holds something else.
    """
    import yaml

    try:
        with path.open("rb") as file:  # which may be a pipe, without a size
            content = file.read(_MOST_BYTES + 1)
        if len(content) > _MOST_BYTES:
            raise ConfigError(f"{path} cannot be read: it has more than {_MOST_BYTES:,} bytes")
        text = content.decode("utf-8")
        values = yaml.safe_load(text)
        if repeated := _repeated_key(yaml.compose(text, yaml.SafeLoader)):
            raise ConfigError(f"{path} cannot be read: {repeated}")
    except ConfigError:
        raise
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:  # ValueError: bytes, dates that are none
        raise ConfigError(f"{path} cannot be read: {' '.join(str(error).split())}") from None
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: expected settings such as `suite: libero_object`, one a line")
    if not _is_small(values):
        raise ConfigError(
            f"{path} cannot be read: with its aliases written out it has more than {_MOST_VALUES:,} values"
        )
    return values


def _repeated_key(root: Any) -> str:
    """Where a mapping of a YAML document has a key twice, of which YAML would take the last; "" for nowhere."""
    waiting, seen = [root], set()
    while waiting:
        node = waiting.pop()
        if node is None or id(node) in seen or isinstance(node.value, str):
            continue
        seen.add(id(node))
        pairs = [pair for pair in node.value if isinstance(pair, tuple)]
        waiting += [part for pair in pairs for part in pair] or node.value
        known: set[tuple[str, str]] = set()
        for key, _ in pairs:
            if isinstance(key.value, str):
                if (key.tag, key.value) in known:
                    return f"line {key.start_mark.line + 1} has {key.value!r:.60} for the second time"
                known.add((key.tag, key.value))
    return ""


def _is_small(values: object) -> bool:
    """Whether values that may share parts, or hold themselves, have few parts when each is written out."""
    waiting, count = [values], 0
    while waiting and count <= _MOST_VALUES:
        each = waiting.pop()
        inner = [*each.keys(), *each.values()] if isinstance(each, dict) else each if isinstance(each, list) else ()
        count += 1 + len(inner)
        waiting += inner
    return count <= _MOST_VALUES
