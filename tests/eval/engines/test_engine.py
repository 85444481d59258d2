"""Names of engines, and what is said where one cannot be used."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from support.fakes import SUITE, FakeWorld
from vecenv_eval.config import ConfigError, EvalConfig
from vecenv_eval.engine import ENGINES, make_engine
from vecenv_eval.results import begin, resume


def config_of(**settings: Any) -> EvalConfig:
    return EvalConfig(**{"suite": SUITE, "policy": "random", **settings})


def test_an_unknown_engine_is_refused_with_those_that_come_close() -> None:
    with pytest.raises(ConfigError, match="unknown engine 'rai': did you mean ray"):
        make_engine(config_of(engine="rai"))


def test_the_local_engine_takes_no_arguments() -> None:
    with pytest.raises(ConfigError, match="takes no arguments: leave out actors"):
        make_engine(config_of(engine_args={"actors": 2}))


@pytest.mark.parametrize(("engine", "package", "extra"), [("ray", "ray", "ray"), ("submitit", "submitit", "slurm")])
def test_a_missing_package_is_named_with_its_extra(
    engine: str, package: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == package or ".engines." in name]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ConfigError, match=rf"engine '{engine}' needs {package}: pip install 'vecenv\[{extra}\]'"):
        make_engine(config_of(engine=engine))


def test_engines_are_imported_when_they_are_asked_for() -> None:
    code = "import json, sys, vecenv_eval.runner; print(json.dumps(sorted({m.split('.')[0] for m in sys.modules})))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert set(json.loads(done.stdout)).isdisjoint({"ray", "submitit"})
    assert set(ENGINES) == {"local", "ray", "submitit"}


def test_a_resumed_folder_may_change_its_engine_and_then_drops_its_arguments(tmp_path: Path) -> None:
    begin(config_of(engine="ray", engine_args={"actors": 2}), tmp_path / "run")
    with pytest.raises(ConfigError, match="names engine 'ray'"):  # a results folder does not decide what runs
        resume(tmp_path / "run")
    assert resume(tmp_path / "run", engine="ray")[0].engine_args == {}
    assert resume(tmp_path / "run", engine="local")[0].engine_args == {}
    changed = resume(tmp_path / "run", engine="submitit", engine_args={"shards": 2})[0]
    assert (changed.engine, changed.engine_args) == ("submitit", {"shards": 2})


def test_the_folder_says_which_engine_ran(tmp_path: Path) -> None:
    from vecenv_eval.runner import evaluate

    config = config_of(tasks="0", episodes="1")
    evaluate(config, begin(config, tmp_path / "run"), simulator=FakeWorld().simulator)
    assert json.loads((tmp_path / "run" / "config.json").read_text())["runs"][0]["engine"] == "local"
