"""What there is to see of a planned motion: points, cuts through maps, and figures as plotly takes them.

A :class:`~voxposer.planned.PlannedMotion` comes in, with the maps that it was planned on; nothing is computed from the
state that the episode reached later. Colours of text, axes and background are left to the page, which knows whether it
is light or dark.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from vecenv.manipulation.world import matrix
from voxposer.perception.grid import VoxelGrid
from voxposer.planned import PlannedMotion
from voxposer.planning.config import PlannerConfig
from voxposer.planning.planner import cost_map

Figure: TypeAlias = dict[str, Any]
# Of objects, in the order of their names; readable on white and on black (after Okabe and Ito, and Tol).
COLORS = ("#2a8fd8", "#e69f00", "#cc79a7", "#009e73", "#b07aa1", "#56b4e9", "#9c755f", "#d55e00", "#76b7b2", "#bab000")
TARGET, AVOID, PATH, HAND = "#0a9a4b", "#d93025", "#1a73e8", "#f29900"
# Voxels of an obstacle map above this are drawn in 3D, and no more than that many; points of the scene likewise.
_AVOID_ABOVE, _MOST_VOXELS, _MOST_POINTS = 0.3, 2500, 500
# Length of the axes that show the hand's orientation, metres, and how many poses of a way have them.
_AXIS, _MOST_AXES = 0.04, 8
_DIGITS = 4


def objects(motion: PlannedMotion) -> dict[str, np.ndarray]:
    """Surface points of each object with its parts, by name, metres, world frame, [n, 3]."""
    snapshot = motion.perception.snapshot
    found = {}
    for name, cloud in snapshot.objects.items():
        parts = [part.cloud.points for part in snapshot.parts.values() if part.parent == name]
        found[name] = _inside(np.concatenate([cloud.points, *parts]), motion.perception.grid)
    return {name: points for name, points in found.items() if len(points)}


def layers(motion: PlannedMotion) -> dict[str, np.ndarray]:
    """What there is to see of a motion besides objects: name -> points [n, 3], metres, world frame; none is [0, 3]."""
    perception, request, grid = motion.perception, motion.request, motion.perception.grid
    none = np.zeros((0, 3))
    return {
        "surroundings": _inside(perception.scene.scenery, grid),
        "keep away": none if motion.obstacles is None else grid.world(np.argwhere(motion.obstacles > _AVOID_ABOVE)),
        "targets": none if request.targets is None else grid.world(np.argwhere(request.targets)),
        "planner's path": grid.world(motion.path) if len(motion.path) else none,
        "hand's way": np.array([stop.pos for stop in motion.stops]).reshape(-1, 3),
    }


def _inside(points: np.ndarray, grid: VoxelGrid) -> np.ndarray:
    return points[((points >= grid.lo) & (points <= grid.hi)).all(axis=1)]


@dataclass(frozen=True)
class MapView:
    """A map of a motion.

    Attributes:
        name: what it is.
        values: [N, N, N]; None where the map is the same everywhere.
        limits: smallest and largest value that its colours show.
        scale: plotly's name of the colours.
        constant: the map in words where it is the same everywhere, or does not exist.
    """

    name: str
    values: np.ndarray | None
    limits: tuple[float, float]
    scale: str
    constant: str = ""


def map_views(motion: PlannedMotion, config: PlannerConfig) -> list[MapView]:
    """The maps that a motion was planned on: value, avoidance, rotation, gripper and velocity.

    The value is what a voxel costs the planner: 0 at the best, 1 at the worst, or at the start for a cost to go.
    """
    request, grid = motion.request, motion.perception.grid
    value, avoidance = None, None
    if motion.obstacles is not None and request.targets is not None:
        value = motion.value if motion.value is not None else _upstreams(request.targets, motion.obstacles, config)
        avoidance = motion.obstacles if motion.obstacles.any() else None
    unplanned = {"home": "not planned: the hand goes home", "stay": "not planned: the hand stays"}.get(request.kind, "")
    nothing = "nothing: the hand pushes or pulls, and no program says otherwise"
    turned = None if request.rotation.ndim == 1 else _turned(request.rotation, motion.start[3:])
    quat = ", ".join(f"{part:.2f}" for part in request.rotation) if turned is None else ""
    grip = "" if request.gripper.ndim else ("open everywhere" if request.gripper >= 0.5 else "closed everywhere")
    speed = "" if request.velocity.ndim else f"{float(request.velocity):.2f} of full speed everywhere"
    shape = (grid.size,) * 3
    assert all(each is None or each.shape == shape for each in (value, avoidance, turned))
    return [
        MapView("value (cost)", value, (0, 1), "Viridis", unplanned),
        MapView("keep away", avoidance, (0, 1), "Reds", unplanned or nothing),
        MapView("rotation, degrees from the hand's", turned, (0, 180), "Cividis", f"wxyz {quat} everywhere"),
        MapView("gripper (1 open)", request.gripper if request.gripper.ndim else None, (0, 1), "Blues", grip),
        MapView("velocity", request.velocity if request.velocity.ndim else None, (0, 1), "Plasma", speed),
    ]


def _upstreams(targets: np.ndarray, obstacles: np.ndarray, config: PlannerConfig) -> np.ndarray:
    """Upstream's cost map, [N, N, N]."""
    with jax.enable_x64(True):
        return np.asarray(cost_map(jnp.asarray(targets), jnp.asarray(obstacles, float), config))


