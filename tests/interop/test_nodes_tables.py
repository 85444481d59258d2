"""Every tool, port, type and option of the published node sets is there, and nothing that is not listed.

The published facts lie in ``tests/data/nodes``. With ``VECENV_SEEDS`` set to a folder of the published pages, their
tables are read as well, and compared with the tools and with those files.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml
from support.seed_tables import CONTROL, PublishedPort, Table, ports, tables

from vecenv.interop.nodes import NodeSet, WireType, node_sets
from vecenv.interop.nodes.panel import ACTIONS
from voxposer import nodes as voxposer_nodes

DATA = Path(__file__).parents[1] / "data" / "nodes"
NAMES = ("env_libero", "env_simpler", "voxposer")
FACTS: Mapping[str, Any] = {name: yaml.safe_load((DATA / f"{name}.yaml").read_text()) for name in NAMES}
SETS: Mapping[str, NodeSet] = {**node_sets(), **voxposer_nodes.node_sets()}
NODES = [(name, node) for name in NAMES for node in (*FACTS[name]["nodes"], *FACTS[name].get("more", ()))]


def facts_of(name: str, node: str) -> Mapping[str, Any]:
    return FACTS[name]["nodes"].get(node) or FACTS[name]["more"][node]


def both(facts: Mapping[str, Any], kind: str) -> dict[str, Any]:
    """What is published and what is added."""
    return {**facts.get(kind, {}), **facts.get("more", {}).get(kind, {})}


@pytest.mark.parametrize("name", NAMES)
def test_there_is_every_tool_and_no_other(name: str) -> None:
    assert set(SETS[name].tools) == {*FACTS[name]["nodes"], *FACTS[name].get("more", ())}
    added = {node for node, tool in SETS[name].tools.items() if tool.origin == "vecenv"}
    assert added == set(FACTS[name].get("more", ()))


@pytest.mark.parametrize(("name", "node"), NODES)
def test_ports_types_and_options_are_those_of_the_table(name: str, node: str) -> None:
    facts, tool = facts_of(name, node), SETS[name].tools[node]
    inputs = {each.name: each.type.value + " optional" * each.optional for each in tool.inputs}
    assert inputs == both(facts, "inputs")
    outputs = {each.name: each.type.value for each in tool.outputs}
    assert outputs == {**both(facts, "outputs"), "error": "TEXT"}
    assert tool.config().model_dump() == both(facts, "config")


@pytest.mark.parametrize("name", NAMES)
def test_every_tool_describes_itself_as_data(name: str) -> None:
    described = SETS[name].describe()
    assert [tool["node_type"] for tool in described["tools"]] == list(SETS[name].tools)
    for tool in described["tools"]:
        assert tool["description"]
        assert tool["display_name"]
        assert set(tool["config"].get("properties", {})) == set(both(facts_of(name, tool["node_type"]), "config"))
    assert described["parallelism"] == FACTS[name]["parallelism"]


@pytest.mark.parametrize("name", ["env_libero", "env_simpler"])
def test_panels_and_metadata_are_those_of_the_table(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    facts, nodes = FACTS[name], SETS[name]
    panel, metadata = nodes.panel, nodes.get_eval_metadata()
    assert panel is not None
    assert {field.name: field.default for field in panel.fields()} == facts["panel"]["fields"]
    assert list(ACTIONS) == facts["panel"]["actions"]
    tasks = facts["panel"]["tasks"]
    assert {head: len(own) for head, own in metadata["tasks"].items()} == tasks
    assert metadata["episode_counts"] == {head: count * facts["panel"]["episodes"] for head, count in tasks.items()}
    heads, _, episodes = panel.fields()
    assert [option.value for option in heads.options] == metadata["splits"] == list(tasks)
    assert all(f"({count} tasks)" in option.label for option, count in zip(heads.options, tasks.values(), strict=True))
    assert len(episodes.options) == facts["panel"]["episodes"]
    variable = facts["python_variable"]
    monkeypatch.setenv(variable, "/somewhere/python")
    assert nodes.server_python == "/somewhere/python"


def test_step_budgets_are_the_published_ones() -> None:
    libero, simpler = (SETS[name].get_eval_metadata() for name in ("env_libero", "env_simpler"))
    assert libero["step_budget"] == FACTS["env_libero"]["step_budget"]
    assert libero["default_per_step_budget_sec"] == FACTS["env_libero"]["default_per_step_budget_sec"]
    assert simpler["step_budgets"]["bridge"]["widowx_spoon_on_towel"] == 60
    assert simpler["step_budgets"]["google_robot"]["google_robot_pick_coke_can"] == 80
    budgets = SETS["voxposer"].get_eval_metadata()["step_budgets"]
    assert budgets == FACTS["voxposer"]["budgets"]


# -- the pages themselves ----------------------------------------------------------------------------------------------

SEEDS = os.environ.get("VECENV_SEEDS", "")
needs_seeds = pytest.mark.skipif(not SEEDS, reason="VECENV_SEEDS names no folder with the published pages")


def page(name: str) -> str:
    return (Path(SEEDS) / f"{name}.txt").read_text()


def table(text: str, *header: str) -> Table:
    """The one table that begins with these columns."""
    (found,) = [each for each in tables(text) if each.header[: len(header)] == header]
    return found


def rows_of_nodes(name: str) -> Iterator[tuple[str, dict[str, PublishedPort], dict[str, PublishedPort]]]:
    """Every node of an environment's table with its inputs and outputs."""
    published = table(page(f"{name.removeprefix('env_')}_nodeset"), "Node Type")
    inputs, outputs = (published.header.index(column) for column in ("Input Ports", "Output Ports"))
    control = {each: PublishedPort(None, False) for each in CONTROL}
    bundles: dict[str, Mapping[str, PublishedPort]] = {"the four control ports": control}
    for row in published.rows:
        for node in row[0].split(", "):
            wanted = {} if row[1] == "extras" else ports(row[inputs], {})
            given = ports(row[outputs], bundles)
            if node.endswith("__reset"):
                bundles |= {"reset bundle": given, "same as reset": given}
            yield node, wanted, given


