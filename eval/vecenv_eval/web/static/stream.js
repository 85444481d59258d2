// The WebSocket: states and images as they come, and a new connection when one is lost.

const FIRST_WAIT_MS = 500;
const LONGEST_WAIT_MS = 5000;

/** Split a binary message into its header (JSON) and the JPEG; throws on anything else. */
export function parse(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  return { header, image: new Blob([new Uint8Array(buffer, 4 + length)], { type: "image/jpeg" }) };
}

export class Stream {
  /**
   * @param {{session: Function, frame: Function, wall: Function, problem: Function, up: Function, down: Function}} on
   *   what is called with messages of each type, and when the connection comes (`up`) and goes (`down(seconds)`).
   */
  constructor(on) {
    this.on = on;
    this.wanted = null;
    this.wait = FIRST_WAIT_MS;
    this.socket = null;
    this.timer = 0;
  }

  /** Connect, and again whenever the connection is lost. */
  open() {
    clearTimeout(this.timer);
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/api/stream`);
    this.socket = socket;
    socket.binaryType = "arraybuffer";
    socket.addEventListener("open", () => {
      this.wait = FIRST_WAIT_MS;
      this.send();
      this.on.up();
    });
    socket.addEventListener("message", (event) => this.take(event.data));
    socket.addEventListener("close", () => {
      if (this.socket !== socket) return;
      this.socket = null;
      this.timer = setTimeout(() => this.open(), this.wait);
      this.on.down(this.wait / 1000);
      this.wait = Math.min(2 * this.wait, LONGEST_WAIT_MS);
    });
  }

  /** Say what to send; a later connection says it again. */
  subscribe(wanted) {
    const text = JSON.stringify({ subscribe: wanted });
    if (text === this.wanted) return;
    this.wanted = text;
    this.send();
  }

  send() {
    if (this.wanted !== null && this.socket?.readyState === WebSocket.OPEN) this.socket.send(this.wanted);
  }

  /** Say that this tab still drives the session. */
  keep(writer) {
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify({ writer }));
  }

  take(data) {
    if (typeof data === "string") {
      const message = JSON.parse(data);
      if (message.type === "session") this.on.session(message);
      else if (typeof message.error === "string") this.on.problem(message.error);
      return;
    }
    const { header, image } = parse(data);
    if (header.type === "frame") this.on.frame(header, image);
    else if (header.type === "wall") this.on.wall(header, image);
  }
}
