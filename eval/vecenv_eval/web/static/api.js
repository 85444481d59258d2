// Requests to the server: JSON in, JSON out, and one sentence where something is refused.

/** A refusal, or a server that does not answer. `status` is 0 for the latter. */
export class ServerError extends Error {
  constructor(message, status, field = null) {
    super(message);
    this.status = status;
    this.field = field;
  }
}

/** A random id. `crypto.randomUUID` exists in secure contexts only, and a page over plain HTTP is none. */
function randomId() {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  bytes[6] = (bytes[6] & 0x0f) | 0x40;
  bytes[8] = (bytes[8] & 0x3f) | 0x80;
  const hex = Array.from(bytes, (byte) => byte.toString(16).padStart(2, "0")).join("");
  return [hex.slice(0, 8), hex.slice(8, 12), hex.slice(12, 16), hex.slice(16, 20), hex.slice(20)].join("-");
}

/** The name under which this tab changes the session; it survives a reload. */
export const WRITER = (() => {
  try {
    const known = sessionStorage.getItem("vecenv-writer") ?? randomId();
    sessionStorage.setItem("vecenv-writer", known);
    return known;
  } catch {
    return randomId(); // storage is off
  }
})();

/** Send a request and return the answer's JSON; throws ServerError. */
export async function request(method, path, body = undefined) {
  const headers = { Accept: "application/json" };
  if (method !== "GET") headers["X-Writer"] = WRITER;
  if (body !== undefined) headers["Content-Type"] = "application/json";
  let answer;
  try {
    answer = await fetch(path, { method, headers, body: body === undefined ? undefined : JSON.stringify(body) });
  } catch {
    throw new ServerError("The server does not answer.", 0);
  }
  let content = null;
  try {
    content = await answer.json();
  } catch {
    // An empty answer, or a proxy's page.
  }
  if (answer.ok) return content;
  const sentence = typeof content?.error === "string" ? content.error : `The server answered ${answer.status} to ${method} ${path}.`;
  throw new ServerError(sentence, answer.status, content?.field ?? null);
}

export const get = (path) => request("GET", path);
export const post = (path, body) => request("POST", path, body);

/** Suite names have slashes, which stay. */
export const pathOf = (name) => name.split("/").map(encodeURIComponent).join("/");

/** Give the session back when the page is left. */
export function releaseOnLeave() {
  addEventListener("pagehide", () => {
    fetch("/api/writer", { method: "DELETE", headers: { "X-Writer": WRITER }, keepalive: true }).catch(() => {});
  });
}
