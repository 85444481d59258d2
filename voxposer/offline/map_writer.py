"""Programs that make the five kinds of map: affordance, avoidance, rotation, velocity and gripper.

A query such as "a point 10cm above the place position of the plate_1" comes in; the program that makes the map goes
out, with the functions that the prompts show. Positions are voxels: x back to front, y left to right, z up.
"""

from __future__ import annotations

import re

from voxposer.offline.grammar import read_between
from voxposer.offline.rules import BESIDE, CM, GAP, SIDES, THING, Groups, Rules, Writer, choose, get, variable

# Distance between objects that are put next to each other, centimetres.
ROOM = 2

# Points: what affordance queries ask for, and gripper queries too


def _centre(variable: str) -> list[str]:
    return [f"x, y, z = {variable}.position"]


def _grasp_point(match: Groups) -> list[str]:
    return [get(match["thing"]), f"x, y, z = {variable(match['thing'])}.grasp_position"]


def _place_point(match: Groups) -> list[str]:
    return [get(match["thing"]), f"x, y, z = {variable(match['thing'])}.{_share(match)}_position"]


def _share(match: Groups) -> str:
    """How the fields of a place begin: of the whole of it, of a corner, or of one half."""
    return match["half"].lower().removesuffix(" side") or "place"


def _above_point(match: Groups) -> list[str]:
    lines = _grasp_point(match) if match["which"] == "grasp" else _place_point(match)
    return [*lines, f"z = z + cm2index({match['cm']}, 'z')"]


def _before_place(match: Groups) -> list[str]:
    """A point in front of a place that has an opening."""
    name = variable(match["thing"])
    return [
        get(match["thing"]),
        "# out through the opening, which is where its normal points",
        f"x, y, z = {name}.place_position + cm2index({match['cm']}, {name}.normal)",
    ]


def _along(match: Groups) -> list[str]:
    """A point at a distance from an object, along or against a direction of a part."""
    name, sign = variable(match["thing"]), "-" if match["way"] == "against" else ""
    field = "normal" if match["field"] == "normal" else "axis"
    start = name if match["start"] == match["thing"] else "start"
    lines = [get(match["thing"])] if start == name else [get(match["start"], start), get(match["thing"])]
    return [*lines, f"x, y, z = {start}.position + cm2index({match['cm']}, {sign}{name}.{field})"]


def _beside_for(match: Groups) -> list[str]:
    """Next to an object, with room for another: the other's middle if it is pushed, the hand over it if it is held."""
    held = match["moved"] == "the held object"
    other = "held" if held else "moved"
    lines = [
        get(match["thing"], "beside"),
        get("held object" if held else match["moved"], other),
        "(min_x, min_y, min_z), (max_x, max_y, max_z) = beside.aabb",
        f"size_x, size_y, size_z = {other}.aabb[1] - {other}.aabb[0]",
        *_spot(match["side"], match["room"] or str(ROOM), other),
    ]
    if not held:
        return [*lines, "z = moved.position[2]"]
    return [*lines, *_hand_over(match["cm"])]


def _between_for(match: Groups) -> list[str]:
    """On the table in the middle of two objects, for the held one."""
    first, second = map(str, read_between(match["thing"]))
    return [
        get(first, "first"),
        get(second, "second"),
        get("held object", "held"),
        "x, y, z = (first.position + second.position) / 2",
        *_hand_over(match["cm"]),
    ]


def _center_for(match: Groups) -> list[str]:
    """On the table in the middle of it, for the held object."""
    return [
        get(match["thing"], "thing"),
        get("held object", "held"),
        "x, y, z = thing.position",
        *_hand_over(match["cm"]),
    ]


def _hand_over(cm: str) -> list[str]:
    """From the middle of the held object at x, y to the hand, on the table or above it."""
    height = f" + cm2index({cm}, 'z')" if cm else ""
    return [
        "table = parse_query_obj('table')",
        "# the underside of the held object goes there, the hand is above it",
        "x = x + held.hand_offset[0]",
        "y = y + held.hand_offset[1]",
        f"z = table.position[2] + held.hand_offset[2]{height}",
    ]


def _spot(side: str, room: str, other: str) -> list[str]:
    """x and y of the middle of an object of size ``size_x``, ``size_y`` that stands next to ``beside``."""
    if side in {"next to", "towards"}:
        return [
            "# on the side where it is now",
            f"away = {other}.position - beside.position",
            "away[2] = 0",
            "reach = index2cm((max_x - min_x + max_y - min_y + size_x + size_y) / 4)",
            f"x, y, z = beside.position + cm2index(reach + {room}, away)",
        ]
    axis, sign = SIDES[side]
    edge, way = ("max", "+") if sign > 0 else ("min", "-")
    across = "x" if axis == "y" else "y"
    return [
        f"{across} = (min_{across} + max_{across}) / 2",
        f"{axis} = {edge}_{axis} {way} cm2index({room}, '{axis}') {way} size_{axis} / 2",
    ]


