// The list of episodes: filters, pages, and of two runs the pairs of episodes.

import { get } from "./api.js";
import { element } from "./images.js";

const by = (id) => document.getElementById(id);
const PAGE = 50;
const TYPING_MS = 250;
const ONE = { failures: "not solved", all: "all", success: "solved", failure: "failed", fault: "faults", error: "errors" };
const TWO = { changed: "changed sides", lost: "solved by the first alone", won: "solved by the second alone", all: "all", both: "solved by both", neither: "solved by neither", unpaired: "without a verdict in both" };
export const WORDS = { success: "solved", failure: "failed", fault: "fault", error: "error" };

function option(value, text) {
  const made = element("option", text);
  made.value = value;
  return made;
}

function verdict(row) {
  const made = element("span", row ? WORDS[row.verdict] : "-", "verdict");
  if (row) made.dataset.verdict = row.verdict;
  return made;
}

export class List {
  /** @param {{choose: (pair: {first: object|null, second: object|null}) => void, complain: (error: Error) => void}} on */
  constructor({ choose, complain }) {
    Object.assign(this, { choose, complain, names: [], offset: 0, total: 0, rows: [], chosen: "", asked: 0, timer: 0 });
    by("filter").addEventListener("submit", (event) => event.preventDefault());
    for (const id of ["show", "order", "task"]) by(id).addEventListener("change", () => this.again());
    by("text").addEventListener("input", () => this.later(TYPING_MS, () => this.again()));
    by("before").addEventListener("click", () => this.turn(-PAGE));
    by("after").addEventListener("click", () => this.turn(PAGE));
    by("task").append(option("", "all"));
  }

  /** Which runs there are; two are shown as pairs. */
  runs(names) {
    this.names = names;
    const words = names.length > 1 ? TWO : ONE;
    by("show").replaceChildren(...Object.entries(words).map(([value, text]) => option(value, text)));
    by("show").value = names.length > 1 ? "changed" : "all";
    document.querySelectorAll("#filter .alone").forEach((each) => (each.hidden = names.length > 1));
    by("task").closest("label").hidden = names.length > 1;
  }

  tasks(infos) {
    const several = infos[0].legs.length > 1;
    const options = infos[0].tasks.map((task) => [JSON.stringify([task.leg, task.task]), `${several ? `${task.leg}/` : ""}${task.task}  ${task.instruction}`]);
    const field = by("task");
    if (field.options.length === options.length + 1) return;
    const before = field.value;
    field.replaceChildren(option("", "all"), ...options.map(([value, text]) => option(value, text)));
    if (options.some(([value]) => value === before)) field.value = before;
  }

  showTask(task) {
    if (this.names.length > 1) return;
    by("task").value = task ? JSON.stringify([task.leg, task.task]) : "";
    this.again();
    by("episodes-title").focus();
  }

  toggleFailures() {
    const [first, second] = this.names.length > 1 ? ["changed", "all"] : ["failures", "all"];
    by("show").value = by("show").value === first ? second : first;
    this.again();
  }

  later(wait, act) {
    clearTimeout(this.timer);
    this.timer = setTimeout(act, wait);
  }

  /** Fetch the list once in a while, however often this is called. */
  refreshSoon(wait) {
    if (this.soon) return;
    this.soon = setTimeout(() => {
      this.soon = 0;
      this.refresh();
    }, wait);
  }

  again() {
    this.offset = 0;
    return this.refresh();
  }

  turn(by_) {
    this.offset = Math.max(0, Math.min(this.offset + by_, Math.floor(Math.max(0, this.total - 1) / PAGE) * PAGE));
    return this.refresh();
  }

  async refresh() {
    const asked = (this.asked += 1);
    try {
      const answer = await get(this.address());
      if (asked !== this.asked) return;
      this.total = answer.total;
      this.rows = this.names.length > 1 ? answer.rows : answer.rows.map((row) => ({ first: row, second: null }));
      if (!this.rows.length && this.offset) {
        await this.turn(-PAGE);
        return;
      }
      this.draw();
    } catch (error) {
      this.complain(error);
    }
  }

