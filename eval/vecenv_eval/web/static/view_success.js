// Success so far: a card a run, and a table by task with Wilson intervals.

import { element } from "./images.js";

const SVG = "http://www.w3.org/2000/svg";
const WIDTH = 144;
const HEIGHT = 16;

export const percent = (rate, digits = 1) => (rate === null ? "-" : `${(100 * rate).toFixed(digits)}%`);
export const interval = (counts) => (counts.rate === null ? "" : `${percent(counts.low)} to ${percent(counts.high)}`);

function svg(tag, attributes) {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  return made;
}

/** A rate and its interval between 0 and 1. */
function drawn(counts, series) {
  const box = svg("svg", { viewBox: `-4 0 ${WIDTH + 8} ${HEIGHT}`, class: "interval", role: "img", "aria-label": `${percent(counts.rate)}, interval ${interval(counts) || "unknown"}` });
  const middle = HEIGHT / 2;
  box.append(svg("line", { x1: 0, x2: WIDTH, y1: middle, y2: middle, class: "base" }));
  if (counts.rate !== null) {
    box.append(svg("line", { x1: counts.low * WIDTH, x2: counts.high * WIDTH, y1: middle, y2: middle, class: `reach s${series}` }));
    box.append(svg("circle", { cx: counts.rate * WIDTH, cy: middle, r: 4, class: `at s${series}` }));
  }
  return box;
}

function plural(count, word) {
  return `${count} ${word}${count === 1 ? "" : "s"}`;
}

function card(info, number) {
  const { counts } = info;
  const box = element("div", "", number ? "run second" : "run");
  const rate = element("p", percent(counts.rate), "rate");
  rate.append(" ", element("small", interval(counts)));
  const ended = counts.episodes + counts.errors;
  const of = counts.planned === null ? "" : ` of ${counts.planned}`;
  const facts = [`${counts.successes} of ${plural(counts.episodes, "episode")} solved`];
  if (counts.faults) facts.push(plural(counts.faults, "fault"));
  if (counts.errors) facts.push(`${plural(counts.errors, "error")} without a verdict`);
  if (counts.steps_to_solve !== null) facts.push(`${counts.steps_to_solve.toFixed(0)} ticks to solve`);
  const bar = element("progress");
  bar.max = counts.planned || Math.max(1, ended);
  bar.value = ended;
  bar.setAttribute("aria-label", "Episodes that have ended");
  const legs = info.legs.map((leg) => `${leg.suite}${leg.seed === null ? "" : ` seed ${leg.seed}`}`);
  const policies = [...new Set(info.legs.map((leg) => leg.policy))];
  const conditions = [...new Set(info.legs.map((leg) => leg.conditions).filter(Boolean))];
  box.append(
    element("p", `${info.run}: ${policies.join(", ")} on ${legs.join(", ")}`, "small"),
    rate,
    element("p", facts.join(", ") + "."),
    bar,
    element("p", `${ended}${of} episodes have ended; the run is ${info.state}.`, "soft small"),
  );
  if (conditions.length) {
    const more = element("details");
    more.append(element("summary", "Conditions", "small"), ...conditions.map((text) => element("p", text, "soft small")));
    box.append(more);
  }
  return box;
}

export function showSuccess(root, infos) {
  const open = [...root.querySelectorAll("details")].map((each) => each.open);
  root.replaceChildren(...infos.map(card));
  root.querySelectorAll("details").forEach((each, i) => (each.open = open[i] ?? false));
}

/** What tells a task of a run: its suite, number, and which evaluation of the suite it is in. */
function taskKey(info, task, turns) {
  const of = turns.get(task.suite) ?? turns.set(task.suite, []).get(task.suite);
  if (!of.includes(task.leg)) of.push(task.leg);
  return `${task.suite}\n${of.indexOf(task.leg)}\n${task.task}`;
}

function cell(text, className = "") {
  return element("td", text, className);
}

function heads(several) {
  const row = element("tr");
  for (const [text, className] of [["task", ""], ["success, 95 % interval", ""], [several ? "rates" : "rate", "n"], ["episodes", "n"], ["faults", "n wide"], ["errors", "n wide"], ["to run", "n wide"]]) {
    const head = element("th", text, className);
    head.scope = "col";
    row.append(head);
  }
  return row;
}

function line(words, counts) {
  const row = element("tr");
  row.append(cell(words, "text"));
  const drawings = cell("");
  counts.forEach((each, i) => drawings.append(each ? drawn(each, i + 1) : ""));
  const lines = (text, className) => {
    const made = cell("", className);
    made.append(...counts.map((each) => element("span", each ? String(text(each)) : "-", "line")));
    return made;
  };
  row.append(
    drawings,
    lines((each) => percent(each.rate), "n"),
    lines((each) => each.episodes, "n"),
    lines((each) => each.faults, "n wide"),
    lines((each) => each.errors, "n wide"),
    lines((each) => each.missing, "n wide"),
  );
  return row;
}

/** @param {(task: object) => void} choose called with the task of a row that was clicked. */
export function showTasks(table, infos, choose) {
  const tasks = new Map();
  infos.forEach((info, number) => {
    const turns = new Map();
    for (const task of info.tasks) {
      const key = taskKey(info, task, turns);
      if (!tasks.has(key)) tasks.set(key, []);
      tasks.get(key)[number] = task;
    }
  });
  const several = infos.some((info) => info.legs.length > 1);
  const rows = [...tasks.values()].map((pair) => {
    const there = pair.find(Boolean);
    const counts = infos.map((_, i) => pair[i] ?? null);
    const row = line(`${several ? `${there.leg}/` : ""}${there.task}  ${there.instruction}`, counts);
    row.addEventListener("click", () => choose(there));
    return row;
  });
  const total = line("all", infos.map((info) => info.counts));
  total.className = "total";
  total.addEventListener("click", () => choose(null));
  table.querySelector("thead").replaceChildren(heads(infos.length > 1));
  table.querySelector("tbody").replaceChildren(total, ...rows);
}