def _offset_point(match: Groups) -> list[str]:
    """At a distance to one side, or two sides, of an object's bounds or of a voxel."""
    shifts = [(match["cm"], match["side"].lower())]
    shifts += [(match["cm2"], match["side2"].lower())] if match["cm2"] else []
    voxel = re.fullmatch(r"\[? *(\d+)[ ,]+(\d+)[ ,]+(\d+) *\]?", match["thing"])
    if voxel:
        return [f"x, y, z = {voxel[1]}, {voxel[2]}, {voxel[3]}", *(_shift(cm, side, False) for cm, side in shifts)]
    name = variable(match["thing"])
    bounds = f"(min_x, min_y, min_z), (max_x, max_y, max_z) = {name}.aabb"
    return [get(match["thing"]), bounds, *_centre(name), *(_shift(cm, side, True) for cm, side in shifts)]


def _shift(cm: str, side: str, bounded: bool) -> str:
    """Out from the bounds on one side, or from a point."""
    axis, sign = SIDES[side]
    start = f"{'max' if sign > 0 else 'min'}_{axis}" if bounded else axis
    return f"{axis} = {start} {'+' if sign > 0 else '-'} cm2index({cm}, '{axis}')"


def _table_side(match: Groups) -> list[str]:
    sides = {"left": ("y", "min"), "right": ("y", "max"), "back": ("x", "min"), "front": ("x", "max")}
    corner = [sides[word] for word in re.findall("left|right|back|front", match["side"])]
    bounds = "(min_x, min_y, min_z), (max_x, max_y, max_z) = table.aabb"
    return [get("table"), bounds, *_centre("table"), *(f"{axis} = {end}_{axis}" for axis, end in corner)]


def _middle(match: Groups) -> list[str]:
    return [get(match["thing"]), *_centre(variable(match["thing"]))]


_SIDE = "|".join(SIDES)
_HALF = r"(?:the (?P<half>left side|right side|corner) of )?"
_POINTS: Rules = (
    (rf"the grasp position of {THING}", _grasp_point),
    (rf"the place position of {_HALF}{THING}", _place_point),
    (rf"a point {CM} above the (?P<which>grasp|place) position of {_HALF}{THING}", _above_point),
    (rf"a point {CM} in front of the place position of {THING}", _before_place),
    (
        rf"a point {CM} from (?P<start>.+?) (?P<way>along|against) the (?P<field>normal|opening axis) of {THING}",
        _along,
    ),
    (
        rf"a point (?:{CM} above|on) the table {GAP}(?P<side>{BESIDE}) {THING} for (?P<moved>the held object)",
        _beside_for,
    ),
    (rf"a point (?:{CM} above|on) the table between {THING} for the held object", _between_for),
    (rf"a point (?:{CM} above|on) the table at the center of {THING} for the held object", _center_for),
    (
        rf"a point (?P<room>\d+) ?cm (?P<side>{BESIDE}|towards) {THING} for (?P<moved>.+?)(?P<cm>)",
        _beside_for,
    ),
    (
        rf"a point {CM} (?P<side>{_SIDE}) (?:and (?P<cm2>\d+) ?cm (?P<side2>{_SIDE}) )?{THING}",
        _offset_point,
    ),
    (
        r"a point (?:on|at) the (?P<side>(?:(?:left|right|back|front) ?){1,2})(?: side| corner)? of the table",
        _table_side,
    ),
    (rf"(?:a point at )?the (?:center|centre|middle) of {THING}", _middle),
)


# Maps


def write_affordance(query: str) -> str:
    """The program of an affordance map. Raises NotUnderstood."""
    return choose(_AFFORDANCE, query, "get_affordance_map")


def _affordance(point: Writer) -> Writer:
    def write(match: Groups) -> list[str]:
        return [
            "affordance_map = get_empty_affordance_map()",
            *point(match),
            "affordance_map[x, y, z] = 1",
            "ret_val = affordance_map",
        ]

    return write


def _whole(match: Groups) -> list[str]:
    return [get(match["thing"]), f"ret_val = {variable(match['thing'])}.occupancy_map"]


_AFFORDANCE = (
    *((pattern, _affordance(point)) for pattern, point in _POINTS),
    (r"(?P<thing>the (?!grasp|place|center|centre|middle).+)", _whole),
)


def write_avoidance(query: str) -> str:
    """The program of an avoidance map. Raises NotUnderstood."""
    parts = re.split(r" and (?=\d+ ?cm)", " ".join(query.strip().rstrip(".").split()))
    spheres = [choose(_AVOIDANCE, part, "get_avoidance_map") for part in parts]
    return "\n".join(["avoidance_map = get_empty_avoidance_map()", *spheres, "ret_val = avoidance_map"])