@needs_seeds
@pytest.mark.parametrize("name", ["env_libero", "env_simpler"])
def test_every_row_of_the_published_table_of_nodes_is_served_and_listed(name: str) -> None:
    rows = list(rows_of_nodes(name))
    assert len(rows) == {"env_libero": 8, "env_simpler": 5}[name]
    for node, inputs, outputs in rows:
        tool, facts = SETS[name].tools[node], FACTS[name]["nodes"][node]
        for published, there, listed in (
            (inputs, tool.inputs, both(facts, "inputs")),
            (outputs, tool.outputs, {**both(facts, "outputs"), "error": "TEXT"}),
        ):
            by_name = {each.name: each for each in there}
            assert set(published) <= set(by_name), node
            assert set(published) <= set(listed), node
            for port, said in published.items():
                assert said.type in (None, by_name[port].type.value), (node, port)
                assert said.optional == by_name[port].optional, (node, port)
        # What is listed as published is in the row, apart from what the template adds to it.
        from_template = {"scene_id"} | ({"trigger", *facts.get("outputs", ())} if not outputs else set())
        assert set(facts.get("outputs", ())) - from_template <= set(outputs), node


@needs_seeds
def test_names_for_people_are_the_published_ones() -> None:
    for row in table(page("simpler_nodeset"), "Node Type").rows:
        assert SETS["env_simpler"].tools[row[0]].display_name == row[1]


@needs_seeds
@pytest.mark.parametrize("name", ["env_libero", "env_simpler"])
def test_every_port_of_the_published_observations_has_its_type(name: str) -> None:
    rows = table(page(f"{name.removeprefix('env_')}_nodeset"), "Port", "Wire Type").rows
    tools = SETS[name].tools
    seen = {port.name: port.type for tool in tools.values() for port in tool.outputs}
    assert rows
    for names, kind, _ in rows:
        for port in re.split(r"[,/]\s*", names):
            assert port.strip() in seen
            assert kind == "(per LIBERO)" or seen[port.strip()].value == kind


