"""Ground truth as one plain mapping, which goes over a wire and through JSON, and back.

:func:`snapshot_to_dict` makes it of an ``ObjectsSnapshot``: names, numbers, texts, lists and float64 arrays.
:func:`snapshot_from_dict` reads it again, arrays or nested lists, and gives an equal snapshot; what does not fit is one
sentence that names the entry.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from vecenv.interop.nodes.ports import NodeError
from vecenv.observations import ObjectsSnapshot, Part, PartJoint, PointCloud, RegionBox

# Fields of a snapshot that are arrays of a fixed shape.
_ARRAYS = {"ee_pose": (7,), "gripper": (2,), "workspace": (2, 3)}
_NEEDED = ("names", "objects", "poses", "scene", *_ARRAYS)
_KNOWN = (*_NEEDED, "regions", "goal", "targets", "movable", "parts", "panda_base")


def snapshot_to_dict(snapshot: ObjectsSnapshot) -> dict[str, Any]:
    """A snapshot as a mapping; the keys are the attributes of ``ObjectsSnapshot``. Arrays are copies."""
    return {
        "names": list(snapshot.names),
        "objects": {name: _cloud(cloud) for name, cloud in snapshot.objects.items()},
        "poses": {name: np.array(pose, float) for name, pose in snapshot.poses.items()},
        "regions": {name: _box(box) for name, box in snapshot.regions.items()},
        "goal": [list(predicate) for predicate in snapshot.goal],
        "scene": _cloud(snapshot.scene),
        **{name: np.array(getattr(snapshot, name), float) for name in _ARRAYS},
        "targets": list(snapshot.targets),
        "movable": list(snapshot.movable),
        "parts": {name: _part(part) for name, part in snapshot.parts.items()},
        "panda_base": None if snapshot.panda_base is None else np.array(snapshot.panda_base, float),
    }


def _cloud(cloud: PointCloud) -> dict[str, np.ndarray]:
    return {"points": np.array(cloud.points, float), "normals": np.array(cloud.normals, float)}


def _box(box: RegionBox) -> dict[str, Any]:
    return {
        "pos": np.array(box.pos, float),
        "mat": np.array(box.mat, float),
        "half_extents": np.array(box.half_extents, float),
        "parent": box.parent,
        "axis": None if box.axis is None else np.array(box.axis, float),
    }


def _part(part: Part) -> dict[str, Any]:
    joint = part.joint
    return {
        "parent": part.parent,
        "kind": part.kind,
        "cloud": _cloud(part.cloud),
        "box": None if part.box is None else _box(part.box),
        "joint": None
        if joint is None
        else {
            "kind": joint.kind,
            "axis": np.array(joint.axis, float),
            "anchor": np.array(joint.anchor, float),
            "travel": float(joint.travel),
            "opened": float(joint.opened),
        },
    }


# -- and back ----------------------------------------------------------------------------------------------------------


def snapshot_from_dict(value: object) -> ObjectsSnapshot:
    """The snapshot that a mapping holds; a snapshot itself is returned as it is.

    Raises:
        NodeError: an entry is missing or does not fit; the message names it.
    """
    if isinstance(value, ObjectsSnapshot):
        return value
    given = _mapping(value, "snapshot")
    if missing := [name for name in _NEEDED if name not in given]:
        raise NodeError(f"snapshot: {missing[0]!r} is missing; expected what observe_objects returns")
    if unknown := [name for name in given if name not in _KNOWN]:
        raise NodeError(f"snapshot: {str(unknown[0])[:80]!r} does not exist; there are {', '.join(_KNOWN)}")
    base = given.get("panda_base")
    return ObjectsSnapshot(
        names=_texts(given["names"], "names"),
        objects={name: _read_cloud(each, f"objects.{name}") for name, each in _items(given, "objects")},
        poses={name: _array(each, f"poses.{name}", (7,)) for name, each in _items(given, "poses")},
        regions={name: _read_box(each, f"regions.{name}") for name, each in _items(given, "regions")},
        goal=tuple(_texts(each, "goal") for each in _list(given.get("goal", []), "goal")),
        scene=_read_cloud(given["scene"], "scene"),
        **{name: _array(given[name], name, shape) for name, shape in _ARRAYS.items()},
        targets=_texts(given.get("targets", []), "targets"),
        movable=_texts(given.get("movable", []), "movable"),
        parts={name: _read_part(each, f"parts.{name}") for name, each in _items(given, "parts")},
        panda_base=None if base is None else _array(base, "panda_base", (7,)),
    )


def _read_cloud(value: object, where: str) -> PointCloud:
    given = _mapping(value, where)
    points, normals = (_array(given.get(name), f"{where}.{name}", (None, 3)) for name in ("points", "normals"))
    if len(points) != len(normals):
        raise NodeError(f"snapshot: {where} has {len(points)} points and {len(normals)} normals")
    return PointCloud(points, normals)


def _read_box(value: object, where: str) -> RegionBox:
    given = _mapping(value, where)
    axis = given.get("axis")
    return RegionBox(
        pos=_array(given.get("pos"), f"{where}.pos", (3,)),
        mat=_array(given.get("mat"), f"{where}.mat", (3, 3)),
        half_extents=_array(given.get("half_extents"), f"{where}.half_extents", (3,)),
        parent=None if given.get("parent") is None else _text(given["parent"], f"{where}.parent"),
        axis=None if axis is None else _array(axis, f"{where}.axis", (3,)),
    )


def _read_part(value: object, where: str) -> Part:
    given = _mapping(value, where)
    box, joint = given.get("box"), given.get("joint")
    return Part(
        parent=_text(given.get("parent"), f"{where}.parent"),
        kind=_text(given.get("kind"), f"{where}.kind"),
        cloud=_read_cloud(given.get("cloud"), f"{where}.cloud"),
        box=None if box is None else _read_box(box, f"{where}.box"),
        joint=None if joint is None else _read_joint(joint, f"{where}.joint"),
    )


def _read_joint(value: object, where: str) -> PartJoint:
    given = _mapping(value, where)
    numbers = {name: float(_array(given.get(name), f"{where}.{name}", ())) for name in ("travel", "opened")}
    return PartJoint(
        kind=_text(given.get("kind"), f"{where}.kind"),
        axis=_array(given.get("axis"), f"{where}.axis", (3,)),
        anchor=_array(given.get("anchor"), f"{where}.anchor", (3,)),
        **numbers,
    )


def _array(value: object, where: str, shape: tuple[int | None, ...]) -> np.ndarray:
    right = "[" + ", ".join("N" if each is None else str(each) for each in shape) + "]"
    try:
        array = np.array(value)
    except (TypeError, ValueError, RecursionError):
        raise NodeError(f"snapshot: {where} is ragged; expected numbers {right}") from None
    if array.size == 0 and shape and shape[0] is None:
        return np.zeros((0, *(each or 0 for each in shape[1:])))
    if array.dtype.kind not in "iuf":
        raise NodeError(f"snapshot: {where} holds no numbers; expected {right}")
    fits = array.ndim == len(shape) and all(
        want in (None, have) for want, have in zip(shape, array.shape, strict=False)
    )
    if not fits:
        raise NodeError(f"snapshot: {where} has shape {list(array.shape)}; expected {right}")
    if not np.isfinite(array).all():
        raise NodeError(f"snapshot: {where} is not finite")
    return array.astype(float)


def _items(given: Mapping[str, Any], name: str) -> list[tuple[str, Any]]:
    pairs = list(_mapping(given.get(name, {}), name).items())
    for key, _ in pairs:
        _text(key, f"a name in {name}")
    return pairs


def _mapping(value: object, where: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise NodeError(f"snapshot: {where} is a {type(value).__name__}; expected a mapping")
    return value


def _list(value: object, where: str) -> list[Any]:
    if not isinstance(value, list | tuple):
        raise NodeError(f"snapshot: {where} is a {type(value).__name__}; expected a list")
    return list(value)


def _texts(value: object, where: str) -> tuple[str, ...]:
    return tuple(_text(each, f"an entry of {where}") for each in _list(value, where))


def _text(value: object, where: str) -> str:
    if not isinstance(value, str):
        raise NodeError(f"snapshot: {where} is a {type(value).__name__}; expected text")
    return value
