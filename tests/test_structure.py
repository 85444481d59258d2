"""Rules about the source: what an import of vecenv loads, and that all exceptions derive from ``VecenvError``."""

from __future__ import annotations

import ast
import builtins
import json
import subprocess
import sys
from pathlib import Path

import pytest

from vecenv.errors import VecenvError

# Exceptions that do not derive from VecenvError, with the reason.
EXCEPTIONS = {
    "_Stopped": "raised and caught in vecenv_eval.engines.ray_actor, where it ends the episode loop",
    "RunStopped": "raised in vecenv_eval.panel.session and caught in vecenv_eval.loop, as Ctrl-C is",
    "Terminated": "SIGTERM, which vecenv_eval.cli raises and catches as Python does with KeyboardInterrupt",
    "ConnectionLost": "raised and caught in vecenv_eval.clients.zmq, which retries and then raises PolicyServerError",
}


def test_import_of_vecenv_loads_neither_simulators_nor_array_libraries() -> None:
    code = "import json, sys, vecenv; print(json.dumps(sorted({m.split('.')[0] for m in sys.modules})))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(json.loads(done.stdout))
    assert "vecenv" in loaded
    assert loaded.isdisjoint({"mujoco", "jax", "sapien", "scipy", "numpy", "numba", "gymnasium", "typer"})


def bases_by_class(folder: Path) -> dict[str, tuple[str, ...]]:
    """Class -> names of its bases, without their modules, of all classes below a folder."""
    classes: dict[str, tuple[str, ...]] = {}
    for path in sorted(folder.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef):
                classes[node.name] = tuple(ast.unparse(base).split(".")[-1] for base in node.bases)
    return classes


def ancestors(name: str, classes: dict[str, tuple[str, ...]]) -> set[str]:
    """Names of a class and of all its bases."""
    return {name}.union(*(ancestors(base, classes) for base in classes.get(name, ()) if base != name))


def is_builtin_exception(name: str) -> bool:
    kind = getattr(builtins, name, None)
    return isinstance(kind, type) and issubclass(kind, BaseException)


@pytest.mark.parametrize("package", ["vecenv", "eval/vecenv_eval"])
def test_every_exception_derives_from_vecenv_error(repository: Path, package: str) -> None:
    own = bases_by_class(repository / package)
    classes = bases_by_class(repository / "vecenv") | own
    lines = {name: ancestors(name, classes) for name in own}
    exceptions = {name for name, line in lines.items() if any(map(is_builtin_exception, line))}
    assert exceptions, "no exception was found"
    strays = {name for name in exceptions if VecenvError.__name__ not in lines[name]}
    assert strays == {name for name in EXCEPTIONS if name in own}
