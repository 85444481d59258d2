"""The routes of runs over HTTP: lists, recordings, two runs, the stream, and requests that mean harm."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.results_folders import some_records, write_results
from support.viewing import Client, address, viewing
from vecenv_eval.demos.schema import Recording
from vecenv_eval.demos.write import write_demos
from vecenv_eval.episodes import Episode
from vecenv_eval.live import pack, write_frame
from vecenv_eval.store import Record, ResultStore, write_log
from vecenv_eval.video.episodes import video_path
from vecenv_eval.video.writer import VideoWriter

pytest.importorskip("fastapi")
pytest.importorskip("av")

SUITE = "libero_goal"
CONFIG = {"suite": SUITE, "policy": "random", "tasks": "0-1", "episodes": 5}
FILMED, DRIVEN, DAMAGED = "run.libero_goal.0.0", "run.libero_goal.0.1", "run.libero_goal.1.0"


def records() -> list[Record]:
    found = some_records(lambda task, episode: episode < 3)
    found[3] = replace(found[3], fault="non-finite state")
    found[4] = replace(found[4], error="ServerError: gone")
    return found


def a_recording(episode: int, ticks: int = 6) -> Recording:
    states = np.arange(ticks * 30, dtype=float).reshape(ticks, 30)
    return Recording(
        episode=episode,
        success=True,
        fault="",
        actions=np.linspace(-1, 1, ticks * 7).reshape(ticks, 7),
        init_state=states[0],
        final_state=states[-1],
        states=states,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten episodes: one filmed, one with recorded actions, one whose recordings are damaged, one with a log."""
    folder = write_results(tmp_path_factory.mktemp("view") / "run", records(), config=CONFIG)
    with VideoWriter(video_path(folder, Episode(SUITE, 0, 0)), 10.0) as video:
        for shade in range(0, 100, 10):
            video.add(np.concatenate([np.full((64, 64, 3), each, np.uint8) for each in (shade, 255 - shade)], axis=1))
    write_demos(ResultStore(folder).demos_path(SUITE, 0), SUITE, 0, "open the drawer", [a_recording(1)])
    video_path(folder, Episode(SUITE, 1, 0)).write_bytes(b"\x00\x00\x00 ftypisom" + b"\xff" * 500)
    ResultStore(folder).demos_path(SUITE, 1).write_bytes(b"\x89HDF\r\n\x1a\n" + b"\xff" * 500)
    write_log(folder, Episode(SUITE, 0, 2), [{"question": "where? \ud800"}, {"reply": "<script>alert(1)</script>"}])
    return folder


@pytest.fixture(scope="module")
def client(folder: Path) -> Iterator[Client]:
    with viewing(folder) as client:
        yield client


# -- lists -------------------------------------------------------------------------------------------------------------


def test_a_run_says_how_it_stands(client: Client, folder: Path) -> None:
    assert client.json("/api/runs") == {
        "runs": [{"run": "run", "folder": str(folder), "state": "stopped"}],
        "drives": False,
    }
    run = client.json("/api/runs/run")
    assert {name: run["counts"][name] for name in ("planned", "episodes", "successes", "faults", "errors")} == {
        "planned": 10,
        "episodes": 9,
        "successes": 6,
        "faults": 1,
        "errors": 1,
    }
    assert [(task["task"], task["successes"], task["errors"]) for task in run["tasks"]] == [(0, 3, 1), (1, 3, 0)]
    assert run["counts"]["low"] < 6 / 9 < run["counts"]["high"]


def keys(client: Client, **query: Any) -> list[str]:
    return [row["key"] for row in client.json("/api/runs/run/episodes", **query)["rows"]]


def test_what_needs_a_look_comes_first(client: Client) -> None:
    rows = client.json("/api/runs/run/episodes")["rows"]
    assert [row["verdict"] for row in rows] == ["error", "fault", "failure", "failure", *["success"] * 6]
    assert [row["reason"] for row in rows[:2]] == ["ServerError: gone", "non-finite state"]


@pytest.mark.parametrize(
    ("query", "expected"),
    [
        ({"show": "failures"}, 4),
        ({"show": "fault"}, 1),
        ({"show": "error"}, 1),
        ({"show": "success"}, 6),
        ({"task": 1}, 5),
        ({"leg": "run", "task": 0}, 5),
        ({"leg": "another"}, 0),
        ({"text": "NON-FINITE"}, 1),
        ({"text": "stove"}, 5),
        ({"text": "libero_goal/1/4"}, 1),
    ],
)
def test_filters(client: Client, query: dict[str, Any], expected: int) -> None:
    answer = client.json("/api/runs/run/episodes", **query)
    assert answer["total"] == len(answer["rows"]) == expected


