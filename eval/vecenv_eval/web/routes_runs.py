"""The routes of runs: results folders that were opened, their episodes, what was recorded of them, and what is running.

Every name in an address is looked up among what was found. Nothing can be changed over these routes.
"""

from __future__ import annotations

import asyncio
import io
import json
import time
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from pathlib import Path as Directory
from typing import Annotated, Any, Literal, cast

import numpy as np
from fastapi import APIRouter, FastAPI, Path, Query, WebSocket, WebSocketDisconnect
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import FileResponse, Response

from vecenv.errors import NotFound, VecenvError
from vecenv_eval.report.compare import mcnemar
from vecenv_eval.store import CONFIG, Record
from vecenv_eval.store.record import to_plain
from vecenv_eval.web.live import FRESH_S, LiveFrame, live_frames
from vecenv_eval.web.recorded import WHOLE, DemoFacts, Recordings, Unreadable, VideoFacts, curves, video_frame
from vecenv_eval.web.redraw import Redrawer
from vecenv_eval.web.run_models import (
    Compared,
    ComparedRow,
    Curves,
    EpisodeDetail,
    EpisodeList,
    EpisodeRow,
    Log,
    RecordedInfo,
    RunInfo,
    RunList,
    RunRow,
    State,
    VideoInfo,
    clean,
    episode_row,
    run_info,
    verdict_of,
)
from vecenv_eval.web.runs import Leg, RunReader, Snapshot, slug

# Seconds between two looks for a reader of the stream, and the share of the time that they may take.
_LOOK_S, _SHARE = 0.5, 0.2
_MOST_ROWS, _MOST_STREAMS = 200, 64
_QUALITY = 85
# How lists begin: what needs a look.
_WORST_FIRST = {"error": 0, "fault": 1, "failure": 2, "success": 3}

RunName = Annotated[str, Path(max_length=300, description="a run, as GET /api/runs names it")]
Key = Annotated[str, Path(max_length=600, description="an episode, as lists name it")]
Offset = Annotated[int, Query(ge=0, le=10**9)]
Limit = Annotated[int, Query(ge=1, le=500)]
Show = Literal["all", "failures", "success", "failure", "fault", "error"]
Order = Literal["worst", "number", "recent", "steps"]
Change = Literal["all", "changed", "lost", "won", "both", "neither", "unpaired"]


class Runs:
    """The runs that were opened, and what is kept of their recordings.

    Args:
        sources: the runs.
        drives: the server drives a session too.
        below: a folder whose results folders are runs as well, as they come.

    Attributes:
        streams: how many readers there are of the stream.
    """

    def __init__(self, sources: Sequence[RunReader], drives: bool = False, below: Directory | None = None) -> None:
        self.drives, self.streams, self._below = drives, 0, below
        self.readers = {source.name: source for source in sources}
        self.recordings, self.redrawer = Recordings(), Redrawer()

    def look(self) -> list[str]:
        """Names of all runs, those included that have begun since."""
        there = [] if self._below is None or not self._below.is_dir() else sorted(self._below.iterdir())
        for folder in there:
            if slug(folder.name) not in self.readers and not folder.is_symlink() and (folder / CONFIG).is_file():
                self.readers[slug(folder.name)] = RunReader(slug(folder.name), folder)
        return list(self.readers)

    def snapshot(self, run: str) -> Snapshot:
        """A run as it is.

        Raises:
            NotFound: no such run was opened.
        """
        if run not in self.readers and run not in self.look():
            raise NotFound(f"no run {run!r:.100} was opened; there are {', '.join(self.readers) or 'none'}")
        return self.readers[run].snapshot()

    def info(self, run: str) -> RunInfo:
        """How a run stands."""
        snapshot = self.snapshot(run)
        return run_info(snapshot, self.state(snapshot, live_frames(snapshot)))

    @staticmethod
    def state(snapshot: Snapshot, frames: Sequence[LiveFrame]) -> State:
        """Whether it is running."""
        return cast("State", snapshot.state(any(frame.age_s < FRESH_S for frame in frames)))

    def recorded(self, leg: Leg, record: Record) -> RecordedInfo:
        """What there is of an episode."""
        problems: list[str] = []
        video = demo = None
        try:
            video = self.recordings.video(leg, record.key)
        except Unreadable as error:
            problems.append(clean(str(error)))
        try:
            demo = self.recordings.demo(leg, record.key)
        except Unreadable as error:
            problems.append(clean(str(error)))
        states = demo is not None and demo.joints is not None
        return RecordedInfo(
            frames="video" if video else "states" if states else None,
            ticks=video.frames - 1 if video else len(demo.actions) if demo else record.num_steps,
            cameras=_cameras(video, leg, states),
            video=None if video is None else _video_info(video),
            actions=demo is not None,
            states=states,
            log=self.recordings.has(leg, record.key)["log"],
            problems=problems,
        )

    def frame(self, leg: Leg, record: Record, tick: int, camera: str, size: int) -> bytes:
        """A JPEG of a recorded tick.

        Raises:
            NotFound: there are no images of the episode, or not of the camera.
            Unreadable: they are damaged.
        """
        video = self.recordings.video(leg, record.key)
        if video is not None:
            return _jpeg(video_frame(video, tick, camera), size)
        demo = self.recordings.demo(leg, record.key)
        if demo is None or demo.joints is None:
            raise NotFound(
                "no images of this episode were recorded: --video all or --record-states keep what they need"
            )
        return _jpeg(self.redrawer.frame(demo, tick, camera), size)


