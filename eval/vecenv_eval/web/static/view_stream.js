// The WebSocket of one run: how it stands when that changes, and the newest images of what is running.

import { parse } from "./stream.js";

const FIRST_WAIT_MS = 1000;
const LONGEST_WAIT_MS = 10_000;

export class RunStream {
  /** @param {{run: Function, frame: Function, processes: Function, down: Function}} on what is called with messages. */
  constructor(name, on) {
    Object.assign(this, { name, on });
    this.wait = FIRST_WAIT_MS;
  }

  open() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/api/runs/${encodeURIComponent(this.name)}/stream`);
    socket.binaryType = "arraybuffer";
    socket.addEventListener("message", (event) => {
      this.wait = FIRST_WAIT_MS;
      this.take(event.data);
    });
    socket.addEventListener("close", () => {
      this.on.down();
      setTimeout(() => this.open(), this.wait);
      this.wait = Math.min(2 * this.wait, LONGEST_WAIT_MS);
    });
  }

  take(data) {
    if (typeof data !== "string") {
      const { header, image } = parse(data);
      if (header.type === "wall") this.on.frame(header, image);
      return;
    }
    const message = JSON.parse(data);
    if (message.type === "run") this.on.run(message);
    else if (message.type === "processes") this.on.processes(message.processes);
  }
}