def _sphere(match: Groups) -> list[str]:
    if re.match(r"(?:all|both|anything|everything)\b", match["thing"]):
        sphere = f"    set_voxel_by_radius(avoidance_map, thing.position, radius_cm={match['cm']}, value=1)"
        return [get(match["thing"], "things"), "for thing in things:", sphere]
    centre = f"{variable(match['thing'])}.position"
    return [get(match["thing"]), f"set_voxel_by_radius(avoidance_map, {centre}, radius_cm={match['cm']}, value=1)"]


_AVOIDANCE: Rules = ((rf"{CM} (?:from|near|around|of) {THING}", _sphere),)


def write_rotation(query: str) -> str:
    """The program of a rotation map. Raises NotUnderstood."""
    return choose(_ROTATION, query, "get_rotation_map")


def _everywhere(match: Groups, expression: str, *before: str) -> list[str]:
    return [
        "rotation_map = get_empty_rotation_map()",
        get(match["thing"]),
        *before,
        f"rotation_map[:, :, :] = {expression}",
        "ret_val = rotation_map",
    ]


def _orientation(match: Groups) -> list[str]:
    share = _share(match)
    place = "place_quat" if share == "corner" else f"{share}_quat"
    field = {"grasp": "grasp_quat", "placing": place, "pushing": "push_quat"}[match["which"].lower()]
    return _everywhere(match, f"{variable(match['thing'])}.{field}")


def _facing(match: Groups) -> list[str]:
    return _everywhere(match, f"vec2quat(-{variable(match['thing'])}.normal)")


def _facing_near(match: Groups) -> list[str]:
    other = variable(match["to"])
    around = f"{variable(match['thing'])}.position, radius_cm={match['cm']}"
    return [
        "rotation_map = get_empty_rotation_map()",
        get(match["to"]),
        get(match["thing"]),
        f"set_voxel_by_radius(rotation_map, {around}, value=vec2quat(-{other}.normal))",
        "ret_val = rotation_map",
    ]


def _turned(match: Groups) -> list[str]:
    name = variable(match["thing"])
    return _everywhere(
        match,
        f"qmult(turn, {name}.grasp_quat)",
        f"half = np.pi * {match['degrees']} / 360",
        f"axis_x, axis_y, axis_z = {name}.axis",
        "turn = np.array([np.cos(half), np.sin(half) * axis_x, np.sin(half) * axis_y, np.sin(half) * axis_z])",
    )


def _twist(match: Groups) -> list[str]:
    sign = "-" if match["way"].startswith("counter") else ""
    return [
        "rotation_map = get_empty_rotation_map()",
        "current = rotation_map[0, 0, 0]",
        f"turn = euler2quat(0, 0, {sign}np.pi * {match['degrees']} / 180)",
        "rotation_map[:, :, :] = qmult(current, turn)",
        "ret_val = rotation_map",
    ]


_ROTATION: Rules = (
    (rf"the (?P<which>grasp|placing|pushing) orientation of {_HALF}{THING}", _orientation),
    (rf"{THING} turned by (?P<degrees>-?\d+) degrees", _turned),
    (r"turn (?P<way>clockwise|counter-clockwise) by (?P<degrees>\d+) degrees", _twist),
    (rf"face (?P<to>.+?) when within {CM} (?:of|from) {THING}", _facing_near),
    (rf"face {THING}", _facing),
)


def write_velocity(query: str) -> str:
    """The program of a velocity map. Raises NotUnderstood."""
    return choose(_VELOCITY, query, "get_velocity_map")


def _speed(match: Groups) -> list[str]:
    words = {"half speed": "0.5", "a quarter of the speed": "0.25"}
    value = words.get(match["speed"], match["speed"].removesuffix("x speed"))
    made = f"velocity_map[:, :, :] = {value}"
    if match["thing"]:
        around = f"{variable(match['thing'])}.position, radius_cm={match['cm']}, value={value}"
        made = f"{get(match['thing'])}\nset_voxel_by_radius(velocity_map, {around})"
    return ["velocity_map = get_empty_velocity_map()", made, "ret_val = velocity_map"]


_VELOCITY: Rules = (
    (rf"(?P<speed>[\d.]+x speed|half speed|a quarter of the speed)(?: when within {CM} (?:of|from) {THING})?", _speed),
)


def write_gripper(query: str) -> str:
    """The program of a gripper map. Raises NotUnderstood."""
    return choose(_GRIPPER_MAP, query, "get_gripper_map")


def _state(match: Groups) -> list[str]:
    usual = int(match["state"].lower() == "open")
    lines = ["gripper_map = get_empty_gripper_map()", f"gripper_map[:, :, :] = {usual}"]
    if match["point"]:
        point = choose([*_POINTS, (THING, _middle)], match["point"], "get_gripper_map").splitlines()
        sphere = f"set_voxel_by_radius(gripper_map, [x, y, z], radius_cm={match['cm']}, value={1 - usual})"
        lines += [*point, sphere]
    return [*lines, "ret_val = gripper_map"]


_GRIPPER_MAP: Rules = ((rf"(?P<state>open|close)d? everywhere(?: except {CM} around (?P<point>.+))?", _state),)
