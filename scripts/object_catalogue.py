"""Write the catalogue of objects by which VoxPoser names clusters of points: size and colours by category.

For each task of some suites, reference views (episodes that evaluations of ten episodes a task do not use) are rendered
with masks, and the appearance of each object that is seen well is averaged. Run it again when objects are added:

    python scripts/object_catalogue.py
"""

from __future__ import annotations

import json
from collections import defaultdict
from pathlib import Path

import numpy as np

import vecenv
from voxposer.perception.cameras import depth_views
from voxposer.perception.config import CAMERAS
from voxposer.perception.geometry import Appearance, appearance, category

SUITES = ("libero_object", "libero_spatial", "libero_goal")
EPISODES = (40, 45)
OUT = Path(__file__).parents[1] / "voxposer" / "perception" / "catalogue.json"
# Pixels by which an object is seen well, and the height over the table below which it is not told from it, metres.
LEAST, OVER_TABLE = 80, 0.008


def views_of(suite: str, task: int) -> list[tuple[str, Appearance]]:
    """Category and appearance of each object in the reference views of a task."""
    found = []
    with vecenv.make(suite, task=task, episodes=EPISODES) as env:
        env.reset()
        seen = env.observe_egocentric()
        slots = range(len(EPISODES))
        for slot, views in enumerate(depth_views(seen, CAMERAS, slots, masks=True, colors=True, largest=320)):
            names = seen.instances[slot]
            heights = np.concatenate(
                [v.points[v.valid & (v.labels == 0) & (v.normals[..., 2] > 0.95), 2] for v in views]
            )
            table = float(np.median(heights))
            for index, name in enumerate(names):
                shown = [(v, v.valid & (v.labels == index) & (v.points[..., 2] > table + OVER_TABLE)) for v in views]
                points = np.concatenate([v.points[rows] for v, rows in shown])
                colors = np.concatenate([v.colors[rows] for v, rows in shown if v.colors is not None])
                if name not in ("", "robot") and len(points) >= LEAST:
                    found.append((category(name), appearance(points, colors, table)))
    return found


def main() -> None:
    """Render the reference views and write the file."""
    looks: dict[str, list[Appearance]] = defaultdict(list)
    for suite in SUITES:
        for task in range(len(vecenv.list_tasks(suite))):
            for name, look in views_of(suite, task):
                looks[name].append(look)
            print(suite, task, len(looks), "categories")
    categories = {
        name: {
            "size": np.median([look.size for look in own], axis=0).round(4).tolist(),
            "colors": np.mean([look.colors for look in own], axis=0).round(4).tolist(),
            "views": len(own),
        }
        for name, own in sorted(looks.items())
    }
    text = {"made_by": "scripts/object_catalogue.py", "suites": SUITES, "episodes": EPISODES, "categories": categories}
    OUT.write_text(json.dumps(text, indent=1) + "\n", encoding="utf-8")
    print(f"{len(categories)} categories in {OUT}")


if __name__ == "__main__":
    main()