@needs_seeds
def test_the_template_holds_in_both_environments() -> None:
    text = page("env_nodeset_template")
    control = {row[0]: row[1] for row in table(text, "Port", "Type").rows}
    spaces = {row[0]: dict(re.findall(r"(\w+):([A-Z]+)", row[1])) for row in table(text, "Space", "Output ports").rows}
    assert tuple(control) == CONTROL
    for name in ("env_libero", "env_simpler"):
        tools = SETS[name].tools
        for verb, wanted in (
            ("step_continuous", control),
            ("step_ee_pose", control),
            ("observe_egocentric", spaces["egocentric"]),
            ("observe_objects", spaces["objects"]),
        ):
            there = {port.name: port.type.value for port in tools[f"{name}__{verb}"].outputs}
            assert wanted.items() <= there.items()
    known = {each.value for each in WireType}
    assert set(control.values()) <= known


@needs_seeds
@pytest.mark.parametrize("name", ["env_libero", "env_simpler"])
def test_the_published_fields_have_their_defaults(name: str) -> None:
    panel = SETS[name].panel
    assert panel is not None
    fields = {field.name: field for field in panel.fields()}
    rows = table(page(f"{name.removeprefix('env_')}_nodeset"), "Field", "Default").rows
    assert [row[0] for row in rows] == list(fields)
    for field, default, _ in rows:
        first = str(fields[field].options[0].value)
        assert str(fields[field].default) == (first if default == "first of split" else default)


@needs_seeds
def test_published_numbers_are_the_defaults() -> None:
    libero, simpler = page("libero_nodeset"), page("simpler_nodeset")
    options = {tool: SETS["env_libero"].tools[f"env_libero__{tool}"].config() for tool in ("step_ee_pose",)}
    motion = options["step_ee_pose"].model_dump()
    for option, pattern in (
        ("max_steps", r"max_steps \(default (\d+) env ticks"),
        ("pos_tol_m", r"pos_tol_m \(([\d.]+)\)"),
        ("rot_tol_rad", r"rot_tol_rad \(([\d.]+)\)"),
    ):
        (said,) = re.findall(pattern, libero.replace("`", ""))
        assert motion[option] == float(said)
    assert "max_chunk_steps" in libero
    (budget,) = re.findall(r"max_steps = (\d+)", libero)
    assert FACTS["env_libero"]["step_budget"] == int(budget)
    (seconds,) = re.findall(r"default_per_step_budget_sec = (\d+\.\d+)", libero)
    assert SETS["env_libero"].default_per_step_budget_sec == float(seconds)
    (counts,) = re.findall(r'\{"bridge": (\d+), "google_robot": (\d+)\}', simpler)
    assert list(SETS["env_simpler"].get_eval_metadata()["episode_counts"].values()) == [*map(int, counts)]
    (metrics,) = re.findall(r"METRICS: ([\w, ]+)\)", libero)
    assert FACTS["env_libero"]["metrics"] == metrics.split(", ")


@needs_seeds
def test_every_row_of_the_published_inventory_of_voxposer_is_served() -> None:
    text = page("voxposer_nodeset")
    begin, end = text.index("NodeInOutRole"), text.index("2.3 State")
    lines = [line for line in text[begin:end].splitlines() if line.startswith("voxposer__")]
    tools = SETS["voxposer"].tools
    assert len(lines) == len(tools) == 8
    for line in lines:
        node = max((each for each in tools if line.startswith(each)), key=len)
        facts = FACTS["voxposer"]["nodes"][node]
        rest = line.removeprefix(node).removeprefix(" (inner)").replace(" (JSON)", "").replace("?", "")
        rest = rest.replace("subtask_index/count", "subtask_index, subtask_count").replace("/", ", ")
        # Cells stand side by side without a mark between them; the last begins with a capital letter.
        columns = re.match(r"[a-z_, ]+", rest)
        outputs = [*facts["outputs"], *(["error"] if "error" in rest.split("Runs")[0].split("Outer-")[0] else [])]
        assert columns is not None
        assert columns[0] == ", ".join(facts["inputs"]) + ", ".join(outputs), node
    (settle,) = re.findall(r"settle_steps=(\d+)", text[begin:end])
    assert FACTS["voxposer"]["nodes"]["voxposer__expand_for_settle"]["config"]["settle_steps"] == int(settle)
    outer, inner = re.findall(r"subtask scope step_budget (\d+).*step_budget (\d+)\)", text)[0]
    assert FACTS["voxposer"]["budgets"] == {"subtasks": int(outer), "waypoints": int(inner)}
