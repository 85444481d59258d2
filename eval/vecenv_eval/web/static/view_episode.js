// One episode, in one run or in two side by side: images, curves and facts at the same tick.

import { get } from "./api.js";
import { element } from "./images.js";
import { WORDS } from "./view_list.js";
import { CurvePlots } from "./view_plots.js";

const by = (id) => document.getElementById(id);
const FPS = 20; // where no recording says another rate
const ALL = "all";

/** The images of a run's episode: one request at a time, the newest tick wins. */
class Frames {
  constructor(image, complain) {
    Object.assign(this, { image, complain, address: "", shown: "", wanted: "", busy: false });
  }

  show(address) {
    this.wanted = address;
    if (!this.busy) this.load();
  }

  async load() {
    if (this.wanted === this.shown) return;
    this.busy = true;
    const address = this.wanted;
    try {
      const answer = await fetch(address);
      if (!answer.ok) throw new Error((await answer.json().catch(() => ({}))).error ?? `The server answered ${answer.status}.`);
      const url = URL.createObjectURL(await answer.blob());
      const before = this.image.src;
      this.image.src = url;
      await this.image.decode().catch(() => {});
      if (before.startsWith("blob:")) URL.revokeObjectURL(before);
      this.image.dataset.tick = new URL(address, location.href).searchParams.get("tick");
    } catch (error) {
      this.complain(error);
    }
    this.shown = address;
    this.busy = false;
    this.load();
  }

  stop() {
    this.wanted = this.shown;
    if (this.image.src.startsWith("blob:")) URL.revokeObjectURL(this.image.src);
  }
}

/** An episode in one run. */
class Pane {
  constructor(run, row, second, on) {
    Object.assign(this, { run, row, on, ticks: 0, fps: FPS, cameras: [], plots: null });
    this.box = element("article", "", second ? "pane second" : "pane");
    this.base = row ? `/api/runs/${encodeURIComponent(run)}/episodes/${encodeURIComponent(row.key)}` : "";
  }

  async load(several) {
    if (!this.row) {
      this.box.append(element("p", `${this.run} has no row of this episode.`, "none"));
      return;
    }
    const { row, record, recorded } = await get(this.base);
    Object.assign(this, { ticks: recorded.ticks, cameras: recorded.cameras, fps: recorded.video?.fps ?? FPS });
    const title = element("p", several ? `${this.run}: ` : "", "small");
    const verdict = element("span", WORDS[row.verdict], "verdict");
    verdict.dataset.verdict = row.verdict;
    title.append(verdict, ` after ${row.num_steps} ticks${row.reward === null ? "" : `, reward ${row.reward}`}`);
    this.box.append(title);
    if (row.reason) this.box.append(element("p", row.reason, "bad small"));
    this.images(recorded);
    for (const problem of recorded.problems) this.box.append(element("p", problem, "bad small"));
    if (recorded.video) {
      const link = element("a", "The video as a file");
      link.href = `${this.base}/video`;
      const line = element("p", "", "small");
      line.append(link);
      this.box.append(line);
    }
    await this.curves(recorded);
    this.more(record);
    if (recorded.log) this.log();
  }

  images(recorded) {
    if (!recorded.frames) {
      this.box.append(element("p", "No images of this episode were recorded. vecenv eval --video all keeps videos, --record-states keeps states, from which images are drawn here.", "none small"));
      return;
    }
    const image = element("img", "", "image");
    image.alt = `${this.row.suite}/${this.row.task}/${this.row.episode}`;
    this.box.append(image);
    if (recorded.frames === "states") this.box.append(element("p", "Drawn from recorded states; the first image takes as long as building the scene.", "soft small"));
    this.frames = new Frames(image, this.on.complain);
  }

  async curves(recorded) {
    if (!recorded.actions) return;
    try {
      const curves = await get(`${this.base}/curves`);
      const root = element("div", "", "plots");
      this.box.append(root);
      this.plots = new CurvePlots(root, curves, this.row.suite, this.on.seek);
    } catch (error) {
      this.box.append(element("p", error.message, "bad small"));
    }
  }

  more(record) {
    const box = element("details");
    const table = element("table");
    const body = element("tbody");
    for (const [name, value] of Object.entries(record)) {
      const empty = value === "" || value === null || (typeof value === "object" && !Object.keys(value).length);
      if (empty) continue;
      const line = element("tr");
      const head = element("th", name);
      head.scope = "row";
      line.append(head, element("td", typeof value === "object" ? JSON.stringify(value) : String(value), "text"));
      body.append(line);
    }
    table.append(body);
    box.append(element("summary", "The whole row", "small"), table);
    this.box.append(box);
  }

