// The page on which a batch is driven and watched: what the server says is shown, and what the reader does is sent.

import { get, post, releaseOnLeave, ServerError, WRITER } from "./api.js";
import { Cameras } from "./cameras.js";
import { element } from "./images.js";
import { controlKeys } from "./keys.js";
import { loginDialog } from "./login.js";
import { showPlan } from "./planning.js";
import { Plots } from "./plots.js";
import { Setup } from "./setup.js";
import { Slots, verdict } from "./slots.js";
import { Stream } from "./stream.js";
import { Wall } from "./wall.js";

const by = (id) => document.getElementById(id);
const HISTORY_MS = 500;
const RATES_MS = 1000;
const KEEP_MS = 20_000; // the server gives the session to others when its writer is silent for a minute
const TELL_MS = 150; // after the last of several slots that were chosen in a row
const FPS = 15;
const SIZE = 384;
const SHOWN_FIRST = ["agentview", "wrist"];

let state = { state: "connecting", slots: [], num_slots: 0, cameras: [] };
let followed = 0;
let cameras = null; // names the reader chose; null for the first ones
const sending = new Set(); // requests that are not answered yet
let connected = false;
let telling = 0;
let problemOf = ""; // what the sentence that is shown is about
let history = { slot: -1, step: -1, episode: "", running: false }; // what the plots show

const views = new Cameras(by("cameras"));
const plots = new Plots(by("plots"));
const wall = new Wall(by("wall"), follow);
const slots = new Slots(follow);
const setup = new Setup(load, (sentence) => complain(sentence, "request"));
const stream = new Stream({
  session: show,
  frame: (header, image) => views.take(header, image),
  wall: (header, image) => wall.take(header, image),
  problem: (sentence) => complain(sentence, "stream"),
  up: () => {
    stream.keep(WRITER);
    return connectedAgain();
  },
  down: disconnected,
});
const login = loginDialog(() => {
  settle("connection");
  if (!connected) stream.open();
  else connectedAgain();
});

// -- sentences --------------------------------------------------------------------------------------------------------

function complain(sentence, about) {
  problemOf = about;
  by("problem").querySelector("p").textContent = sentence;
  by("problem").hidden = false;
}

function settle(about) {
  if (problemOf === about) by("problem").hidden = true;
}

/** For readers that hear the page. */
function announce(sentence) {
  if (by("announced").textContent !== sentence) by("announced").textContent = sentence;
}

/** Send what the reader asked for; a refusal is shown as the server says it. */
async function send(path, body) {
  const key = `${path} ${body.action ?? ""}`; // the same one again waits for its answer, another one does not
  if (sending.has(key)) return null;
  sending.add(key);
  enable();
  try {
    const answer = await post(path, body);
    settle("request");
    return answer;
  } catch (error) {
    if (error instanceof ServerError && error.status === 401) login();
    else complain(error.message, "request");
    return null;
  } finally {
    sending.delete(key);
    enable();
  }
}

// -- the batch --------------------------------------------------------------------------------------------------------

async function load(body) {
  const answer = await send("/api/session", body);
  if (answer) follow(0);
}

async function act(action) {
  const body = { action };
  if (action === "step") {
    const ticks = by("ticks").valueAsNumber;
    if (!Number.isInteger(ticks) || ticks < 1) {
      complain("The ticks of a step are a whole number, 1 or more.", "request");
      return;
    }
    body.ticks = ticks;
  }
  await send("/api/panel/actions", body);
}

const toggle = () => act(state.state === "playing" ? "pause" : "play");

function follow(slot) {
  const last = Math.max(0, state.slots.length - 1);
  followed = Math.max(0, Math.min(last, slot));
  views.follow(followed);
  wall.follow(followed);
  subscribe();
  render();
  const now = state.slots[followed];
  if (now) announce(`Slot ${followed}: ${now.instruction}; tick ${now.step} of ${now.max_steps}, ${verdict(now)}`);
  if (by("view3d").open) tell3d();
}

function subscribe() {
  stream.subscribe({ slot: followed, cameras: shownCameras(), size: SIZE, wall: state.slots.length > 1, fps: FPS });
}

function shownCameras() {
  const there = state.cameras ?? [];
  if (cameras) return cameras.filter((name) => there.includes(name));
  const first = SHOWN_FIRST.filter((name) => there.includes(name));
  return first.length ? first : there.slice(0, 1);
}