def test_pages_have_every_episode_once(client: Client) -> None:
    found = [key for offset in range(0, 12, 4) for key in keys(client, offset=offset, limit=4, order="number")]
    assert found == sorted(found)
    assert len(set(found)) == 10
    assert keys(client, offset=10**9) == []
    assert keys(client, order="recent") == keys(client, order="number")[::-1]


@pytest.mark.parametrize(
    "query", [{"limit": 0}, {"limit": 501}, {"offset": -1}, {"show": "x"}, {"order": "'--"}, {"task": "a"}]
)
def test_queries_that_mean_nothing_are_refused(client: Client, query: dict[str, Any]) -> None:
    assert next(iter(query)) in client.refusal("/api/runs/run/episodes", 422, **query)


# -- recordings --------------------------------------------------------------------------------------------------------


def test_a_tick_of_a_video_is_the_frame_before_it(client: Client) -> None:
    detail = client.json(address(FILMED))
    recorded = detail["recorded"]
    assert (recorded["frames"], recorded["ticks"], recorded["cameras"]) == ("video", 9, ["all", "agentview", "wrist"])
    assert recorded["video"]["fps"] == 10
    assert detail["record"]["num_steps"] == 100
    for tick in (0, 7, 3, 9, 10_000):
        width, height, pixel = client.image(f"{address(FILMED)}/frame", tick=tick, camera="agentview")
        assert (width, height) == (64, 64)
        assert pixel[0] == pytest.approx(10 * min(tick, 9), abs=6)
    assert client.image(f"{address(FILMED)}/frame", tick=0, camera="wrist")[2][0] > 245
    assert client.image(f"{address(FILMED)}/frame", size=32)[:2] == (32, 16)
    assert "front" in client.refusal(f"{address(FILMED)}/frame", 404, camera="front")


def test_a_video_can_be_played_in_parts(client: Client, folder: Path) -> None:
    whole = video_path(folder, Episode(SUITE, 0, 0)).read_bytes()
    status, headers, body = client.raw(f"{address(FILMED)}/video", Range="bytes=4-11")
    assert (status, body, headers["content-type"]) == (206, whole[4:12], "video/mp4")
    assert "video all" in client.refusal(f"{address(DRIVEN)}/video", 404)


def test_curves_are_what_was_recorded(client: Client) -> None:
    recorded = client.json(address(DRIVEN))["recorded"]
    assert (recorded["frames"], recorded["actions"], recorded["states"], recorded["ticks"]) == ("states", True, True, 6)
    curves = client.json(f"{address(DRIVEN)}/curves")
    assert curves["ticks"] == list(range(6))
    assert pytest.approx(a_recording(1).actions, abs=1e-5) == np.array(list(curves["actions"].values())).T
    assert len(curves["joints"]) == 9
    assert curves["joints"]["joint 1"][2] == 61
    assert "--record" in client.refusal(f"{address(FILMED)}/curves", 404)


def test_a_scene_that_does_not_have_such_states_is_a_sentence(client: Client) -> None:
    assert "30 numbers" in client.refusal(f"{address(DRIVEN)}/frame", 422)


def test_an_episode_without_recordings_says_what_keeps_them(client: Client) -> None:
    key = "run.libero_goal.0.3"
    assert client.json(address(key))["recorded"]["frames"] is None
    assert "--record-states" in client.refusal(f"{address(key)}/frame", 404)


def test_damaged_recordings_are_sentences(client: Client, folder: Path) -> None:
    recorded = client.json(address(DAMAGED))["recorded"]
    assert (recorded["frames"], len(recorded["problems"])) == (None, 2)
    assert "cannot be played" in client.refusal(f"{address(DAMAGED)}/frame", 422)
    assert "HDF5" in client.refusal(f"{address(DAMAGED)}/curves", 422)
    assert all(str(folder) not in problem for problem in recorded["problems"])


def test_a_playlist_that_names_other_files_is_no_video(tmp_path: Path) -> None:
    folder = write_results(tmp_path / "run", records(), config=CONFIG)
    with VideoWriter(tmp_path / "secret.mp4") as video:
        video.add(np.zeros((32, 32, 3), np.uint8))
    path = video_path(folder, Episode(SUITE, 0, 0))
    path.parent.mkdir()
    for text in (
        f"ffconcat version 1.0\nfile {tmp_path}/secret.mp4\n",
        f"#EXTM3U\n#EXTINF:1,\n{tmp_path}/secret.mp4\n",
    ):
        path.write_text(text)
        with viewing(folder) as client:
            assert "cannot be played" in client.refusal(f"{address(FILMED)}/frame", 422)


def test_a_log_is_text(client: Client) -> None:
    log = client.json(f"{address('run.libero_goal.0.2')}/log")
    assert log == {"lines": [{"question": "where? \\ud800"}, {"reply": "<script>alert(1)</script>"}], "complete": True}
    assert client.refusal(f"{address(FILMED)}/log", 404)


