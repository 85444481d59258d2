"""``vecenv serve-policy``: a Python policy as a server of one of the known protocols.

The name of a policy comes in; the address is printed, and the policy is served until Ctrl-C. The exit status is 2 when
the arguments make no sense.
"""

from __future__ import annotations

import importlib
import signal
import sys
from pathlib import Path

import typer

from vecenv.cli import fail, unknown

# Protocol -> the server, and the port that its clients take by default.
SERVERS = {
    "openpi": ("vecenv_eval.serving.openpi:OpenPiServer", 8000),
    "vla-eval": ("vecenv_eval.serving.vla_eval:VlaEvalServer", 8000),
    "gr00t": ("vecenv_eval.serving.gr00t:Gr00tServer", 5555),
}


def serve_policy_command(
    policy: str = typer.Argument(..., help="module:Policy, with act_batch(observations) or infer(observation)."),
    protocol: str = typer.Option(..., "--as", help=f"Protocol: {', '.join(SERVERS)}."),
    host: str = typer.Option("127.0.0.1", help="Address to listen on; 0.0.0.0 for every interface."),
    port: int | None = typer.Option(None, min=0, max=65535, help="TCP port.", show_default="the protocol's"),
) -> None:
    """Serve a Python policy to evaluation harnesses."""
    if protocol not in SERVERS:
        fail(unknown("protocol", protocol, list(SERVERS)))
    from vecenv.errors import MissingDependency
    from vecenv_eval.serving.policy import ServedPolicyError, load

    target, usual_port = SERVERS[protocol]
    module, _, name = target.partition(":")
    sys.path.append(str(Path.cwd()))  # so that module:Policy finds a module beside the user
    try:
        server_class = getattr(importlib.import_module(module), name)
        server = server_class(load(policy), host, usual_port if port is None else port)
    except (ServedPolicyError, MissingDependency) as error:
        fail(str(error))
    # A shell that starts it in the background makes it deaf to Ctrl-C's signal; `kill -INT` must still stop it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        server.run(lambda bound: typer.echo(f"serving {policy} as {protocol} on {server.scheme}://{host}:{bound}"))
    except OSError as error:
        fail(f"cannot listen on {host}: {error}", code=1)
    except KeyboardInterrupt:
        typer.echo("stopped")