// -- showing ----------------------------------------------------------------------------------------------------------

function show(next) {
  const before = state;
  state = next;
  if (next.state !== before.state) announce(spoken(next));
  if (followed >= next.slots.length && next.slots.length) follow(0);
  if (String(before.cameras) !== String(next.cameras)) cameraNames();
  if (next.num_slots !== before.num_slots || next.suite !== before.suite) {
    views.clear();
    wall.clear();
  }
  if (!next.error) settle("session");
  else if (next.error !== before.error) complain(next.error, "session");
  subscribe();
  setup.follow(next).catch((error) => complain(error.message, "request"));
  render();
}

const spoken = (now) => `${now.state}${now.slots.length ? `, tick ${now.tick}, ${now.successes} of ${now.finished} ended episodes solved` : ""}`;

function render() {
  const pill = by("state");
  pill.textContent = connected ? state.state : "no connection";
  pill.dataset.state = connected ? state.state : "connecting";
  const other = state.writer_held && !state.writer ? "; driven by another client" : "";
  by("batch").textContent = state.suite ? `${state.suite}, tick ${state.tick}${other}` : "";
  by("running-policy").textContent = state.policy ?? "-";
  by("preparing").hidden = !state.preparing_images;
  const count = state.slots.length;
  by("slot").max = Math.max(0, count - 1);
  if (document.activeElement !== by("slot")) by("slot").value = followed;
  const spokenSlot = state.slots[followed] ? `slot ${followed}, ${verdict(state.slots[followed])}` : "";
  by("wall").setAttribute("aria-valuemax", Math.max(0, count - 1));
  by("wall").setAttribute("aria-valuenow", followed);
  by("wall").setAttribute("aria-valuetext", spokenSlot);
  by("of-slots").textContent = count ? `of ${count}` : "";
  const speed = by("speed");
  const limit = state.ticks_per_second === null || state.ticks_per_second === undefined ? "" : String(state.ticks_per_second);
  if (![...speed.options].some((each) => each.value === limit)) {
    const more = element("option", `${limit} ticks/s`);
    more.value = limit;
    speed.append(more);
  }
  if (document.activeElement !== speed) speed.value = limit;
  slots.show(state, followed);
  showPlan(state.planning, followed);
  document.querySelector(".all").classList.toggle("few", count < 2);
  document.querySelector(".page").classList.toggle("empty", count === 0 && state.state !== "building");
  view3d();
  enable();
}

function enable() {
  const is = state.state;
  const playing = is === "playing";
  const loaded = connected && state.slots.length > 0 && is !== "building";
  const enabled = {
    play: loaded && is !== "error",
    step: loaded && !playing && is !== "error",
    stop: loaded && (playing || is === "paused"),
    reset: loaded,
    load: connected && !sending.has("/api/session ") && is !== "building",
    slot: state.slots.length > 1,
  };
  for (const [id, on] of Object.entries(enabled)) {
    // A button that is disabled loses the focus, and the keyboard its place; aria-disabled keeps it.
    if (id === "slot") by(id).disabled = !on;
    else by(id).setAttribute("aria-disabled", String(!on));
  }
  by("play").textContent = playing ? "Pause" : is === "paused" ? "Resume" : "Play";
  by("load").textContent = is === "building" ? "Loading\u2026" : "Load";
}

const may = (id) => by(id).getAttribute("aria-disabled") !== "true";

function cameraNames() {
  const there = state.cameras ?? [];
  const box = by("camera-names");
  by("camera-choice").hidden = there.length < 2;
  const labels = there.map((name) => {
    const label = element("label", "", "check");
    const check = element("input");
    check.type = "checkbox";
    check.checked = shownCameras().includes(name);
    check.addEventListener("change", () => {
      const chosen = [...box.querySelectorAll("input")].map((each, i) => (each.checked ? there[i] : null));
      cameras = chosen.filter((each) => each !== null).slice(0, 8);
      views.clear();
      subscribe();
    });
    label.append(check, ` ${name}`);
    return label;
  });
  box.replaceChildren(box.querySelector("legend"), ...labels);
}

// -- plots ------------------------------------------------------------------------------------------------------------

