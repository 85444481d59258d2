// Curves of an episode over ticks: executed actions and joint positions, with a line at the tick that is shown.

import { element } from "./images.js";
import { niceTicks, thinned } from "./plots.js";

const SVG = "http://www.w3.org/2000/svg";
const HEIGHT = 104;
const MARGIN = { left: 44, right: 92, top: 6, bottom: 20 };
const LABEL_PX = 13;

function svg(tag, attributes = {}, text = "") {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  if (text !== "") made.textContent = text;
  return made;
}

class CurvePlot {
  constructor(root, title, unit, ticks, series, seek) {
    Object.assign(this, { title, ticks, series, seek, now: 0 });
    this.figure = element("figure", "", "plot");
    const caption = element("figcaption", title);
    caption.append(" ", element("span", unit, "soft"));
    this.drawing = svg("svg", { role: "img", height: HEIGHT });
    this.figure.append(caption, this.drawing);
    root.append(this.figure);
    this.curves = svg("g");
    this.marks = svg("g");
    this.drawing.append(this.curves, this.marks);
    new ResizeObserver(() => this.drawCurves()).observe(this.figure);
    this.drawing.addEventListener("pointerdown", (event) => {
      const share = (event.offsetX - MARGIN.left) / (this.width - MARGIN.left - MARGIN.right);
      seek(share * this.last);
    });
  }

  get last() {
    return Math.max(1, this.ticks.at(-1) ?? 1);
  }

  drawCurves() {
    this.width = Math.max(200, this.figure.clientWidth);
    const all = this.series.flatMap(({ values }) => values);
    const [low, high] = [all.reduce((a, b) => Math.min(a, b), Infinity), all.reduce((a, b) => Math.max(a, b), -Infinity)];
    const more = 0.04 * Math.max(high - low, 0.02) + Math.max(0, 0.02 - (high - low)) / 2;
    this.low = low - more;
    this.high = high + more;
    const inner = this.width - MARGIN.left - MARGIN.right;
    this.x = (tick) => MARGIN.left + (tick / this.last) * inner;
    this.y = (value) => HEIGHT - MARGIN.bottom - ((value - this.low) / (this.high - this.low)) * (HEIGHT - MARGIN.top - MARGIN.bottom);
    const parts = [];
    const vertical = niceTicks(this.low, this.high, 3);
    for (const value of vertical.ticks) {
      parts.push(svg("line", { x1: MARGIN.left, x2: this.width - MARGIN.right, y1: this.y(value), y2: this.y(value), class: "grid" }));
      parts.push(svg("text", { x: MARGIN.left - 6, y: this.y(value), dy: "0.35em", class: "tick end" }, value.toFixed(vertical.digits)));
    }
    const bottom = HEIGHT - MARGIN.bottom;
    parts.push(svg("line", { x1: MARGIN.left, x2: this.width - MARGIN.right, y1: bottom, y2: bottom, class: "axis" }));
    for (const value of niceTicks(0, this.last, Math.max(2, Math.floor(this.width / 90))).ticks) {
      if (value % 1 === 0) parts.push(svg("text", { x: this.x(value), y: bottom + 14, class: "tick middle" }, String(Math.round(value))));
    }
    this.series.forEach(({ values }, number) => {
      const points = thinned(values).map((i) => `${this.x(this.ticks[i]).toFixed(1)},${this.y(values[i]).toFixed(1)}`);
      parts.push(svg("polyline", { points: points.join(" "), class: `line s${number + 1}` }));
    });
    this.drawing.setAttribute("width", this.width);
    this.drawing.setAttribute("viewBox", `0 0 ${this.width} ${HEIGHT}`);
    this.curves.replaceChildren(...parts);
    this.at(this.now);
  }

  /** Put the line at a tick; the labels say the values there. */
  at(tick) {
    this.now = tick;
    if (!this.width) return;
    let index = this.ticks.findIndex((each) => each >= tick);
    if (index < 0) index = this.ticks.length - 1;
    const here = this.x(Math.min(tick, this.last));
    const parts = [svg("line", { x1: here, x2: here, y1: MARGIN.top, y2: HEIGHT - MARGIN.bottom, class: "cursor" })];
    const words = [];
    this.series.forEach(({ name, values }, number) => {
      const value = values[index];
      const y = HEIGHT / 2 - MARGIN.bottom / 2 + (number - (this.series.length - 1) / 2) * LABEL_PX;
      words.push(`${name} ${value.toFixed(3)}`);
      parts.push(svg("circle", { cx: here, cy: this.y(value), r: 2.5, class: `dot s${number + 1}` }));
      parts.push(svg("text", { x: this.width - MARGIN.right + 8, y, dy: "0.35em", class: `label s${number + 1}` }, words.at(-1)));
    });
    this.drawing.setAttribute("aria-label", `${this.title} at tick ${tick}: ${words.join(", ")}`);
    this.marks.replaceChildren(...parts);
  }
}

/** Actions as they were given to the environment: 1 is 0.05 m or 0.5 rad in LIBERO, metres and radians in SIMPLER. */
const UNITS = (suite) => (suite.startsWith("simpler/") ? ["m", "rad"] : ["1 is 0.05 m", "1 is 0.5 rad"]);

export class CurvePlots {
  /** @param {(tick: number) => void} seek called with the tick that was clicked. */
  constructor(root, curves, suite, seek) {
    const [length, angle] = UNITS(suite);
    const of = (names, from) => names.filter((name) => from[name]).map((name) => ({ name, values: from[name] }));
    const joints = Object.keys(curves.joints);
    const groups = [
      ["Translation", length, of(["x", "y", "z"], curves.actions)],
      ["Rotation", angle, of(["rx", "ry", "rz"], curves.actions)],
      ["Gripper", "command", of(["gripper"], curves.actions)],
    ];
    for (let i = 0; i < joints.length; i += 3) {
      const names = joints.slice(i, i + 3);
      groups.push([`Joints ${i + 1} to ${i + names.length}`, "positions, rad or m", of(names, curves.joints)]);
    }
    this.plots = groups.filter(([, , series]) => series.length).map(([title, unit, series]) => new CurvePlot(root, title, unit, curves.ticks, series, seek));
  }

  at(tick) {
    for (const plot of this.plots) plot.at(tick);
  }
}
