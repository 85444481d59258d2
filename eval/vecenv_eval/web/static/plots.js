// Small line plots of a slot's state over ticks, drawn as SVG.

import { element } from "./images.js";

const SVG = "http://www.w3.org/2000/svg";
const HEIGHT = 132;
const MARGIN = { left: 48, right: 64, top: 8, bottom: 22 };
const MOST_POINTS = 600; // a plot is narrower than this in pixels; of more points the extremes of each bin are kept
const LABEL_PX = 13;

function svg(tag, attributes = {}, text = "") {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  if (text !== "") made.textContent = text;
  return made;
}

/** Round values from `low` to `high`, about `count` of them. */
export function niceTicks(low, high, count) {
  const raw = (high - low) / Math.max(1, count);
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = power * ([1, 2, 5, 10].find((factor) => factor * power >= raw) ?? 10);
  const ticks = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9 * step; i += 1) ticks.push(i * step);
  return { ticks, digits: Math.max(0, -Math.floor(Math.log10(step) + 1e-9)) };
}

/** Indices to draw: all, or the smallest and largest value of each bin. */
export function thinned(values, most = MOST_POINTS) {
  if (values.length <= most) return values.map((_, i) => i);
  const kept = new Set([0, values.length - 1]);
  const bins = Math.floor(most / 2);
  for (let bin = 0; bin < bins; bin += 1) {
    const from = Math.floor((bin * values.length) / bins);
    const to = Math.floor(((bin + 1) * values.length) / bins);
    let least = from;
    let largest = from;
    for (let i = from; i < to; i += 1) {
      if (values[i] < values[least]) least = i;
      if (values[i] > values[largest]) largest = i;
    }
    kept.add(least).add(largest);
  }
  return [...kept].sort((a, b) => a - b);
}

/** The range that a plot shows: that of its values and of `always`, and at least `least` wide. */
function range(series, least, always) {
  let low = Math.min(...always);
  let high = Math.max(...always);
  for (const { values } of series) {
    for (const value of values) {
      if (!Number.isFinite(value)) continue;
      low = Math.min(low, value);
      high = Math.max(high, value);
    }
  }
  if (low > high) [low, high] = [0, 1];
  const more = Math.max(0, least - (high - low)) / 2 + 0.04 * Math.max(least, high - low);
  return [low - more, high + more];
}

class Plot {
  constructor(root, title, unit, least, always = []) {
    Object.assign(this, { least, always });
    this.figure = element("figure", "", "plot");
    const caption = element("figcaption");
    this.unit = element("span", unit, "soft");
    caption.append(element("span", title), " ", this.unit);
    this.title = title;
    this.drawing = svg("svg", { role: "img", height: HEIGHT });
    this.figure.append(caption, this.drawing);
    root.append(this.figure);
    this.series = [];
    this.steps = [];
    this.cursor = null;
    this.pending = false;
    new ResizeObserver(() => this.redraw()).observe(this.figure);
    this.drawing.addEventListener("pointermove", (event) => {
      this.cursor = event.offsetX;
      this.redraw();
    });
    this.drawing.addEventListener("pointerleave", () => {
      this.cursor = null;
      this.redraw();
    });
  }

  show(steps, series) {
    Object.assign(this, { steps, series });
    this.redraw();
  }

  redraw() {
    if (this.pending) return;
    this.pending = true;
    requestAnimationFrame(() => {
      this.pending = false;
      this.draw();
    });
  }

