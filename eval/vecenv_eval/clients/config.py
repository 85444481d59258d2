"""Where a policy server is and how its failures are handled: the options that all clients share.

In: keyword arguments, as ``--policy-arg key=value`` gives them. Out: a frozen dataclass, or a ``PolicyError`` that
names the option. Each client derives its own config from ``ServerConfig``.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

from vecenv.util import configs
from vecenv_eval.clients.gripper import GRIPPERS
from vecenv_eval.policies import PolicyError

_Config = TypeVar("_Config", bound="ServerConfig")
# Smallest values of whole-number options, those of single clients included.
_LEAST = {"connections": 1, "attempts": 1, "batch": 1, "replan_steps": 0, "image_size": 0}


@dataclass(frozen=True, kw_only=True)
class ServerConfig:
    """Address of a policy server, time-outs and retries.

    Attributes:
        host: name or address of the server; a websocket URL (``ws://...``, ``wss://...``) is used as it is.
        port: TCP port; 0 with a URL that has one.
        api_key_env: environment variable that holds the key for a server that asks for one; empty for none. The key
            itself is no option, because options are stored with the results.
        connections: most requests in flight; each has a connection of its own. 1 for servers that take one at a time.
        timeout_s: seconds to wait for an answer. A request that timed out is not sent again: it may still be running.
        connect_timeout_s: seconds to wait for one connection to open.
        attempts: how often a request is tried when the connection is refused or lost.
        first_wait_s: longest wait before the second attempt, seconds; it doubles from attempt to attempt.
        longest_wait_s: where the doubling ends, seconds.
        gripper: what becomes of the gripper column; one of ``vecenv_eval.clients.gripper.GRIPPERS``.
    """

    host: str = "127.0.0.1"
    port: int = 8000
    api_key_env: str = ""
    connections: int = 1
    timeout_s: float = 120.0
    connect_timeout_s: float = 10.0
    attempts: int = 6
    first_wait_s: float = 1.0
    longest_wait_s: float = 15.0
    gripper: str = "as_is"

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise PolicyError(f"port={self.port}: expected 0 to 65535")
        for name, least in _LEAST.items():
            if getattr(self, name, least) < least:
                raise PolicyError(f"{name}={getattr(self, name)}: expected at least {least}")
        for name in ("timeout_s", "connect_timeout_s"):
            if not getattr(self, name) > 0:
                raise PolicyError(f"{name}={getattr(self, name)}: expected a positive number of seconds")
        if self.gripper not in GRIPPERS:
            raise PolicyError(f"gripper={self.gripper!r}: expected one of {', '.join(GRIPPERS)}")
        if self.api_key_env and not self.api_key:
            raise PolicyError(f"api_key_env={self.api_key_env}: there is no such environment variable, or it is empty")

    @property
    def api_key(self) -> str:
        """The server's key, empty for none."""
        return os.environ.get(self.api_key_env, "") if self.api_key_env else ""

    @property
    def address(self) -> str:
        """Host and port, for messages."""
        return f"{self.host}:{self.port}" if self.port else self.host

    @property
    def websocket_url(self) -> str:
        """The URL to open."""
        return self.address if self.host.startswith(("ws://", "wss://")) else f"ws://{self.address}"


def build(kind: type[_Config], name: str, options: Mapping[str, object]) -> _Config:
    """The config of a client from the arguments of its policy.

    Raises:
        PolicyError: an option that the client does not have, or a value that it cannot use.
    """
    if "api_key" in options:
        raise PolicyError(
            f"policy {name!r}: api_key is not taken, because options are stored with the results: put the key into an "
            "environment variable and give that one's name, --policy-arg api_key_env=NAME"
        )
    return configs.build(kind, options, what=f"policy {name!r}", error=PolicyError)
