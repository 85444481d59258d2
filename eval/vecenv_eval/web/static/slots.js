// What is known about slots in words: the followed one, the counts over the batch, and all of them as a table.

import { element } from "./images.js";

const by = (id) => document.getElementById(id);
const TABLE_MS = 500;

/** A slot's verdict as the wall has it: live, success, failure or fault. */
export function verdict(slot) {
  if (slot.fault) return "fault";
  if (slot.terminated || slot.truncated) return slot.success ? "success" : "failure";
  return "live";
}

const WORDS = { live: "running", success: "success", failure: "failure", fault: "fault" };
const number = (value) => (Number.isFinite(value) ? (Number.isInteger(value) ? String(value) : value.toFixed(3)) : "-");

export class Slots {
  /** @param {(slot: number) => void} choose called with a slot that was chosen in the table. */
  constructor(choose) {
    this.choose = choose;
    this.rows = [];
    this.drawn = 0;
    this.timer = 0;
    by("table").addEventListener("toggle", () => this.table());
  }

  show(state, followed) {
    this.state = state;
    this.followed = followed;
    this.one(state.slots.find((slot) => slot.slot === followed));
    this.count(state);
    const wait = TABLE_MS - (performance.now() - this.drawn);
    if (wait <= 0) this.table();
    else if (!this.timer) this.timer = setTimeout(() => this.table(), wait);
  }

  one(slot) {
    const none = this.state.state === "building" ? `Loading ${this.state.suite ?? ""}\u2026` : "No batch is loaded";
    by("instruction").textContent = slot ? slot.instruction || "(no instruction)" : none;
    by("episode-id").textContent = slot ? slot.episode_id : "";
    by("steps").textContent = slot ? `${slot.step} of ${slot.max_steps} ticks` : "-";
    by("budget").max = slot?.max_steps || 1;
    by("budget").value = slot?.step ?? 0;
    by("reward").textContent = slot ? number(slot.reward) : "-";
    const is = slot ? verdict(slot) : "";
    by("verdict").textContent = slot ? (slot.fault ? `fault: ${slot.fault}` : WORDS[is]) : "-";
    by("verdict").dataset.verdict = is;
  }

  count(state) {
    const counts = { live: 0, success: 0, failure: 0, fault: 0 };
    for (const slot of state.slots) counts[verdict(slot)] += 1;
    const ended = state.finished ?? counts.success + counts.failure + counts.fault;
    const solved = state.successes ?? counts.success;
    by("solved").textContent = state.slots.length ? `${solved} of ${ended} ended` : "-";
    const parts = Object.entries(counts).map(([name, count]) => {
      const part = element("span", `${count} ${WORDS[name]}`);
      part.dataset.verdict = name;
      return part;
    });
    by("counts").replaceChildren(...(state.slots.length > 1 ? parts : []));
  }

  /** Rows are made once and their cells changed, at most twice a second and only while the table is open. */
  table() {
    clearTimeout(this.timer);
    this.timer = 0;
    if (!by("table").open || !this.state) return;
    this.drawn = performance.now();
    const body = by("table").querySelector("tbody");
    const { slots } = this.state;
    while (this.rows.length < slots.length) this.rows.push(this.row(this.rows.length));
    if (body.childElementCount !== slots.length) body.replaceChildren(...this.rows.slice(0, slots.length).map((row) => row.line));
    slots.forEach((slot, i) => this.rows[i].show(slot, slot.slot === this.followed));
  }

  row(index) {
    const line = element("tr");
    const button = element("button", String(index), "plain");
    button.type = "button";
    const cells = ["n", "", "text", "n", "n", ""].map((name) => element("td", "", name));
    cells[0].append(button);
    line.append(...cells);
    let slotNumber = index;
    button.addEventListener("click", () => this.choose(slotNumber));
    const write = (cell, text) => {
      if (cell.textContent !== text) cell.textContent = text;
    };
    const show = (slot, followed) => {
      slotNumber = slot.slot;
      write(button, String(slot.slot));
      button.setAttribute("aria-label", `Follow slot ${slot.slot}`);
      if (followed) line.setAttribute("aria-current", "true");
      else line.removeAttribute("aria-current");
      write(cells[1], String(slot.episode_id ?? ""));
      write(cells[2], String(slot.instruction ?? ""));
      write(cells[3], String(slot.step));
      write(cells[4], number(slot.reward));
      const is = verdict(slot);
      write(cells[5], slot.fault ? `fault: ${slot.fault}` : WORDS[is]);
      cells[5].dataset.verdict = is;
    };
    return { line, show };
  }
}