async function refreshPlots() {
  const now = state.slots[followed];
  if (!now || !connected || history.running) return;
  const same = history.slot === followed && history.step === now.step && history.episode === now.episode_id;
  if (same) return;
  history.running = true;
  try {
    const columns = await get(`/api/session/history?slot=${followed}`);
    if (columns.slot === undefined || columns.slot === followed) plots.show(columns);
    history = { slot: followed, step: now.step, episode: now.episode_id, running: false };
  } catch (error) {
    history.running = false;
    if (error.status === 0) return; // the stream says that the server is away
    history = { slot: followed, step: now.step, episode: now.episode_id, running: false };
  }
}

// -- 3-D view ---------------------------------------------------------------------------------------------------------

function view3d() {
  const address = state.url_3d;
  by("view3d").hidden = !address;
  if (!address) return;
  by("view3d-link").href = address;
  const frame = by("view3d-frame").querySelector("iframe");
  if (frame && frame.dataset.address !== address) frame.remove();
  if (by("view3d").open && !by("view3d-frame").querySelector("iframe")) {
    const made = document.createElement("iframe");
    made.title = "3-D view of the followed slot";
    made.dataset.address = address;
    made.src = address;
    by("view3d-frame").append(made);
    tell3d();
  }
}

/** The 3-D view is a page of its own; it shows the slot that is followed here. */
function tell3d() {
  clearTimeout(telling);
  telling = setTimeout(() => {
    post("/api/view3d", { slot: followed }).catch((error) => complain(error.message, "request"));
  }, TELL_MS);
}

// -- connection -------------------------------------------------------------------------------------------------------

async function connectedAgain() {
  connected = true;
  settle("connection");
  try {
    show(await get("/api/session"));
    await setup.fill();
    await setup.follow(state);
    document.body.dataset.ready = "yes";
  } catch (error) {
    if (error.status === 401) login();
    else complain(error.message, "connection");
  }
}

async function disconnected(seconds) {
  const was = connected;
  connected = false;
  render();
  try {
    await get("/api/session");
    complain(`The stream of the server was closed; trying again in ${seconds} s.`, "connection");
  } catch (error) {
    if (error.status === 401) login();
    else complain(`The server does not answer; trying again in ${seconds} s.`, "connection");
  }
  if (was) announce("The connection was lost.");
}

// -- what the reader does ---------------------------------------------------------------------------------------------

const actions = { play: toggle, step: () => act("step"), stop: () => act("stop"), reset: () => act("reset") };
for (const [id, action] of Object.entries(actions)) {
  by(id).addEventListener("click", () => {
    if (may(id)) action();
  });
}
by("load").addEventListener("click", (event) => {
  if (!may("load")) event.preventDefault();
});
by("slot").addEventListener("change", () => follow(by("slot").valueAsNumber || 0));
by("speed").addEventListener("change", async () => {
  await send("/api/session/speed", { ticks_per_second: by("speed").value === "" ? null : Number(by("speed").value) });
});
by("tile").addEventListener("change", () => wall.resize(Number(by("tile").value)));
by("problem").querySelector("button").addEventListener("click", () => {
  by("problem").hidden = true;
});
by("view3d").addEventListener("toggle", view3d);
by("help-open").addEventListener("click", () => by("help").showModal());
controlKeys({
  run: (id) => {
    if (may(id)) actions[id]();
  },
  move: (steps) => follow(followed + steps),
  go: (slot) => follow(slot < 0 ? state.slots.length - 1 : slot),
  columns: () => wall.columns,
});

setInterval(refreshPlots, HISTORY_MS);
let before = { wall: 0, views: 0 };
setInterval(() => {
  const rates = { wall: wall.frames - before.wall, views: views.shown - before.views };
  before = { wall: wall.frames, views: views.shown };
  const second = RATES_MS / 1000;
  by("rates").textContent = connected && (rates.wall || rates.views) ? `Images: cameras ${rates.views / second}/s, wall ${rates.wall / second}/s, drawn in ${wall.drawMs.toFixed(1)} ms.` : "";
}, RATES_MS);
setInterval(() => {
  if (state.state === "playing" && state.writer) stream.keep(WRITER);
}, KEEP_MS);
releaseOnLeave();
follow(0);
stream.open();
