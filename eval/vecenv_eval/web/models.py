"""What goes over HTTP: bodies of requests and responses, and messages of the stream; the schema is made of them.

A body with a field that is not here is refused. Responses that are states of a session are the frozen dataclasses of
``vecenv_eval.panel.state``.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from vecenv_eval.panel.state import Fields, SessionState, StateName

# Limits that keep a request small; what a server allows beyond them is in ``settings.ServeSettings``.
Name = Annotated[str, StringConstraints(min_length=1, max_length=200)]
Spec = Annotated[str, StringConstraints(min_length=1, max_length=2000)]
MOST_SLOTS = 4096


class Body(BaseModel):
    """A body of a request: no other fields, no conversion between kinds of values."""

    model_config = ConfigDict(extra="forbid", strict=True)


class ErrorBody(BaseModel):
    """What every answer with a status of 400 or more holds: one sentence, and the field that it is about."""

    error: str
    field: str | None = None


# What routes that change something answer besides, while another client is the writer or it is not their turn.
CONFLICT: dict[int | str, dict[str, Any]] = {409: {"model": ErrorBody}}


class Health(BaseModel):
    """The server runs."""

    status: Literal["ok"] = "ok"
    version: str


class SuiteRow(BaseModel):
    """One suite; ``label`` is for people."""

    name: str
    family: str
    num_tasks: int
    label: str


class Catalog(BaseModel):
    """Every suite."""

    suites: list[SuiteRow]


class TaskRow(BaseModel):
    """One task: its index (its name in SIMPLER), and how many episodes it has."""

    task: int | str
    label: str
    instruction: str
    num_episodes: int


class TaskCatalog(BaseModel):
    """The tasks of a suite."""

    tasks: list[TaskRow]


class PolicyRow(BaseModel):
    """A policy that clients may ask for."""

    name: str
    description: str


class PolicyCatalog(BaseModel):
    """The policies that clients may ask for."""

    policies: list[PolicyRow]


class SessionBody(Body):
    """What to build: as the options of ``vecenv eval`` of the same names.

    ``num_slots`` limits how many episodes run at once; the others follow when a slot ends. Null runs all at once, up to
    the server's limit.
    """

    suite: Name
    tasks: Spec = "0"
    episodes: Spec = "0-0"
    policy: Name | None = None
    policy_args: dict[str, Any] = Field(default_factory=dict)
    num_slots: Annotated[int, Field(ge=1, le=MOST_SLOTS)] | None = None
    env_args: dict[str, Any] = Field(default_factory=dict)
    seed: Annotated[int, Field(ge=0, le=2**31 - 1)] | None = None


class FieldBody(Body):
    """A choice in the panel: the fields below it are set to their first value, and one episode is placed."""

    name: Literal["suite", "split", "task", "task_id", "episode", "episode_index"]
    value: Annotated[int, Field(ge=0, le=2**31 - 1)] | Name


class FieldAnswer(BaseModel):
    """The panel after a choice; ``snapshot`` is the selection that the signal carries."""

    fields: Fields
    signal_name: Literal["episode_reset"] = "episode_reset"
    snapshot: Fields


class ActionBody(Body):
    """What to do with the run; ``ticks`` is for "step"."""

    action: Literal["play", "pause", "step", "stop", "reset"]
    ticks: Annotated[int, Field(ge=1, le=10_000)] = 1


class ActionAnswer(BaseModel):
    """The state after an action.

    ``signal_name``: "run_start" when a run began, "episode_reset" when the episodes were put back to their start.
    """

    state: StateName
    signal_name: Literal["episode_reset", "run_start"] | None = None
    session: SessionState


class SpeedBody(Body):
    """The speed limit, control ticks a second; null for as fast as it goes."""

    ticks_per_second: Annotated[float, Field(gt=0, le=10_000, allow_inf_nan=False)] | None


class LoginBody(Body):
    """The server's token."""

    token: Annotated[str, StringConstraints(min_length=1, max_length=1000)]


class Done(BaseModel):
    """It was done."""

    ok: Literal[True] = True


class Subscription(Body):
    """What a reader of the stream wants to see.

    Attributes:
        slot: the slot whose cameras are shown, and whose plan the session's state has.
        cameras: which cameras, by name; none for no images of the slot.
        size: longer side of the images, pixels; images are not enlarged.
        wall: also one mosaic of all slots.
        fps: most frames a second of each image.
    """

    slot: Annotated[int, Field(ge=0, lt=MOST_SLOTS)] = 0
    cameras: Annotated[list[Annotated[str, StringConstraints(min_length=1, max_length=64)]], Field(max_length=8)] = []
    size: Annotated[int, Field(ge=16, le=1024)] = 256
    wall: bool = False
    fps: Annotated[float, Field(gt=0, le=60, allow_inf_nan=False)] = 10.0


class StreamMessage(Body):
    """A text message of a reader: what it wants to see, or that it still is the writer."""

    subscribe: Subscription | None = None
    writer: Annotated[str, StringConstraints(min_length=8, max_length=64)] | None = None


class NodeBody(Body):
    """Inputs of a node by port, and its config; ``node`` tells several nodes of a graph with the same type apart."""

    inputs: dict[str, Any] = Field(default_factory=dict)
    config: dict[str, Any] = Field(default_factory=dict)
    node: Annotated[str, StringConstraints(max_length=64)] = ""


class NodeAnswer(BaseModel):
    """Outputs of a node by port; ``error`` is one of them when it could not do it."""

    outputs: dict[str, Any]


class PortRow(BaseModel):
    """A port of a node."""

    name: str
    type: str
    optional: bool = False
    description: str = ""


class NodeRow(BaseModel):
    """A node: its ports, and the JSON schema of its config."""

    node_type: str
    node_set: str
    display_name: str
    description: str
    inputs: list[PortRow]
    outputs: list[PortRow]
    config: dict[str, Any]


class NodeSetRow(BaseModel):
    """A node set; one with a panel has environments, whose episodes the panel chooses."""

    name: str
    display_name: str
    has_panel: bool


class NodeCatalog(BaseModel):
    """Every node and node set."""

    nodes: list[NodeRow]
    sets: list[NodeSetRow]


class PanelFields(BaseModel):
    """The fields of a node set's panel: name, value, default, and options with labels."""

    fields: list[dict[str, Any]]


class PanelField(Body):
    """A choice in a node set's panel."""

    name: Name
    value: Annotated[int, Field(ge=0, le=2**31 - 1)] | Name


class PanelAction(Body):
    """An action of a node set's panel."""

    action: Literal["play", "pause", "stop", "reset"]


class PanelAnswer(BaseModel):
    """A node set's panel after a choice or an action."""

    state: str
    fields: dict[str, str | int]
    signal_name: str | None = None
    snapshot: dict[str, str | int] | None = None
    run_start: bool = False
    step_budget: int | None = None