  draw() {
    const width = Math.max(200, this.figure.clientWidth);
    const last = this.steps.at(-1) ?? 0;
    const to = Math.max(1, last);
    const [low, high] = range(this.series, this.least, this.always);
    const x = (step) => MARGIN.left + (step / to) * (width - MARGIN.left - MARGIN.right);
    const y = (value) => HEIGHT - MARGIN.bottom - ((value - low) / (high - low)) * (HEIGHT - MARGIN.top - MARGIN.bottom);
    const parts = [...this.axes(width, to, low, high, x, y)];
    const at = this.index(x);
    const labels = [];
    this.series.forEach(({ name, values }, number) => {
      const points = thinned(values).filter((i) => Number.isFinite(values[i])).map((i) => `${x(this.steps[i]).toFixed(1)},${y(values[i]).toFixed(1)}`);
      if (points.length > 1) parts.push(svg("polyline", { points: points.join(" "), class: `line s${number + 1}` }));
      const value = values[at];
      if (!Number.isFinite(value)) return;
      parts.push(svg("circle", { cx: x(this.steps[at]), cy: y(value), r: 2.5, class: `dot s${number + 1}` }));
      labels.push({ y: y(value), number, text: `${name ? `${name} ` : ""}${value.toFixed(3)}` });
    });
    if (this.cursor !== null && this.steps.length) {
      const here = x(this.steps[at]);
      parts.push(svg("line", { x1: here, x2: here, y1: MARGIN.top, y2: HEIGHT - MARGIN.bottom, class: "cursor" }));
    }
    spread(labels).forEach((label) => {
      parts.push(svg("text", { x: width - MARGIN.right + 8, y: label.y, class: `label s${label.number + 1}`, dy: "0.35em" }, label.text));
    });
    this.drawing.setAttribute("width", width);
    this.drawing.setAttribute("viewBox", `0 0 ${width} ${HEIGHT}`);
    const spoken = labels.map((label) => label.text).join(", ");
    this.drawing.setAttribute("aria-label", spoken ? `${this.title} ${this.unit.textContent} at tick ${this.steps[at]}: ${spoken}` : `${this.title}: nothing yet`);
    this.drawing.replaceChildren(...parts);
  }

  /** The point under the pointer, else the newest. */
  index(x) {
    if (this.cursor === null || !this.steps.length) return this.steps.length - 1;
    let best = 0;
    this.steps.forEach((step, i) => {
      if (Math.abs(x(step) - this.cursor) < Math.abs(x(this.steps[best]) - this.cursor)) best = i;
    });
    return best;
  }

  *axes(width, to, low, high, x, y) {
    const vertical = niceTicks(low, high, 3);
    for (const value of vertical.ticks) {
      yield svg("line", { x1: MARGIN.left, x2: width - MARGIN.right, y1: y(value), y2: y(value), class: "grid" });
      yield svg("text", { x: MARGIN.left - 6, y: y(value), dy: "0.35em", class: "tick end" }, value.toFixed(vertical.digits));
    }
    const bottom = HEIGHT - MARGIN.bottom;
    yield svg("line", { x1: MARGIN.left, x2: width - MARGIN.right, y1: bottom, y2: bottom, class: "axis" });
    const horizontal = niceTicks(0, to, Math.max(2, Math.floor(width / 75)));
    for (const value of horizontal.ticks) {
      if (value % 1 !== 0) continue;
      yield svg("text", { x: x(value), y: bottom + 15, class: "tick middle" }, String(Math.round(value)));
    }
    yield svg("text", { x: width - MARGIN.right + 8, y: bottom + 15, class: "tick" }, "tick");
  }
}

/** Move labels apart that would overlap, each as little as needed. */
function spread(labels) {
  const sorted = [...labels].sort((a, b) => a.y - b.y);
  for (let i = 1; i < sorted.length; i += 1) sorted[i].y = Math.max(sorted[i].y, sorted[i - 1].y + LABEL_PX);
  const over = (sorted.at(-1)?.y ?? 0) - (HEIGHT - MARGIN.bottom - 4);
  if (over > 0) {
    sorted.at(-1).y -= over;
    for (let i = sorted.length - 2; i >= 0; i -= 1) sorted[i].y = Math.min(sorted[i].y, sorted[i + 1].y - LABEL_PX);
  }
  return sorted;
}

/** Columns of an array of numbers or rows, as series with these names. */
function columns(rows, names) {
  const wide = rows.find(Array.isArray);
  if (!wide) return [{ name: "", values: rows.map((value) => value ?? NaN) }];
  return wide.map((_, i) => ({ name: names[i] ?? String(i), values: rows.map((row) => row?.[i] ?? NaN) }));
}

export class Plots {
  /** @param {HTMLElement} root where the plots go. */
  constructor(root) {
    this.eef = new Plot(root, "End effector", "m, world frame", 0.02);
    this.gripper = new Plot(root, "Gripper", "opening, m", 0.01);
    this.reward = new Plot(root, "Reward", "sum", 0.5, [0, 1]);
  }

  /** @param {{step: number[], eef_pos: number[][], gripper: (number|number[])[], reward: number[]}} history */
  show(history) {
    const steps = history.step ?? [];
    this.eef.show(steps, columns(history.eef_pos ?? [], ["x", "y", "z"]));
    this.gripper.show(steps, columns(history.gripper ?? [], ["1", "2"]));
    this.reward.show(steps, columns(history.reward ?? [], []));
  }
}