def _turned(quats: np.ndarray, hand: np.ndarray) -> np.ndarray:
    """Angle of each rotation [..., 4] from the hand's [4], degrees."""
    length = np.maximum(np.linalg.norm(quats, axis=-1), 1e-9)
    cosine = np.abs(np.einsum("...k,k->...", quats, hand)) / length
    return np.degrees(2 * np.arccos(np.clip(cosine, 0, 1)))


# -- three dimensions --------------------------------------------------------------------------------------------------


def scene_figure(motion: PlannedMotion, names: Sequence[str]) -> Figure:
    """A motion in its scene: objects by name, surroundings, targets, what is kept away from, path, way and grip.

    Args:
        motion: the motion.
        names: of all objects, which decide their colours.
    """
    found = layers(motion)
    data = [_cloud("surroundings", _thinned(found["surroundings"], _MOST_POINTS), 2, "#8a9099", 0.35)]
    things = objects(motion)
    for name, points in things.items():
        data.append(_cloud(name, _thinned(points, _MOST_POINTS), 2.5, color_of(name, names), 0.9))
    data.append(_labels(things, names))
    data.append(_cloud("keep away", _thinned(found["keep away"], _MOST_VOXELS), 3, AVOID, 0.12))
    data.append(_cloud("targets", _thinned(found["targets"], _MOST_VOXELS), 5, TARGET, 0.9))
    data.append(_line("planner's path", found["planner's path"], PATH))
    if motion.stops:
        data += [_line("hand's way", found["hand's way"], HAND), _grip(motion), _axes(motion)]
    layout = {
        "scene": {
            "aspectmode": "data",
            "domain": {"x": [0.25, 1]},
            "camera": {"eye": {"x": 1.15, "y": -0.65, "z": 0.95}, "center": {"x": 0, "y": 0, "z": -0.15}},
            **{f"{axis}axis": {"title": {"text": f"{axis}, m"}} for axis in "xyz"},
        },
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "height": 520,
        "legend": {"itemsizing": "constant", "x": 0, "y": 1, "font": {"size": 12}},
    }
    return {"data": [trace for trace in data if trace], "layout": layout}


def color_of(name: str, names: Sequence[str]) -> str:
    """The colour of an object, the same in all motions."""
    return COLORS[sorted(names).index(name) % len(COLORS)]


def _cloud(name: str, points: np.ndarray, size: float, color: str, opacity: float) -> Figure:
    if not len(points):
        return {}
    marker = {"size": size, "color": color, "opacity": opacity}
    return _points(points) | {"mode": "markers", "name": escape(name), "marker": marker, "hoverinfo": "name"}


def _line(name: str, points: np.ndarray, color: str) -> Figure:
    if not len(points):
        return {}
    return _points(points) | {"mode": "lines", "name": name, "line": {"color": color, "width": 5}, "hoverinfo": "name"}


def _labels(things: Mapping[str, np.ndarray], names: Sequence[str]) -> Figure:
    """The names of the objects over them."""
    if not things:
        return {}
    tops = np.array([[*points.mean(axis=0)[:2], points[:, 2].max() + 0.02] for points in things.values()])
    text = {"color": [color_of(name, names) for name in things], "size": 11}
    labels = {"mode": "text", "text": [escape(name) for name in things], "textfont": text}
    return _points(tops) | labels | {"name": "names", "hoverinfo": "skip"}