def runs_router(sources: Sequence[RunReader], *, drives: bool = False, below: Directory | None = None) -> APIRouter:
    """The routes below ``/api/runs``.

    Args:
        sources: the runs that were opened (``vecenv_eval.web.runs.open_runs``).
        drives: the server drives a session too, which the page then has a link to.
        below: a folder whose results folders are runs as well, as they come.
    """
    runs = Runs(sources, drives, below)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        yield
        await run_in_threadpool(runs.redrawer.close)

    router = APIRouter(prefix="/api/runs", tags=["runs"], lifespan=lifespan)
    _add_lists(router, runs)
    _add_recordings(router, runs)

    @router.websocket("/{run}/stream")
    async def stream(socket: WebSocket, run: str) -> None:
        """What happens in a run: text messages when it changes, one binary message for each newest frame."""
        await _stream(socket, runs, run)

    return router


def _add_lists(router: APIRouter, runs: Runs) -> None:
    @router.get("")
    def opened() -> RunList:
        """The runs that were opened."""
        infos = [runs.snapshot(name) for name in runs.look()]
        return RunList(
            runs=[
                RunRow(run=info.name, folder=clean(str(info.folder)), state=runs.state(info, live_frames(info)))
                for info in infos
            ],
            drives=runs.drives,
        )

    @router.get("/{run}")
    def run(run: RunName) -> RunInfo:
        """How a run stands: progress, success by task, conditions, and what cannot be read."""
        return runs.info(run)

    @router.get("/{run}/episodes")
    def episodes(
        run: RunName,
        show: Show = "all",
        order: Order = "worst",
        leg: Annotated[str | None, Query(max_length=500)] = None,
        task: Annotated[int | None, Query(ge=0, le=10**9)] = None,
        text: Annotated[str, Query(max_length=200)] = "",
        offset: Offset = 0,
        limit: Limit = 50,
    ) -> EpisodeList:
        """Episodes that have ended, what needs a look first; ``failures`` are all that were not solved."""
        snapshot = runs.snapshot(run)
        chosen = [
            (key, of_leg, record)
            for key, (of_leg, record) in snapshot.rows.items()
            if (leg is None or of_leg.name == leg)
            and (task is None or record.task == task)
            and _is_shown(record, show)
            and (not text or _says(record, text.lower()))
        ]
        chosen = _ordered(chosen, order, snapshot.order)
        rows = [
            episode_row(of_leg, record, snapshot.order[key]) for key, of_leg, record in chosen[offset : offset + limit]
        ]
        return EpisodeList(total=len(chosen), offset=offset, version=snapshot.version, rows=rows)

    @router.get("/{run}/compare/{other}")
    def compare(
        run: RunName, other: RunName, show: Change = "changed", offset: Offset = 0, limit: Limit = 50
    ) -> Compared:
        """Two runs on the same episodes, and which of them changed sides."""
        return _compared(runs.snapshot(run), runs.snapshot(other), show, offset, limit)