  address() {
    const query = new URLSearchParams({ show: by("show").value, offset: this.offset, limit: PAGE });
    const [one, two] = this.names.map(encodeURIComponent);
    if (two) return `/api/runs/${one}/compare/${two}?${query}`;
    query.set("order", by("order").value);
    if (by("text").value.trim()) query.set("text", by("text").value.trim());
    if (by("task").value) {
      const [leg, task] = JSON.parse(by("task").value);
      query.set("leg", leg);
      query.set("task", task);
    }
    return `/api/runs/${one}/episodes?${query}`;
  }

  draw() {
    const two = this.names.length > 1;
    const head = element("tr");
    const names = two ? ["episode", "instruction", ...this.names, "ticks"] : ["episode", "verdict", "instruction", "ticks", "seconds"];
    names.forEach((name, i) => {
      const made = element("th", name, i >= (two ? 4 : 3) ? `n${name === "seconds" ? " wide" : ""}` : "");
      made.scope = "col";
      head.append(made);
    });
    by("episodes").querySelector("thead").replaceChildren(head);
    by("episodes").querySelector("tbody").replaceChildren(...this.rows.map((pair) => (two ? this.pairRow(pair) : this.row(pair))));
    const last = Math.min(this.offset + PAGE, this.total);
    by("found").textContent = `${this.total} ${this.total === 1 ? "episode" : "episodes"}`;
    by("page").textContent = this.total ? `${this.offset + 1} to ${last} of ${this.total}` : "";
    by("before").disabled = this.offset === 0;
    by("after").disabled = last >= this.total;
  }

  frame(pair) {
    const there = pair.first ?? pair.second;
    const row = element("tr");
    const id = `${there.suite}/${there.task}/${there.episode}`;
    const key = `${pair.first?.key} ${pair.second?.key}`;
    if (key === this.chosen) row.setAttribute("aria-current", "true");
    const button = element("button", id, "row");
    button.type = "button";
    const cell = element("td");
    cell.append(button);
    row.append(cell);
    row.addEventListener("click", () => this.open(pair));
    return { row, there };
  }

  row(pair) {
    const { row, there } = this.frame(pair);
    const how = element("td");
    how.append(verdict(there));
    const text = element("td", there.instruction, "text");
    if (there.reason) text.append(element("span", there.reason, "reason"));
    row.append(how, text, element("td", String(there.num_steps), "n"), element("td", there.wall_s.toFixed(1), "n wide"));
    return row;
  }

  pairRow(pair) {
    const { row, there } = this.frame(pair);
    row.append(element("td", there.instruction, "text"));
    for (const each of [pair.first, pair.second]) {
      const cell = element("td");
      cell.append(verdict(each));
      row.append(cell);
    }
    const ticks = element("td", "", "n");
    ticks.append(...[pair.first, pair.second].map((each) => element("span", String(each?.num_steps ?? "-"), "line")));
    row.append(ticks);
    return row;
  }

  open(pair) {
    this.chosen = `${pair.first?.key} ${pair.second?.key}`;
    this.draw();
    this.choose(pair);
  }

  /** Open the next or the previous one; the next page follows when this one ends. */
  async pick(step) {
    if (!this.rows.length) return;
    let at = this.rows.findIndex((pair) => `${pair.first?.key} ${pair.second?.key}` === this.chosen) + step;
    if (this.chosen === "" && step < 0) at = 0;
    if (at >= this.rows.length && this.offset + PAGE < this.total) {
      await this.turn(PAGE);
      at = 0;
    } else if (at < 0 && this.offset > 0) {
      await this.turn(-PAGE);
      at = this.rows.length - 1;
    }
    const pair = this.rows[Math.max(0, Math.min(at, this.rows.length - 1))];
    if (pair) this.open(pair);
    document.querySelector("#episodes tr[aria-current]")?.scrollIntoView({ block: "nearest" });
  }
}
