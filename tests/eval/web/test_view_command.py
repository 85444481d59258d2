"""``vecenv view`` from the command line, and images drawn from recorded states."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import urllib.request
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
from support.results_folders import some_records, write_results
from support.viewing import address, viewing
from typer.testing import CliRunner
from vecenv_eval.config import EvalConfig
from vecenv_eval.runner import evaluate
from vecenv_eval.video.episodes import video_path

from vecenv.cli import COMMAND_GROUP, build_app

pytest.importorskip("fastapi")
pytest.importorskip("av")


VIEW = EntryPoint("view", "vecenv_eval.cli.view:view_command", COMMAND_GROUP)
MAIN = f"""
from importlib.metadata import EntryPoint
from vecenv.cli import build_app
build_app([EntryPoint({VIEW.name!r}, {VIEW.value!r}, {VIEW.group!r})])()
"""


def refused(*arguments: str) -> str:
    result = CliRunner(env={"COLUMNS": "200"}).invoke(build_app([VIEW]), ["view", *arguments])
    assert result.exit_code == 2
    (line,) = result.stderr.splitlines()
    return line


def test_what_cannot_be_viewed_is_one_sentence(tmp_path: Path) -> None:
    good = str(write_results(tmp_path / "run", some_records(lambda *_: True)))
    assert "nowhere" in refused(str(tmp_path / "nowhere"))
    assert str(tmp_path) in refused(good, str(tmp_path / "run" / "report.md"))
    assert "token" in refused(good, "--token-file", str(tmp_path / "none"))


def test_it_serves_until_it_is_interrupted(tmp_path: Path) -> None:
    folder = write_results(tmp_path / "run", some_records(lambda *_: True))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    command = [sys.executable, "-c", MAIN, "view", str(folder), "--port", "0"]
    with subprocess.Popen([*command, "--no-open"], env=environment, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        line = process.stdout.readline().strip()
        assert line.startswith(f"viewing {folder} on http://127.0.0.1:")
        url = line.rpartition(" ")[2]
        with urllib.request.urlopen(url, timeout=20) as page:
            assert b"<title>vecenv view</title>" in page.read()
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
        assert process.stdout.read().strip() == "stopped"


def test_recorded_states_are_drawn_as_the_video_shows_them(tmp_path: Path) -> None:
    config = EvalConfig(
        suite="libero_object",
        policy="random",
        tasks="0",
        episodes="1",
        max_steps=8,
        image_size=128,
        video="all",
        record_states=True,
    )
    result = evaluate(config, tmp_path / "run")
    key = f"run.libero_object.0.{result.records[0].episode}"
    images = []
    with viewing(tmp_path / "run") as client:
        for source in ("video", "states"):
            assert client.json(address(key))["recorded"]["frames"] == source
            images.append([frame(client, key, tick) for tick in (0, 4, 8)])
            video_path(tmp_path / "run", result.records[0].key).unlink(missing_ok=True)
        assert "no camera 'nothing'" in client.refusal(f"{address(key)}/frame", 404, camera="nothing")
    for filmed, drawn in zip(*images, strict=True):
        assert np.abs(filmed - drawn).mean() < 8
    assert np.abs(images[1][0] - images[1][2]).mean() > 0.2, "the robot has moved"


def frame(client: object, key: str, tick: int) -> np.ndarray:
    import io

    from PIL import Image
    from support.viewing import Client

    assert isinstance(client, Client)
    status, _, body = client.raw(f"{address(key)}/frame?tick={tick}&camera=agentview&size=128")
    assert status == 200, body
    return np.asarray(Image.open(io.BytesIO(body)).resize((128, 128)), float)
