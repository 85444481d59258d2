// What VoxPoser planned last for the followed slot: its subtasks and the stops of the hand.

import { element } from "./images.js";

const by = (id) => document.getElementById(id);
const metres = (value) => (Number.isFinite(value) ? value.toFixed(3) : "-");

/** Show a plan, or nothing where the policy plans nothing or another slot's plan came. */
export function showPlan(plan, slot) {
  const there = Boolean(plan) && (plan.slot ?? slot) === slot;
  by("planning").hidden = !there;
  if (!there) return;
  const key = JSON.stringify([plan.slot, plan.tick, plan.subtask, plan.cause]);
  if (by("planning").dataset.key === key) return;
  by("planning").dataset.key = key;
  const cause = plan.cause ? `Nothing more is tried: ${plan.cause}` : `Planned at tick ${plan.tick}.`;
  by("subtask").textContent = cause;
  by("subtask").classList.toggle("bad", Boolean(plan.cause));
  const present = plan.subtasks.length ? plan.subtask % plan.subtasks.length : -1;
  const items = plan.subtasks.map((text, i) => {
    const item = element("li", text);
    if (i === present) item.setAttribute("aria-current", "step");
    return item;
  });
  by("subtasks").replaceChildren(...items);
  by("waypoints").replaceChildren(stops(plan.waypoints ?? []));
}

function stops(waypoints) {
  if (!waypoints.length) return element("p", "No motion is planned for this subtask.", "soft small");
  const details = element("details");
  const more = waypoints.length === 1 ? "1 stop of the hand" : `${waypoints.length} stops of the hand`;
  details.append(element("summary", more));
  const table = element("table", "", "stops");
  const head = element("tr");
  for (const name of ["", "x, m", "y, m", "z, m", "grip"]) {
    const cell = element("th", name, name === "grip" ? "" : "n");
    cell.scope = "col";
    head.append(cell);
  }
  table.append(head);
  waypoints.forEach((stop, i) => {
    const row = element("tr");
    row.append(element("td", String(i + 1), "n soft"), ...stop.pos.map((value) => element("td", metres(value), "n")));
    row.append(element("td", stop.closed ? "closed" : "open"));
    table.append(row);
  });
  const scroll = element("div", "", "scroll");
  scroll.append(table);
  details.append(scroll);
  details.open = by("waypoints").querySelector("details")?.open ?? false;
  return details;
}
