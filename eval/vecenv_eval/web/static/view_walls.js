// The live wall: one mosaic for each process that runs episodes, with what each slot does.

import { element } from "./images.js";
import { Wall } from "./wall.js";

const LATE_S = 30; // images older than this are of a process that is stuck, or gone
const LOOK_MS = 5000;

class ProcessWall {
  constructor(root, title) {
    this.box = element("div", "", "wall");
    this.caption = element("p", "", "small");
    this.about = element("p", "", "soft small");
    const frame = element("div", "", "wall-frame");
    this.canvas = element("canvas");
    this.canvas.setAttribute("role", "img");
    this.canvas.tabIndex = 0;
    frame.append(this.canvas);
    this.box.append(this.caption, frame, this.about);
    root.append(this.box);
    this.title = title;
    this.slot = 0;
    this.wall = new Wall(this.canvas, (slot) => this.follow(slot));
    this.canvas.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      if (!step || !this.header) return;
      event.preventDefault();
      const at = this.header.slots.indexOf(this.slot) + step;
      if (at >= 0 && at < this.header.slots.length) this.follow(this.header.slots[at]);
    });
  }

  take(header, image) {
    this.header = header;
    this.written = Date.now() / 1000 - header.age_s;
    this.wall.take(header, image);
    const more = header.num_slots > header.slots.length ? ` of ${header.num_slots}` : "";
    this.caption.textContent = `${this.title}${header.folder}, process ${header.pid} on ${header.host}: ${header.slots.length}${more} slots, ${header.steps_per_s.toFixed(1)} ticks/s`;
    this.canvas.setAttribute("aria-label", `Images of ${header.slots.length} slots of ${header.leg}`);
    this.describe();
  }

  follow(slot) {
    this.slot = slot;
    this.wall.follow(slot);
    this.describe();
  }

  describe() {
    const at = this.header.slots.indexOf(this.slot);
    const age = Date.now() / 1000 - this.written;
    const late = age > LATE_S;
    this.box.classList.toggle("late", late);
    const words = at < 0 ? "" : `Slot ${this.slot}: ${this.header.episodes[at]}, ${this.header.instructions[at]}; tick ${this.header.ticks[at]}, ${this.header.verdicts[at]}.`;
    this.about.textContent = `${words}${late ? ` These images are ${Math.round(age)} s old.` : ""}`;
  }
}

export class Walls {
  constructor(root, section) {
    Object.assign(this, { root, section });
    this.walls = new Map();
    setInterval(() => this.walls.forEach((wall) => wall.describe()), LOOK_MS);
  }

  take(run, several, header, image) {
    const key = `${run}\n${header.leg}\n${header.process}`;
    this.section.hidden = false;
    if (!this.walls.has(key)) this.walls.set(key, new ProcessWall(this.root, several ? `${run}: ` : ""));
    this.walls.get(key).take(header, image);
  }

  /** Remove the walls of a run's processes that have ended; `present` are pairs of leg and process. */
  keep(run, present) {
    const keys = new Set(present.map(([leg, process]) => `${run}\n${leg}\n${process}`));
    for (const [key, wall] of this.walls) {
      if (!key.startsWith(`${run}\n`) || keys.has(key)) continue;
      wall.box.remove();
      this.walls.delete(key);
    }
    this.section.hidden = !this.walls.size;
  }
}