def test_recordings_that_are_links_out_of_the_folder_are_not_read(tmp_path: Path) -> None:
    folder = write_results(tmp_path / "run", records(), config=CONFIG)
    (tmp_path / "secret").write_text('{"token": "hunter2"}\n')
    for path in (
        video_path(folder, Episode(SUITE, 0, 0)),
        ResultStore(folder).demos_path(SUITE, 0),
        folder / "policy_logs" / "libero_goal_0_0.jsonl",
    ):
        path.parent.mkdir()
        path.symlink_to(tmp_path / "secret")
    with viewing(folder) as client:
        assert len(client.json(address(FILMED))["recorded"]["problems"]) == 2
        for what in ("frame", "video", "curves", "log"):
            assert "link out of the folder" in client.refusal(f"{address(FILMED)}/{what}", 422)


# -- harm --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "path",
    [
        "/api/runs/..",
        "/api/runs/../../etc/passwd",
        "/api/runs/%2e%2e%2f%2e%2e%2fetc%2fpasswd",
        "/api/runs/run/episodes/..%2f..%2fconfig.json",
        "/api/runs/run/episodes/../../../config.json",
        "/api/runs/run/episodes/run.libero_goal.0.0/..%2f..%2fepisodes.jsonl",
        "/api/runs/run/episodes/%00",
        "/api/runs/%ff%fe",
        "/api/runs/run/episodes/run.libero_goal.0.99/frame",
        "/api/runs/run/episodes/" + "a" * 2000,
        "/api/runs/run/compare/..",
        "/api/runs/run%0d%0aX-Evil:%201",
        "/static/../app.py",
        "/static/%2e%2e/app.py",
        "/static/..%2fapp.py",
        "//etc/passwd",
    ],
)
def test_paths_that_lead_elsewhere_lead_nowhere(client: Client, path: str) -> None:
    status, headers, body = client.raw(path)
    assert 400 <= status < 500
    assert json.loads(body)["error"]
    assert b"root:" not in body
    assert "x-evil" not in headers


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH"])
def test_nothing_can_be_changed(client: Client, method: str) -> None:
    for path in ("/api/runs", "/api/runs/run", "/api/runs/run/episodes", address(FILMED)):
        assert client.raw(path, method)[0] in (404, 405)


def test_text_from_files_is_sent_as_text(tmp_path: Path) -> None:
    bad = [
        replace(records()[0], instruction="<img src=x onerror=alert(1)>", extras={"a": "\ud800", "b": "x" * 10_000}),
        replace(records()[1], reward=float("nan"), suite='../../"><x'),
    ]
    folder = write_results(tmp_path / "run", [], config=CONFIG)
    plain = [json.dumps(vars(each) | {"stand_ins": [], "extras": dict(each.extras), "parts": {}}) for each in bad]
    (folder / "episodes.jsonl").write_text("".join(f"{line}\n" for line in plain))
    with viewing(folder) as client:
        rows = client.json("/api/runs/run/episodes", order="number")["rows"]
        assert len(rows) == 2
        assert all(set(row["key"]) <= set("abcdefghijklmnopqrstuvwxyz0123456789-_.") for row in rows)
        for row in rows:
            detail = client.json(address(row["key"]))
            assert len(json.dumps(detail)) < 10_000
        assert client.raw("/api/runs/run")[1]["content-security-policy"].startswith("default-src 'self'")


def test_a_token_is_asked_for(folder: Path) -> None:
    with viewing(folder, token="a token of some length") as client:
        assert client.raw("/api/runs")[0] == 401
        assert client.raw("/view")[0] == 200
        assert client.raw("/api/runs", Authorization="Bearer a token of some length")[0] == 200
        assert client.raw("/api/runs/run?token=a+token+of+some+length")[0] == 401


# -- two runs ----------------------------------------------------------------------------------------------------------


def test_two_runs_are_paired_by_episode(tmp_path: Path) -> None:
    ours = write_results(tmp_path / "base", some_records(lambda task, episode: episode < 2), config=CONFIG)
    theirs = [*some_records(lambda task, episode: episode in (0, 3, 4)), replace(records()[0], episode=30)]
    other = write_results(tmp_path / "tuned", theirs, config=CONFIG)
    with viewing(ours, other) as client:
        pairs = client.json("/api/runs/base/compare/tuned")
        counts = {name: pairs[name] for name in ("lost", "won", "both", "neither", "unpaired", "total")}
        assert counts == {"lost": 2, "won": 4, "both": 2, "neither": 2, "unpaired": 1, "total": 6}
        assert pairs["p_value"] == pytest.approx(0.6875)
        changes = [(row["task"], row["episode"], row["change"]) for row in pairs["rows"]]
        assert changes[:3] == [(0, 1, "lost"), (0, 3, "won"), (0, 4, "won")]
        assert pairs["rows"][0]["first"]["verdict"] == "success"
        (alone,) = client.json("/api/runs/base/compare/tuned", show="unpaired")["rows"]
        assert (alone["first"], alone["second"]["episode"]) == (None, 30)
        assert len(client.json("/api/runs/base/compare/tuned", show="all", offset=9, limit=5)["rows"]) == 2
        assert "nobody" in client.refusal("/api/runs/base/compare/nobody", 404)