def _grip(motion: PlannedMotion) -> Figure:
    """The stops of the hand: open circles while the grip is open, filled ones while it is closed."""
    points = np.array([stop.pos for stop in motion.stops])
    symbols = ["circle" if stop.closed else "circle-open" for stop in motion.stops]
    words = ["closed" if stop.closed else "open" for stop in motion.stops]
    text = [f"stop {t}: {word}" for t, word in enumerate(words, start=1)]
    marker = {"size": 6, "color": HAND, "symbol": symbols}
    return _points(points) | {
        "mode": "markers",
        "name": "stops (filled: grip closed)",
        "marker": marker,
        "text": text,
        "hoverinfo": "text",
    }


def _axes(motion: PlannedMotion) -> Figure:
    """The direction in which the hand's fingers point, at some of its stops."""
    stops = [motion.stops[i] for i in np.unique(np.linspace(0, len(motion.stops) - 1, _MOST_AXES).round().astype(int))]
    rows = [row for s in stops for row in (s.pos, s.pos + _AXIS * matrix(s.quat)[:, 2], np.full(3, np.nan))]
    return _line("fingers point", np.array(rows), "#7b61ff")


def _points(points: np.ndarray) -> Figure:
    x, y, z = (_numbers(column) for column in points.T)
    return {"type": "scatter3d", "x": x, "y": y, "z": z}