def _add_recordings(router: APIRouter, runs: Runs) -> None:
    @router.get("/{run}/episodes/{key}")
    def episode(run: RunName, key: Key) -> EpisodeDetail:
        """An episode, and what was recorded of it."""
        snapshot = runs.snapshot(run)
        leg, record = snapshot.row(key)
        return EpisodeDetail(
            row=episode_row(leg, record, snapshot.order[key]),
            record=clean(to_plain(record)),
            recorded=runs.recorded(leg, record),
        )

    @router.get(
        "/{run}/episodes/{key}/frame", response_class=Response, responses={200: {"content": {"image/jpeg": {}}}}
    )
    def frame(
        run: RunName,
        key: Key,
        tick: Annotated[int, Query(ge=0, le=10**7)] = 0,
        camera: Annotated[str, Query(min_length=1, max_length=64)] = WHOLE,
        size: Annotated[int, Query(ge=16, le=2048, description="longer side, pixels; images are not enlarged")] = 1024,
    ) -> Response:
        """The image before a tick: from the episode's video, else drawn from its recorded states."""
        content = runs.frame(*runs.snapshot(run).row(key), tick, camera, size)
        return Response(content, media_type="image/jpeg", headers={"cache-control": "private, max-age=60"})

    @router.get("/{run}/episodes/{key}/video", response_class=FileResponse)
    def video(run: RunName, key: Key) -> FileResponse:
        """The episode's video, an mp4."""
        leg, record = runs.snapshot(run).row(key)
        found = runs.recordings.video(leg, record.key)
        if found is None:
            raise NotFound("this episode has no video: `vecenv eval --video all` writes one an episode")
        return FileResponse(
            found.path, media_type="video/mp4", filename=found.path.name, content_disposition_type="inline"
        )

    @router.get("/{run}/episodes/{key}/curves")
    def curves_of(run: RunName, key: Key) -> Curves:
        """Actions and joint positions over ticks."""
        leg, record = runs.snapshot(run).row(key)
        demo = runs.recordings.demo(leg, record.key)
        if demo is None:
            raise NotFound("no actions of this episode were recorded: `vecenv eval --record` keeps them")
        return Curves(**curves(cast("DemoFacts", demo)))

    @router.get("/{run}/episodes/{key}/log")
    def log(run: RunName, key: Key) -> Log:
        """What the policy noted about the episode."""
        leg, record = runs.snapshot(run).row(key)
        found = runs.recordings.log(leg, record.key)
        if found is None:
            raise NotFound("the policy noted nothing about this episode")
        return Log(lines=clean(found[0]), complete=found[1])


# -- lists -------------------------------------------------------------------------------------------------------------


def _is_shown(record: Record, show: Show) -> bool:
    verdict = verdict_of(record)
    return show == "all" or verdict == show or (show == "failures" and verdict != "success")


def _says(record: Record, text: str) -> bool:
    return any(text in said.lower() for said in (record.key.id, record.instruction, record.fault, record.error))


def _ordered(
    rows: list[tuple[str, Leg, Record]], order: Order, number: Mapping[str, int]
) -> list[tuple[str, Leg, Record]]:
    if order == "recent":
        return sorted(rows, key=lambda row: -number[row[0]])
    if order == "steps":
        return sorted(rows, key=lambda row: (-row[2].num_steps, number[row[0]]))
    if order == "worst":
        return sorted(rows, key=lambda row: (_WORST_FIRST[verdict_of(row[2])], number[row[0]]))
    return sorted(rows, key=lambda row: (row[1].name, row[2].key))


# -- two runs ----------------------------------------------------------------------------------------------------------


def _paired(run: Snapshot) -> dict[tuple[str, int, int, int], tuple[Leg, Record]]:
    """Records by suite, task, episode, and which of the run's evaluations of the suite it is."""
    turns: dict[str, list[str]] = {}
    for leg in run.legs:
        turns.setdefault(leg.suite, []).append(leg.name)
    return {
        (record.suite, record.task, record.episode, turns[leg.suite].index(leg.name)): (leg, record)
        for leg, record in run.rows.values()
    }


def _compared(first: Snapshot, second: Snapshot, show: Change, offset: int, limit: int) -> Compared:
    ours, theirs = _paired(first), _paired(second)
    changes = {key: _change(ours.get(key), theirs.get(key)) for key in sorted(ours.keys() | theirs.keys())}
    counts = {name: sum(change == name for change in changes.values()) for name in ("lost", "won", "both", "neither")}
    wanted = {"all": None, "changed": ("lost", "won"), "unpaired": (None,)}.get(show, (show,))
    chosen = [key for key, change in changes.items() if wanted is None or change in wanted]
    return Compared(
        first=first.name,
        second=second.name,
        **counts,
        unpaired=sum(change is None for change in changes.values()),
        p_value=mcnemar(counts["lost"], counts["won"]),
        total=len(chosen),
        offset=offset,
        rows=[
            _compared_row(first, second, ours.get(key), theirs.get(key), changes[key])
            for key in chosen[offset : offset + limit]
        ],
    )


def _change(one: tuple[Leg, Record] | None, two: tuple[Leg, Record] | None) -> Any:
    if one is None or two is None or one[1].error or two[1].error:
        return None
    return {(True, False): "lost", (False, True): "won", (True, True): "both", (False, False): "neither"}[
        bool(one[1].success), bool(two[1].success)
    ]


