// The live images of the followed slot, one figure a camera.

import { element, Newest } from "./images.js";

export class Cameras {
  /** @param {HTMLElement} root where the figures go. */
  constructor(root) {
    this.root = root;
    this.slot = 0;
    this.views = new Map();
    this.shown = 0;
  }

  /** Follow another slot; its images replace those shown when they come. */
  follow(slot) {
    this.slot = slot;
    for (const view of this.views.values()) view.canvas.classList.add("stale");
  }

  clear() {
    this.views.clear();
    this.root.replaceChildren();
  }

  take(header, image) {
    if (header.slot !== this.slot) return;
    let view = this.views.get(header.camera);
    if (!view) {
      view = this.figure(header.camera);
      this.views.set(header.camera, view);
    }
    view.newest.take(header, image);
  }

  figure(camera) {
    const figure = element("figure");
    const canvas = element("canvas");
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `Camera ${camera}`);
    canvas.dataset.camera = camera;
    const caption = element("figcaption");
    const tick = element("span", "", "soft");
    caption.append(element("span", camera), tick);
    figure.append(canvas, caption);
    this.root.append(figure);
    const context = canvas.getContext("2d");
    const newest = new Newest((header, bitmap) => {
      if (header.slot === this.slot) {
        if (canvas.width !== bitmap.width || canvas.height !== bitmap.height) {
          canvas.width = bitmap.width;
          canvas.height = bitmap.height;
        }
        context.drawImage(bitmap, 0, 0);
        canvas.classList.remove("stale");
        canvas.dataset.tick = header.tick;
        canvas.dataset.slot = header.slot;
        tick.textContent = `tick ${header.tick}`;
        this.shown += 1;
      }
      bitmap.close();
    });
    return { canvas, newest };
  }
}