# -- stream ------------------------------------------------------------------------------------------------------------


def header(**changes: Any) -> dict[str, Any]:
    return {
        "type": "wall",
        "process": "box-1",
        "host": "another machine",
        "pid": 1,
        "time": 1.0,
        "number": 1,
        "num_slots": 2,
        "steps_per_s": 3.5,
        "tile": 96,
        "columns": 8,
        "slots": [0, 1],
        "ticks": [5, 6],
        "verdicts": ["live", "success"],
        "episodes": ["libero_goal/0/0", "libero_goal/0/1"],
        "instructions": ["open", "open"],
    } | changes


def test_the_stream_has_rows_as_they_end_and_newest_frames(tmp_path: Path) -> None:
    sync = pytest.importorskip("websockets.sync.client")
    folder = write_results(tmp_path / "run", records()[:2], config=CONFIG, ended=False)
    with viewing(folder) as client, sync.connect(client.url.replace("http", "ws") + "/api/runs/run/stream") as socket:
        first = json.loads(socket.recv(20))
        assert (first["type"], first["counts"]["episodes"], first["ended"]) == ("run", 2, [])
        ResultStore.open(folder).append(records()[2:4])
        second = json.loads(socket.recv(20))
        assert [row["key"] for row in second["ended"]] == ["run.libero_goal.0.2", "run.libero_goal.0.3"]
        for number in (1, 2):
            write_frame(folder, "box-1", pack(header(number=number), b"\xff\xd8 an image"))
            message = socket.recv(20)
            while isinstance(message, str):
                message = socket.recv(20)
            size = int.from_bytes(message[:4], "little")
            shown = json.loads(message[4 : 4 + size])
            assert (shown["number"], shown["leg"], message[4 + size :]) == (number, "run", b"\xff\xd8 an image")
        write_frame(folder, "box-1", None)
        while (message := json.loads(socket.recv(20)))["type"] != "processes" or message["processes"]:
            pass


def test_a_stream_of_no_run_is_closed_with_the_reason(client: Client) -> None:
    sync = pytest.importorskip("websockets.sync.client")
    with sync.connect(client.url.replace("http", "ws") + "/api/runs/nobody/stream") as socket:
        with pytest.raises(Exception, match="nobody") as raised:
            socket.recv(20)
        assert type(raised.value).__name__.startswith("ConnectionClosed")


HOSTILE: list[bytes] = [
    b"",
    b"\xff\xff\xff\xff",
    pack(header(slots=list(range(1000))), b""),
    pack(header(ticks=[1]), b""),
    pack(header(tile=10**9), b""),
    pack(header(verdicts=["live", "<script>"]), b""),
    pack(header(instructions=["x" * 10**5, ""]), b""),
    pack(header(steps_per_s=float("nan")), b""),
    pack(header(), b"<svg onload=alert(1)>"),
    pack(header(pid=-1), b""),
    pack({"a": 1}, b""),
    b"\x05\x00\x00\x00[1,2]",
]


@pytest.mark.parametrize("content", HOSTILE, ids=range(len(HOSTILE)))
def test_frames_that_are_none_are_passed_over(tmp_path: Path, content: bytes) -> None:
    from vecenv_eval.web.live import live_frames
    from vecenv_eval.web.runs import RunReader

    folder = write_results(tmp_path / "run", records(), config=CONFIG)
    write_frame(folder, "good", pack(header(), b"\xff\xd8"))
    write_frame(folder, "bad", content)
    assert [frame.header.process for frame in live_frames(RunReader("run", folder).snapshot())] == ["box-1"]


def test_frames_of_processes_that_are_gone_are_not_shown(tmp_path: Path) -> None:
    import platform

    from vecenv_eval.web.live import live_frames
    from vecenv_eval.web.runs import RunReader

    folder = write_results(tmp_path / "run", records(), config=CONFIG)
    write_frame(folder, "dead", pack(header(process="dead", host=platform.node(), pid=2**22 + 1), b""))
    write_frame(folder, "mine", pack(header(process="mine", host=platform.node(), pid=os.getpid()), b""))
    write_frame(folder, "old", pack(header(process="old"), b""))
    os.utime(folder / "live" / "old.frame", (1.0, 1.0))
    (folder / "live" / "link.frame").symlink_to("/etc/passwd")
    run = RunReader("run", folder).snapshot()
    assert [frame.header.process for frame in live_frames(run)] == ["mine"]