def _compared_row(
    first: Snapshot, second: Snapshot, one: tuple[Leg, Record] | None, two: tuple[Leg, Record] | None, change: Any
) -> ComparedRow:
    rows = [_row_in(first, one), _row_in(second, two)]
    there = next(row for row in rows if row is not None)
    return ComparedRow(
        suite=there.suite,
        task=there.task,
        episode=there.episode,
        instruction=there.instruction,
        first=rows[0],
        second=rows[1],
        change=change,
    )


def _row_in(run: Snapshot, found: tuple[Leg, Record] | None) -> EpisodeRow | None:
    if found is None:
        return None
    row = episode_row(*found, 0)
    return row.model_copy(update={"number": run.order[row.key]})


# -- recordings --------------------------------------------------------------------------------------------------------


def _cameras(video: VideoFacts | None, leg: Leg, states: bool) -> list[str]:
    if video is not None:
        return [WHOLE, *video.cameras]
    if not states:
        return []
    return [WHOLE] if leg.suite.startswith("simpler/") else ["agentview", "wrist"]


def _video_info(video: VideoFacts) -> VideoInfo:
    return VideoInfo(
        frames=video.frames, fps=video.fps, width=video.width, height=video.height, cameras=list(video.cameras)
    )


def _jpeg(image: np.ndarray, size: int) -> bytes:
    from PIL import Image

    picture = Image.fromarray(np.ascontiguousarray(image))
    picture.thumbnail((size, size))
    buffer = io.BytesIO()
    picture.save(buffer, "JPEG", quality=_QUALITY)
    return buffer.getvalue()


# -- stream ------------------------------------------------------------------------------------------------------------


async def _stream(socket: WebSocket, runs: Runs, run: str) -> None:
    """Send what changes until the reader goes: looks wait while it is slow, so that it gets the newest and no queue."""
    await socket.accept()
    if runs.streams >= _MOST_STREAMS:
        await socket.close(1013, f"the server has {_MOST_STREAMS} readers already")
        return
    try:
        await run_in_threadpool(runs.snapshot, run)
    except VecenvError as error:
        await socket.close(1008, str(error)[:100])
        return
    runs.streams += 1
    gone = asyncio.create_task(_until_gone(socket))
    sender = asyncio.create_task(_send_changes(socket, runs, run))
    try:
        await asyncio.wait((gone, sender), return_when=asyncio.FIRST_COMPLETED)
    finally:
        runs.streams -= 1
        for task in (gone, sender):
            task.cancel()
        await asyncio.gather(gone, sender, return_exceptions=True)


async def _until_gone(socket: WebSocket) -> None:
    """What a reader says is passed over."""
    while (await socket.receive())["type"] != "websocket.disconnect":
        pass


async def _send_changes(socket: WebSocket, runs: Runs, run: str) -> None:
    seen: Any = None
    sent_rows: int | None = None
    sent_frames: set[Any] = set()
    processes: list[list[str]] = []
    try:
        while True:
            began = time.monotonic()
            snapshot, frames, state = await run_in_threadpool(_look, runs, run)
            if (snapshot.version, state) != seen:
                seen = (snapshot.version, state)
                await socket.send_text(await run_in_threadpool(_change_message, snapshot, state, sent_rows))
                sent_rows = len(snapshot.rows)
            if (now := [[frame.leg, frame.header.process] for frame in frames]) != processes:
                processes = now
                await socket.send_text(json.dumps({"type": "processes", "processes": processes}))
            for frame in frames:
                if frame.identity not in sent_frames:
                    await socket.send_bytes(frame.message())
            sent_frames = {frame.identity for frame in frames}
            await asyncio.sleep(max(_LOOK_S, (time.monotonic() - began) / _SHARE))
    except (WebSocketDisconnect, RuntimeError, OSError):
        return  # the reader has gone


def _look(runs: Runs, run: str) -> tuple[Snapshot, list[LiveFrame], State]:
    snapshot = runs.snapshot(run)
    frames = live_frames(snapshot)
    return snapshot, frames, runs.state(snapshot, frames)


def _change_message(snapshot: Snapshot, state: State, before: int | None) -> str:
    """How the run stands, and the rows that are new since the last message."""
    rows = [
        episode_row(leg, record, number).model_dump()
        for number, (leg, record) in enumerate(snapshot.rows.values())
        if before is not None and before <= number < before + _MOST_ROWS
    ]
    return json.dumps({"type": "run", **run_info(snapshot, state).model_dump(), "ended": rows})
