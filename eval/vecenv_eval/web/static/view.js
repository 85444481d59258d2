// The page of runs: how one or two stand, their episodes, one episode in detail, and what is running.

import { get, ServerError } from "./api.js";
import { element } from "./images.js";
import { loginDialog } from "./login.js";
import { Detail } from "./view_episode.js";
import { List } from "./view_list.js";
import { RunStream } from "./view_stream.js";
import { showSuccess, showTasks } from "./view_success.js";
import { Walls } from "./view_walls.js";

const by = (id) => document.getElementById(id);
const LIST_MS = 1000; // between two fetches of the list while episodes end

const runs = []; // one or two: { name, info }
const walls = new Walls(by("walls"), by("running"));
const detail = new Detail({ complain, pick: (step) => list.pick(step) });
const list = new List({ choose: (row) => openEpisode(row), complain });
const login = loginDialog(() => location.reload());
let pairsAsked = 0;

// -- sentences --------------------------------------------------------------------------------------------------------

function complain(error) {
  if (error instanceof ServerError && error.status === 401) {
    login();
    return;
  }
  by("problem").querySelector("p").textContent = error.message;
  by("problem").hidden = false;
}

function announce(sentence) {
  by("announced").textContent = sentence;
}

// -- how the runs stand -----------------------------------------------------------------------------------------------

function take(number, info) {
  const before = runs[number].info;
  runs[number].info = info;
  render();
  if (before && before.version !== info.version) {
    list.refreshSoon(LIST_MS);
    comparePairs();
  }
}

function render() {
  const infos = runs.map((run) => run.info).filter(Boolean);
  if (!infos.length) return;
  const pill = by("state");
  const state = infos.some((info) => info.state === "running") ? "running" : infos[0].state;
  if (pill.textContent !== state) announce(`The run is ${state}.`);
  pill.textContent = state;
  pill.dataset.state = state;
  by("folder").textContent = infos.map((info) => info.run).join(" and ");
  document.title = `${infos.map((info) => info.run).join(" and ")} - vecenv view`;
  showSuccess(by("runs"), infos);
  showTasks(by("tasks"), infos, (task) => list.showTask(task));
  list.tasks(infos);
  notes(infos);
}

function notes(infos) {
  const sentences = infos.flatMap((info) => info.problems);
  by("notes").hidden = !sentences.length;
  by("notes").querySelector("summary").textContent = `${sentences.length} ${sentences.length === 1 ? "thing" : "things"} could not be read`;
  by("notes").querySelector("ul").replaceChildren(...sentences.map((sentence) => element("li", sentence)));
}

/** Which of the episodes that both runs have changed sides. */
async function comparePairs() {
  if (runs.length < 2) return;
  const asked = (pairsAsked += 1);
  try {
    const [one, two] = runs.map((run) => encodeURIComponent(run.name));
    const pairs = await get(`/api/runs/${one}/compare/${two}?limit=1`);
    if (asked !== pairsAsked) return;
    const count = pairs.lost + pairs.won + pairs.both + pairs.neither;
    by("verdict-of-pairs").hidden = false;
    by("verdict-of-pairs").textContent = count
      ? `Of ${count} episodes with a verdict in both, ${pairs.lost} were solved by ${pairs.first} alone and ${pairs.won} by ${pairs.second} alone; McNemar's exact test: p = ${pairs.p_value.toPrecision(2)}.`
      : `${pairs.first} and ${pairs.second} have no episode in common yet.`;
  } catch (error) {
    complain(error);
  }
}

// -- one episode ------------------------------------------------------------------------------------------------------

/** @param {{first: object|null, second: object|null}} pair rows of the episode in each run. */
function openEpisode(pair) {
  const rows = [pair.first, pair.second];
  detail.open(runs.map((run, number) => ({ run: run.name, row: rows[number] ?? null })));
}

// -- keys -------------------------------------------------------------------------------------------------------------

const KEYS = {
  j: () => list.pick(1),
  k: () => list.pick(-1),
  f: () => list.toggleFailures(),
  "/": () => by("text").focus(),
  "?": () => by("help").showModal(),
  Escape: () => detail.close(),
};
const SCRUB = {
  " ": () => detail.toggle(),
  ArrowLeft: (event) => detail.move(event.shiftKey ? -10 : -1),
  ArrowRight: (event) => detail.move(event.shiftKey ? 10 : 1),
  Home: () => detail.move(-Infinity),
  End: () => detail.move(Infinity),
};

function isTyping(target, key) {
  if (target.closest("dialog")) return true;
  if (target.matches("textarea, select, input:not([type=range]):not([type=checkbox])")) return true;
  return key === " " && target.matches("button, summary, a, input");
}

document.addEventListener("keydown", (event) => {
  if (event.defaultPrevented || event.ctrlKey || event.metaKey || event.altKey || !by("shortcuts").checked) return;
  if (event.key === "Escape" && event.target.matches("#text")) event.target.blur();
  if (isTyping(event.target, event.key)) return;
  const act = KEYS[event.key] ?? (detail.isOpen ? SCRUB[event.key] : undefined);
  if (!act) return;
  event.preventDefault();
  act(event);
});

by("help-open").addEventListener("click", () => by("help").showModal());
by("problem").querySelector("button").addEventListener("click", () => (by("problem").hidden = true));

// -- begin ------------------------------------------------------------------------------------------------------------

async function begin() {
  try {
    const answer = await get("/api/runs");
    by("drive").hidden = !answer.drives;
    const opened = answer.runs.slice(0, 2);
    if (!opened.length) {
      complain(new Error("No run was opened: vecenv view DIR opens one."));
      return;
    }
    runs.push(...opened.map((each) => ({ name: each.run, info: null })));
    list.runs(runs.map((run) => run.name));
    await Promise.all(runs.map(async (run, number) => take(number, await get(`/api/runs/${encodeURIComponent(run.name)}`))));
    await Promise.all([list.refresh(), comparePairs()]);
    runs.forEach((run, number) => {
      new RunStream(run.name, {
        run: (info) => take(number, info),
        frame: (header, image) => walls.take(run.name, runs.length > 1, header, image),
        processes: (present) => walls.keep(run.name, present),
        down: () => {
          by("state").textContent = "no connection";
          by("state").dataset.state = "connecting";
        },
      }).open();
    });
    document.body.dataset.ready = "";
  } catch (error) {
    complain(error.status === 404 ? new Error("This server keeps no runs: vecenv serve --out DIR does, and vecenv view DIR shows finished ones.") : error);
  }
}

begin();
