"""Rows of results as Markdown tables: suites, scenes, which objects end elsewhere, and what was not compared."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence

from fidelity.jobs import IDLE_TICKS
from fidelity.measures import Row
from fidelity.rows import NAME, contacts_of, key_of

# In the order in which they are compared: what is asked most strictly comes first.
SUITES = ("libero_object", "libero_spatial", "libero_goal", "libero_10", "libero_90")
INTRODUCTION = f"""Written by `python benchmarks/mjx_fidelity.py table`; all rows: `benchmarks/results/{NAME}.json`.
Native MuJoCo with upstream's geometry is the reference. "Replay": `pick_place`'s actions on native, given to the other
side without looking; "closed loop": the policy looks. Points are percentage points of success against native on the
same episodes; "only native" and "only here" count the episodes with differing verdicts both ways. "Apart": how far
movable objects end from where native leaves them after {IDLE_TICKS} idle ticks, median / 90 % / largest, in mm."""


def markdown(rows: Sequence[Row]) -> str:
    """All tables."""
    good = [row for row in rows if "error" not in row]
    order = sorted(good, key=lambda row: (SUITES.index(row["suite"]), row["tasks"][0], row["backend"], row["geometry"]))
    replays = [row for row in order if row["kind"] == "replay"]
    failed = [f"* {' '.join(key_of(row))}: {row['error']}" for row in rows if "error" in row]
    sections = {
        "Suites": grid([suite_cells(*group) for group in grouped(order)]),
        "Scenes": grid([scene_cells(row) for row in replays]),
        "Objects that end elsewhere when verdicts differ": grid(culprits(order)),
        "Not compared": "\n".join(failed),
    }
    texts = [f"## {title}\n\n{text}" for title, text in sections.items() if text]
    contacts = f"Contacts on both sides: {', '.join(sorted(contacts_of(rows)))}."
    return "\n\n".join(["# Fidelity of MJX by suite and scene", INTRODUCTION, contacts, *texts]) + "\n"


def grouped(rows: Sequence[Row]) -> list[tuple[tuple[str, str, str], list[Row]]]:
    """Rows by suite, backend and geometry."""
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["suite"], row["backend"], row["geometry"]), []).append(row)
    return list(groups.items())


def suite_cells(key: tuple[str, str, str], rows: Sequence[Row]) -> dict[str, str]:
    """A row of the first table."""
    replays = [row for row in rows if row["kind"] == "replay"]
    closed = [row for row in rows if row["kind"] == "closed"]
    twins = [row["twins"] for row in replays if row["twins"]]
    again = [row["again"] for row in replays if row["again"]]
    return {
        **dict(zip(("suite", "backend", "geometry"), key, strict=True)),
        "scenes": str(len({row["scene"] for row in rows})),
        **agreement_cells("replay", [(row["episodes"], row["replay"]) for row in replays]),
        **agreement_cells("closed loop", [(row["episodes"], row["closed"]) for row in closed]),
        "objects > 5 mm apart": f"{sum(row['settle']['over 5 mm'] for row in replays)}"
        f" of {sum(row['settle']['objects'] for row in replays)}",
        "twins: verdicts differ": shares(twins),
        "second run: verdicts differ": shares(again),
        "faults": str(sum(sum(row[row["kind"]]["faults"].values()) for row in rows)),
    }


def agreement_cells(name: str, found: Sequence[tuple[int, Row]]) -> dict[str, str]:
    """Success on both sides, the difference in points, and differing verdicts both ways; of episodes and verdicts."""
    total = sum(episodes for episodes, _ in found)
    native, here, lost, won = (
        sum(row[column] for _, row in found) for column in ("native", "here", "only native", "only here")
    )
    if not total:
        return {f"{name}: native → here": "", f"{name}: points": "", f"{name}: only native / here": ""}
    return {
        f"{name}: native → here": f"{native} → {here} of {total}",
        f"{name}: points": f"{100 * (here - native) / total:+.1f}",
        f"{name}: only native / here": f"{lost} / {won}",
    }


def shares(found: Sequence[Row]) -> str:
    """Differing verdicts among pairs of runs."""
    return f"{sum(f['verdicts differ'] for f in found)} of {sum(f['episodes'] for f in found)}" if found else ""


def scene_cells(row: Row) -> dict[str, str]:
    """A row of the second table."""
    settle, replay, worst = row["settle"], row["replay"], row["settle"]["worst"]
    return {
        "scene": row["scene"],
        "backend": row["backend"],
        "geometry": row["geometry"],
        "native moves": millimetres(settle["native"]),
        "moves": millimetres(settle["here"]),
        "apart": millimetres(settle["apart"]),
        "farthest apart": f"{worst['object']}, {worst['task']}/{worst['episode']}",
        **agreement_cells("replay", [(row["episodes"], replay)]),
        "twins: dqpos": " / ".join(f"{x:.0e}" for x in row["twins"]["dqpos"]) if row["twins"] else "",
        "faults": str(sum(replay["faults"].values())),
        "first result, s": f"{row['seconds']['ready'] + row['seconds']['first']:.0f}",
    }


def millimetres(metres: Sequence[float]) -> str:
    """Median / 90 % / largest."""
    return " / ".join("<0.001" if 0 < x < 1e-6 else f"{1000 * x:.2g}" if x < 0.1 else f"{1000 * x:.0f}" for x in metres)


def culprits(rows: Sequence[Row]) -> list[dict[str, str]]:
    """Which object ends farthest from where native left it, counted over the episodes whose verdicts differ."""
    counted: Counter[tuple[str, ...]] = Counter()
    for row in rows:
        for case in row[row["kind"]]["differ"]:
            why = "fault" if case["fault"] else "only native" if case["native"] else "only here"
            thing = re.sub(r"_\d+$", "", case["object"])
            counted[row["suite"], row["kind"], row["backend"], row["geometry"], why, thing] += 1
    columns = ("suite", "kind", "backend", "geometry", "verdict", "object")
    return [{**dict(zip(columns, key, strict=True)), "episodes": str(n)} for key, n in counted.most_common()]


def grid(rows: Sequence[Mapping[str, str]]) -> str:
    """Rows as a Markdown table, without the columns that are empty throughout."""
    columns = [name for name in (rows[0] if rows else ()) if any(row[name] for row in rows)]
    lines = [columns, ["---"] * len(columns), *([row[name] for name in columns] for row in rows)]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines) if columns else ""