  log() {
    const box = element("details");
    const text = element("pre");
    box.append(element("summary", "What the policy noted", "small"), text);
    box.addEventListener("toggle", async () => {
      if (!box.open || text.textContent) return;
      try {
        const { lines, complete } = await get(`${this.base}/log`);
        const shown = lines.map((line) => (typeof line === "string" ? line : JSON.stringify(line, null, 1).replaceAll("\\n", "\n")));
        text.textContent = shown.join("\n") + (complete ? "" : "\n(more is in the file)");
      } catch (error) {
        text.textContent = error.message;
      }
    });
    this.box.append(box);
  }

  show(tick, camera) {
    const own = Math.min(tick, this.ticks);
    this.box.classList.toggle("past", tick > this.ticks);
    if (this.frames) {
      this.frames.image.classList.toggle("ended", tick > this.ticks);
      const query = new URLSearchParams({ tick: own, camera: this.cameras.includes(camera) ? camera : ALL });
      this.frames.show(`${this.base}/frame?${query}`);
    }
    this.plots?.at(own);
  }

  close() {
    this.frames?.stop();
  }
}

export class Detail {
  /** @param {{complain: (error: Error) => void, pick: (step: number) => void}} on */
  constructor({ complain, pick }) {
    Object.assign(this, { complain, panes: [], tick: 0, ticks: 0, fps: FPS, asked: 0, playing: false });
    by("tick").addEventListener("input", () => {
      this.pause();
      this.to(by("tick").valueAsNumber);
    });
    by("play").addEventListener("click", () => this.toggle());
    by("camera").addEventListener("change", () => this.draw());
    by("previous").addEventListener("click", () => pick(-1));
    by("next").addEventListener("click", () => pick(1));
    by("close").addEventListener("click", () => this.close());
  }

  get isOpen() {
    return !by("episode").hidden;
  }

  /** @param {{run: string, row: object|null}[]} sides the episode in each run. */
  async open(sides) {
    const asked = (this.asked += 1);
    this.pause();
    const there = sides.find((side) => side.row).row;
    const panes = sides.map((side, i) => new Pane(side.run, side.row, i > 0, { complain: this.complain, seek: (tick) => this.seek(tick) }));
    await Promise.all(panes.map((pane) => pane.load(sides.length > 1).catch((error) => pane.box.append(element("p", error.message, "bad")))));
    if (asked !== this.asked) return;
    this.panes.forEach((pane) => pane.close());
    this.panes = panes;
    this.ticks = Math.max(...panes.map((pane) => pane.ticks));
    this.fps = Math.max(...panes.map((pane) => pane.fps));
    const wasOpen = this.isOpen;
    by("episode").hidden = false;
    by("episode-title").textContent = there.instruction || "No instruction";
    by("which").textContent = `${there.suite}/${there.task}/${there.episode}`;
    by("panes").replaceChildren(...panes.map((pane) => pane.box));
    by("scrubber").hidden = !panes.some((pane) => pane.frames || pane.plots);
    by("tick").max = this.ticks;
    this.cameras();
    this.to(0);
    by("episode").dataset.key = panes.map((pane) => pane.row?.key ?? "").join(" ");
    if (!wasOpen) by("episode-title").focus({ preventScroll: matchMedia("(min-width: 68rem)").matches });
  }

  cameras() {
    const names = [...new Set(this.panes.flatMap((pane) => pane.cameras))];
    const before = by("camera").value;
    by("camera").replaceChildren(
      ...names.map((name) => {
        const made = element("option", name);
        made.value = name;
        return made;
      }),
    );
    if (names.includes(before)) by("camera").value = before;
    by("camera").closest("label").hidden = names.length < 2;
  }

  seek(tick) {
    this.pause();
    this.to(tick);
  }

  move(step) {
    this.pause();
    this.to(this.tick + step);
  }

  to(tick) {
    this.tick = Math.max(0, Math.min(this.ticks, Math.round(tick)));
    this.draw();
  }

  draw() {
    by("tick").value = this.tick;
    by("tick").setAttribute("aria-valuetext", `tick ${this.tick} of ${this.ticks}`);
    by("tick-now").textContent = `${this.tick} / ${this.ticks}`;
    for (const pane of this.panes) pane.show(this.tick, by("camera").value);
  }

  toggle() {
    if (this.playing) this.pause();
    else this.play();
  }

  play() {
    this.playing = true;
    by("play").textContent = "Pause";
    if (this.tick >= this.ticks) this.to(0);
    const from = this.tick;
    const began = performance.now();
    const speed = Number(by("speed").value);
    const next = () => {
      if (!this.playing) return;
      this.to(from + ((performance.now() - began) / 1000) * this.fps * speed);
      if (this.tick >= this.ticks) this.pause();
      else requestAnimationFrame(next);
    };
    requestAnimationFrame(next);
  }

  pause() {
    this.playing = false;
    by("play").textContent = "Play";
  }

  close() {
    if (!this.isOpen) return;
    this.asked += 1;
    this.pause();
    this.panes.forEach((pane) => pane.close());
    this.panes = [];
    by("panes").replaceChildren();
    by("episode").hidden = true;
    (document.querySelector("#episodes tr[aria-current] button") ?? by("episodes-title")).focus();
  }
}
