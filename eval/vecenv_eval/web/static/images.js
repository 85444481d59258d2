// JPEGs to bitmaps, off the main thread; while one is decoded only the newest of those that arrive is kept.

export class Newest {
  /** @param {(header: object, bitmap: ImageBitmap) => void} show called with each image that was decoded. */
  constructor(show) {
    this.show = show;
    this.busy = false;
    this.next = null;
  }

  async take(header, image) {
    if (this.busy) {
      this.next = [header, image];
      return;
    }
    this.busy = true;
    try {
      const bitmap = await createImageBitmap(image);
      this.show(header, bitmap);
    } catch {
      // A damaged image: the next one comes soon.
    }
    this.busy = false;
    if (this.next) {
      const [newer, blob] = this.next;
      this.next = null;
      this.take(newer, blob);
    }
  }
}

/** A CSS variable's value. */
export const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** An element with text, never HTML. */
export function element(tag, text = "", className = "") {
  const made = document.createElement(tag);
  if (text !== "") made.textContent = text;
  if (className) made.className = className;
  return made;
}
