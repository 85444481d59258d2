// The wall: the image of every slot, cut from one mosaic, with its verdict as border. A tile that is clicked is followed.

import { color, Newest } from "./images.js";

const GAP = 2; // between tiles, CSS pixels; the border of a tile is as wide
const SMALLEST = 36;
const LARGEST = 160;
// The wall fits its tiles into this part of the window's height where it may choose their size.
const HEIGHT = 0.7;
const VERDICTS = { live: "--line", success: "--good", failure: "--bad", fault: "--warn" };
const MARKS = { success: "\u2713", failure: "\u00d7", fault: "!" };

/** Largest tile with which `count` tiles fit into a box, within limits; CSS pixels, borders included. */
export function fitted(count, width, height) {
  let best = SMALLEST;
  for (let columns = 1; columns <= count; columns += 1) {
    const size = Math.min(width / columns, height / Math.ceil(count / columns));
    best = Math.max(best, Math.min(Math.floor(size), LARGEST));
  }
  return Math.min(best, Math.floor(width));
}

export class Wall {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {(slot: number) => void} choose called with the slot of a tile that was clicked.
   */
  constructor(canvas, choose) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d", { alpha: false });
    this.header = null;
    this.bitmap = null;
    this.slot = 0;
    this.chosenTile = 0;
    this.columns = 1;
    this.pending = false;
    this.frames = 0;
    this.drawMs = 0;
    this.newest = new Newest((header, bitmap) => this.keep(header, bitmap));
    canvas.addEventListener("click", (event) => {
      const slot = this.slotAt(event.offsetX, event.offsetY);
      if (slot !== null) choose(slot);
    });
    new ResizeObserver(() => this.redraw()).observe(canvas.parentElement);
    document.addEventListener("themechange", () => this.redraw());
  }

  take(header, image) {
    this.newest.take(header, image);
  }

  keep(header, bitmap) {
    this.bitmap?.close();
    this.header = header;
    this.bitmap = bitmap;
    this.frames += 1;
    this.redraw();
  }

  clear() {
    this.bitmap?.close();
    this.header = this.bitmap = null;
    this.redraw();
  }

  follow(slot) {
    this.slot = slot;
    this.redraw();
  }

  /** @param {number} pixels size of a tile in CSS pixels; 0 lets it fit. */
  resize(pixels) {
    this.chosenTile = pixels;
    this.redraw();
  }

  /** Draw at the browser's next frame, however often this is called before. */
  redraw() {
    if (this.pending) return;
    this.pending = true;
    requestAnimationFrame(() => {
      this.pending = false;
      const began = performance.now();
      this.draw();
      this.drawMs = performance.now() - began;
      this.canvas.dataset.drawMs = this.drawMs.toFixed(2);
    });
  }

  slotAt(x, y) {
    if (!this.header) return null;
    const column = Math.floor(x / this.size);
    const index = Math.floor(y / this.size) * this.columns + column;
    return column < this.columns && index < this.header.slots.length ? this.header.slots[index] : null;
  }

  layout() {
    const count = this.header.slots.length;
    const width = this.canvas.parentElement.clientWidth;
    this.size = this.chosenTile ? Math.min(this.chosenTile, width) : fitted(count, width, HEIGHT * innerHeight);
    this.columns = Math.max(1, Math.min(count, Math.floor(width / this.size)));
    const scale = devicePixelRatio || 1;
    const across = this.columns * this.size;
    const down = Math.ceil(count / this.columns) * this.size;
    const pixels = [Math.round(across * scale), Math.round(down * scale)];
    if (this.canvas.width !== pixels[0] || this.canvas.height !== pixels[1]) {
      [this.canvas.width, this.canvas.height] = pixels;
      this.canvas.style.width = `${across}px`;
      this.canvas.style.height = `${down}px`;
    }
    return scale;
  }

  draw() {
    const { context, header, bitmap } = this;
    this.canvas.hidden = !header;
    if (!header) return;
    const scale = this.layout();
    const { columns, size } = this;
    const colors = Object.fromEntries(Object.entries(VERDICTS).map(([name, value]) => [name, color(value)]));
    const [paper, ink] = [color("--paper"), color("--ink")];
    context.setTransform(scale, 0, 0, scale, 0, 0);
    context.fillStyle = paper;
    context.fillRect(0, 0, columns * size, Math.ceil(header.slots.length / columns) * size);
    const inner = size - 3 * GAP;
    header.slots.forEach((slot, index) => {
      const x = (index % columns) * size;
      const y = Math.floor(index / columns) * size;
      const verdict = header.verdicts[index];
      context.fillStyle = colors[verdict] ?? colors.live;
      context.fillRect(x + GAP / 2, y + GAP / 2, size - GAP, size - GAP);
      const sx = (index % header.columns) * header.tile;
      const sy = Math.floor(index / header.columns) * header.tile;
      context.drawImage(bitmap, sx, sy, header.tile, header.tile, x + 1.5 * GAP, y + 1.5 * GAP, inner, inner);
    });
    this.marks(colors, paper);
    this.ring(ink, paper);
    Object.assign(this.canvas.dataset, { frames: this.frames, columns, count: header.slots.length });
  }

  /** A sign beside the colour, for those who do not see it. */
  marks(colors, paper) {
    const { context, header, columns, size } = this;
    const side = Math.max(11, Math.min(20, Math.round(size / 5)));
    context.font = `700 ${Math.round(side * 0.85)}px system-ui, sans-serif`;
    context.textAlign = "center";
    context.textBaseline = "middle";
    header.verdicts.forEach((verdict, index) => {
      const mark = MARKS[verdict];
      if (!mark) return;
      const x = (index % columns) * size + size - GAP / 2 - side;
      const y = Math.floor(index / columns) * size + GAP / 2;
      context.fillStyle = colors[verdict];
      context.fillRect(x, y, side, side);
      context.fillStyle = paper;
      context.fillText(mark, x + side / 2, y + side / 2 + 0.5);
    });
  }

  /** Around the followed slot. */
  ring(ink, paper) {
    const { context, header, columns, size } = this;
    const index = header.slots.indexOf(this.slot);
    if (index < 0 || header.slots.length < 2) return;
    const x = (index % columns) * size;
    const y = Math.floor(index / columns) * size;
    context.lineWidth = 2;
    context.strokeStyle = ink;
    context.strokeRect(x + 1, y + 1, size - 2, size - 2);
    context.strokeStyle = paper;
    context.lineWidth = 1;
    context.strokeRect(x + 2.5, y + 2.5, size - 5, size - 5);
  }
}