def _thinned(points: np.ndarray, most: int) -> np.ndarray:
    return points[:: max(1, -(-len(points) // most))]


def _numbers(values: np.ndarray) -> list[float | None]:
    """Numbers for a page, NaN as gaps."""
    return [None if np.isnan(value) else round(float(value), _DIGITS) for value in values]


# -- slices ------------------------------------------------------------------------------------------------------------


def slices_figure(motion: PlannedMotion, views: Sequence[MapView]) -> Figure | None:
    """The maps that vary, cut level at the height of the motion's end (above) and upright through it (below).

    None where no map varies.
    """
    drawn = [view for view in views if view.values is not None]
    if not drawn:
        return None
    grid, (row, end) = motion.perception.grid, _end(motion)
    centres = [np.linspace(grid.lo[axis], grid.hi[axis], grid.size) for axis in range(3)]
    way = motion.perception.grid.world(motion.path) if len(motion.path) else np.array([s.pos for s in motion.stops])
    data: list[Figure] = []
    layout: Figure = {"height": 560, "margin": {"l": 45, "r": 10, "t": 40, "b": 60}, "showlegend": False}
    layout["annotations"] = []
    share, gap = 1 / max(len(drawn), 3), 0.05
    for column, view in enumerate(drawn):
        assert view.values is not None
        left, right = column * share, (column + 1) * share - (gap if column < len(drawn) - 1 else 0)
        cuts = (((0, 1), view.values[:, :, row[2]].T), ((0, 2), view.values[:, row[1], :].T))
        for line, ((across, up), cut) in enumerate(cuts):
            # Plotly calls its first axes x and y, the next ones x2 and y2.
            axis = str(2 * column + line + 1) if column or line else ""
            x, y = f"x{axis}", f"y{axis}"
            bar = {"x": (left + right) / 2, "len": right - left} if line == 0 else None
            heat = _heat(view, cut, centres[across], centres[up], bar)
            data.append(heat | {"xaxis": x, "yaxis": y})
            data.append(_trail(way[:, across], way[:, up], x, y))
            data.append(_cross(end[across], end[up], x, y))
            low, high = (0.56, 1.0) if line == 0 else (0.06, 0.46)
            title = {"text": "yz"[line] + ", m", "standoff": 2} if column == 0 else {"text": ""}
            wide, tall = ([float(centres[a][0]), float(centres[a][-1])] for a in (across, up))
            flat = {"domain": [left, right], "anchor": y, "title": {"text": "x, m", "standoff": 2}, "range": wide}
            upright = {"domain": [low, high], "anchor": x, "title": title, "range": tall, "scaleanchor": x}
            layout[f"xaxis{axis}"] = flat | {"constrain": "domain"}
            layout[f"yaxis{axis}"] = upright | {"constrain": "domain"}
        layout["annotations"].append(_title(view.name, (left + right) / 2))
    return {"data": data, "layout": layout}


def _end(motion: PlannedMotion) -> tuple[np.ndarray, np.ndarray]:
    """Voxel, int [3], and world position [3] of the end of a motion."""
    grid = motion.perception.grid
    end = grid.world(motion.path[-1]) if len(motion.path) else motion.stops[-1].pos
    return grid.voxel(end), np.asarray(end)


def _heat(view: MapView, cut: np.ndarray, x: np.ndarray, y: np.ndarray, bar: Figure | None) -> Figure:
    """A cut [rows along y, columns along x]; ``bar`` is where the bar of its colours is, None for none."""
    low, high = view.limits
    found = {
        "type": "heatmap",
        "z": [[round(float(value), 3) for value in line] for line in cut],
        "x0": round(float(x[0]), _DIGITS),
        "dx": round(float(x[1] - x[0]), 6),
        "y0": round(float(y[0]), _DIGITS),
        "dy": round(float(y[1] - y[0]), 6),
        "hovertemplate": "%{x:.2f}, %{y:.2f}: %{z}<extra></extra>",
        "colorscale": view.scale,
        "zmin": low,
        "zmax": high,
        "showscale": bar is not None,
    }
    place = {"orientation": "h", "xanchor": "center", "y": -0.06, "yanchor": "top", "thickness": 10}
    return found | ({"colorbar": place | bar} if bar else {})


def _trail(x: np.ndarray, y: np.ndarray, xaxis: str, yaxis: str) -> Figure:
    line = {"color": HAND, "width": 2}
    place = {"xaxis": xaxis, "yaxis": yaxis, "hoverinfo": "skip"}
    return {"type": "scatter", "mode": "lines", "x": _numbers(x), "y": _numbers(y), "line": line, **place}


def _cross(x: float, y: float, xaxis: str, yaxis: str) -> Figure:
    marker = {"symbol": "x", "size": 9, "color": TARGET, "line": {"color": "#ffffff", "width": 1}}
    place = {"xaxis": xaxis, "yaxis": yaxis, "hoverinfo": "skip"}
    return {"type": "scatter", "mode": "markers", "x": [float(x)], "y": [float(y)], "marker": marker, **place}


def _title(text: str, at: float) -> Figure:
    return {
        "text": text,
        "x": at,
        "xref": "paper",
        "xanchor": "center",
        "y": 1.02,
        "yref": "paper",
        "yanchor": "bottom",
        "showarrow": False,
    }


# -- along the way -----------------------------------------------------------------------------------------------------


def grip_figure(motion: PlannedMotion) -> Figure | None:
    """Grip, velocity and height of the hand along its way; None without stops."""
    if not motion.stops:
        return None
    points = np.array([stop.pos for stop in motion.stops])
    gone = np.concatenate([[0.0], np.linalg.norm(np.diff(points, axis=0), axis=1).cumsum()]) * 100
    x = _numbers(gone)
    grip = ["closed" if stop.closed else "open" for stop in motion.stops]
    before = "closed" if motion.closed else "open"
    steps = {"type": "scatter", "mode": "lines+markers", "line": {"color": HAND, "width": 3}, "xaxis": "x"}
    data = [
        steps
        | {
            "name": "grip",
            "x": [x[0], *x],
            "y": [before, *grip],
            "yaxis": "y",
            "line": {**steps["line"], "shape": "hv"},
        },
        steps | {"name": "velocity", "x": x, "y": [round(s.velocity, 3) for s in motion.stops], "yaxis": "y2"},
        steps | {"name": "height", "x": x, "y": _numbers(points[:, 2]), "yaxis": "y3"},
    ]
    for trace, color in zip(data, (HAND, "#cc79a7", PATH), strict=True):
        trace["line"] = {**trace["line"], "color": color}
    layout = {
        "height": 250,
        "margin": {"l": 75, "r": 10, "t": 10, "b": 45},
        "showlegend": False,
        "xaxis": {"title": {"text": "along the hand's way, cm"}, "anchor": "y3"},
        "yaxis": {
            "domain": [0.74, 1],
            "title": {"text": "grip"},
            "type": "category",
            "categoryarray": ["open", "closed"],
            "range": [-0.4, 1.4],
        },
        "yaxis2": {"domain": [0.38, 0.64], "title": {"text": "velocity"}, "range": [-0.1, 1.1]},
        "yaxis3": {"domain": [0, 0.28], "title": {"text": "z, m"}},
    }
    return {"data": data, "layout": layout}
