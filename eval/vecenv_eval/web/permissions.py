"""What clients may ask for: what somebody else wrote is run, read or called only where the server was told to trust.

Over HTTP a session has the built-in policies that need no server, with arguments that are numbers, words and switches;
no argument that names a file, an address or a language model. What the command line named may always be asked for
again, and ``ServeSettings.trust_clients`` lifts all of this.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from vecenv_eval.config import EvalConfig
from vecenv_eval.panel.catalog import SERVERS
from vecenv_eval.policies import BUILTIN
from vecenv_eval.web.errors import Refused
from vecenv_eval.web.models import SessionBody
from vecenv_eval.web.settings import ServeSettings

# Arguments of policies that clients may give; those of "voxposer" without anything that asks, reads or grows large.
POLICY_ARGS: Mapping[str, Collection[str]] = {
    "pick_place": ("seed",),
    "random": ("seed", "hold"),
    "simpler_scripted": ("seed",),
    "voxposer": ("passes", "max_misses", "idle_ticks", "wait", "follow", "perception"),
    "zero": ("gripper",),
}
# Options of environments that clients may give.
ENV_ARGS = (
    "backend",
    "contacts",
    "deterministic",
    "fixtures",
    "geometry",
    "max_steps",
    "render",
    "seed",
    "settle_steps",
    "start",
    "success",
)
_RENDER_ARGS = ("colors", "height", "lod", "width")
_LONGEST_TEXT, _LARGEST_NUMBER, _LARGEST_IMAGE = 64, 100_000, 1024
# Names of what writes programs without being asked over a network.
_RULE_BASES = "offline/"
_HOW = "start the server with --trust-clients to allow it"


def check_request(body: SessionBody, settings: ServeSettings, base: EvalConfig | None) -> None:
    """Refuse what a client may not build.

    Args:
        body: what it asks for.
        settings: whether clients are trusted.
        base: what the command line named.

    Raises:
        Refused: with the field that is not allowed.
    """
    if body.num_slots is not None and body.num_slots > settings.max_slots:
        raise Refused(422, f"num_slots: at most {settings.max_slots} slots are allowed here", "num_slots")
    if settings.trust_clients:
        return
    named = None if base is None else base.policy_name
    if body.policy is not None:
        _check_policy(body.policy, body.policy_args, named, base)
    elif body.policy_args:
        raise Refused(422, "policy_args without a policy: name the policy that they are for", "policy_args")
    _check_values("env_args", body.env_args, ENV_ARGS)


def check_node_config(config: Mapping[str, Any], settings: ServeSettings) -> None:
    """Refuse a node's config that names a language model, or options that go past its schema.

    Raises:
        Refused: clients may not give that.
    """
    if settings.trust_clients:
        return
    model = config.get("model")
    if isinstance(model, str) and not model.startswith(_RULE_BASES):
        raise Refused(403, f"config: clients may not name a language model; {_HOW}", "config")
    if config.get("options"):
        raise Refused(403, f"config: options are not open to clients; {_HOW}", "config")


def _check_policy(name: str, arguments: Mapping[str, Any], named: str | None, base: EvalConfig | None) -> None:
    if name == named and base is not None and arguments == dict(base.policy_args):
        return
    if ":" in name:
        raise Refused(403, f"policy: clients may not name Python code to run here; {_HOW}", "policy")
    if name in SERVERS:
        raise Refused(403, f"policy: {name!r} calls another server; {_HOW}", "policy")
    if name not in BUILTIN:
        return  # the config's own check says which names there are
    _check_values("policy_args", arguments, POLICY_ARGS.get(name, ()))


def _check_values(field: str, values: Mapping[str, Any], allowed: Collection[str]) -> None:
    for name, value in values.items():
        if name not in allowed:
            there = f"those that are: {', '.join(allowed)}" if allowed else "none is"
            raise Refused(403, f"{field}: {name[:64]!r} is not open to clients ({there}); {_HOW}", field)
        if name == "render":
            _check_render(field, value)
        elif not _is_plain(value):
            raise Refused(422, f"{field}: {name} takes a short word, a switch or a number of moderate size", field)


def _check_render(field: str, value: object) -> None:
    if not isinstance(value, Mapping):
        raise Refused(422, f"{field}: render takes a mapping", field)
    _check_values(field, value, _RENDER_ARGS)
    for name in ("height", "width"):
        if isinstance(value.get(name), int | float) and value[name] > _LARGEST_IMAGE:
            raise Refused(422, f"{field}: render.{name} is at most {_LARGEST_IMAGE} pixels here", field)


def _is_plain(value: object) -> bool:
    if isinstance(value, str):
        return len(value) <= _LONGEST_TEXT and value.replace("_", "").replace("-", "").isalnum()
    return value is None or (isinstance(value, bool | int | float) and abs(value) <= _LARGEST_NUMBER)
