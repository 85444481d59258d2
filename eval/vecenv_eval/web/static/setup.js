// The form that chooses a batch: suite, task, episode, slots and policy, each list following from the one before.

import { element } from "./images.js";
import { get, pathOf } from "./api.js";

const ALL = "all";
const FAMILIES = { libero: "LIBERO", simpler: "SIMPLER" };

const by = (id) => document.getElementById(id);

function option(value, text) {
  const made = element("option", text);
  made.value = value;
  return made;
}

/** `name=value` lines as an object; values are JSON where they are, else text. Throws with a sentence. */
export function settings(text, what) {
  const found = {};
  for (const line of text.split("\n").map((each) => each.trim()).filter(Boolean)) {
    const at = line.indexOf("=");
    if (at < 1) throw new Error(`${what}: "${line}" is not of the form name=value.`);
    const name = line.slice(0, at).trim();
    if (Object.hasOwn(found, name)) throw new Error(`${what}: ${name} is given twice.`);
    const value = line.slice(at + 1).trim();
    try {
      found[name] = JSON.parse(value);
    } catch {
      found[name] = value;
    }
  }
  return found;
}

const span = (from, count) => (count > 1 ? `${from}-${from + count - 1}` : String(from));

/**
 * Which tasks and episodes fill the slots: of one task the episodes from the chosen one on, of all tasks the same
 * episodes of each.
 *
 * @returns {{tasks: string, episodes: string, num_slots: number, words: string}}; throws with a sentence.
 */
export function placement(tasks, task, episode, slots) {
  const chosen = task === ALL ? tasks : tasks.filter((each) => String(each.task) === task);
  const each = Math.ceil(slots / chosen.length);
  const there = Math.min(...chosen.map((one) => one.num_episodes));
  if (episode + each > there) {
    const room = Math.max(0, there - episode) * chosen.length;
    throw new Error(`There are ${there} episodes${chosen.length > 1 ? " of each task" : ""}: from episode ${episode} on, ${room} slots can be filled.`);
  }
  const episodes = span(episode, each);
  if (task !== ALL) {
    return { tasks: task, episodes, num_slots: slots, words: each > 1 ? `Episodes ${episodes}, one a slot.` : "" };
  }
  const used = chosen.length * each;
  const words = `${chosen.length} tasks, episode${each > 1 ? "s" : ""} ${episodes}: ${used} episodes in ${slots} slots.`;
  return { tasks: ALL, episodes, num_slots: slots, words };
}

export class Setup {
  /**
   * @param {(body: object) => Promise<void>} load called with the body of `POST /api/session`.
   * @param {(sentence: string) => void} complain
   */
  constructor(load, complain) {
    Object.assign(this, { load, complain });
    this.suites = [];
    this.tasks = [];
    this.policies = [];
    this.touched = false;
    this.asked = 0;
    this.followed = null; // the suite that the form has taken over from the server
    by("suite").addEventListener("change", () => this.edited(() => this.suiteChanged()));
    by("task").addEventListener("change", () => this.edited(() => this.taskChanged()));
    for (const id of ["episode", "slots"]) by(id).addEventListener("input", () => this.edited(() => this.place()));
    by("policy").addEventListener("change", () => this.edited(() => this.describe()));
    by("setup").addEventListener("submit", (event) => {
      event.preventDefault();
      this.submit();
    });
  }

  async edited(then) {
    this.touched = true;
    try {
      await then();
    } catch (error) {
      this.complain(error.message);
    }
  }

  /** Fetch the lists that depend on nothing. */
  async fill() {
    const [catalog, policies] = await Promise.all([get("/api/catalog"), get("/api/policies")]);
    this.suites = catalog.suites;
    this.policies = policies.policies;
    const groups = new Map();
    for (const suite of this.suites) {
      if (!groups.has(suite.family)) {
        const group = element("optgroup");
        group.label = FAMILIES[suite.family] ?? suite.family ?? "";
        groups.set(suite.family, group);
      }
      groups.get(suite.family).append(option(suite.name, suite.label ?? suite.name));
    }
    const before = [by("suite").value, by("policy").value];
    by("suite").replaceChildren(...groups.values());
    by("policy").replaceChildren(...this.policies.map((policy) => option(policy.name, policy.name)));
    this.select("suite", before[0]);
    this.select("policy", before[1]);
    this.describe();
    await this.suiteChanged();
  }

  select(id, value) {
    const field = by(id);
    if ([...field.options].some((each) => each.value === String(value))) field.value = String(value);
  }

  async suiteChanged() {
    const suite = by("suite").value;
    const asked = (this.asked += 1);
    const answer = suite ? await get(`/api/catalog/${pathOf(suite)}`) : { tasks: [] };
    if (asked !== this.asked) return; // another suite was chosen meanwhile
    this.tasks = answer.tasks;
    const before = by("task").value;
    const options = this.tasks.map((task) => option(task.task, this.taskLabel(task)));
    if (this.tasks.length > 1) options.push(option(ALL, `all ${this.tasks.length} tasks`));
    by("task").replaceChildren(...options);
    this.select("task", before);
    this.taskChanged();
  }

  taskLabel(task) {
    const label = task.label ?? "";
    return label === "" || label === String(task.task) ? `${task.task}  ${task.instruction ?? ""}` : label;
  }

  taskChanged() {
    const value = by("task").value;
    const task = this.tasks.find((each) => String(each.task) === value);
    by("task-instruction").textContent = task?.instruction ?? "";
    const counts = (task ? [task] : this.tasks).map((each) => each.num_episodes);
    const count = counts.length ? Math.min(...counts) : 0;
    const before = by("episode").value;
    by("episode").replaceChildren(...Array.from({ length: count }, (_, i) => option(i, String(i))));
    this.select("episode", before);
    if (value === ALL && by("slots").valueAsNumber === 1) by("slots").value = this.tasks.length;
    this.place();
  }

  describe() {
    const policy = this.policies.find((each) => each.name === by("policy").value);
    by("policy-description").textContent = policy?.description ?? "";
  }

  /** Say which episodes fill the slots; null where they cannot. */
  place() {
    const slots = by("slots").valueAsNumber;
    const words = by("placement");
    words.classList.remove("bad");
    if (!this.tasks.length || !Number.isInteger(slots) || slots < 1) {
      words.textContent = "";
      return null;
    }
    try {
      const placed = placement(this.tasks, by("task").value, Number(by("episode").value), slots);
      words.textContent = placed.words;
      return placed;
    } catch (error) {
      words.textContent = error.message;
      words.classList.add("bad");
      return null;
    }
  }

  async submit() {
    const placed = this.place();
    if (!placed) {
      this.complain(by("placement").textContent || "The number of slots is a whole number, 1 or more.");
      return;
    }
    const { tasks, episodes, num_slots } = placed;
    try {
      const body = {
        suite: by("suite").value,
        tasks,
        episodes,
        num_slots,
        policy: by("policy").value,
        policy_args: settings(by("policy-args").value, "Options of the policy"),
        env_args: settings(by("env-args").value, "Options of the environment"),
      };
      this.touched = false;
      await this.load(body);
    } catch (error) {
      this.complain(error.message);
    }
  }

  /** Show what the server runs, unless the reader is choosing something else. */
  async follow(state) {
    // Only what stands at its start: in a run, slots go on to other episodes.
    const begun = state.state !== "ready" && this.followed === state.suite;
    if (this.touched || begun || !state.slots.length || !this.suites.length) return;
    this.followed = state.suite;
    const changed = by("suite").value !== state.suite;
    this.select("suite", state.suite);
    if (changed) await this.suiteChanged();
    const several = new Set(state.slots.map((slot) => slot.task)).size > 1;
    this.select("task", several ? ALL : state.task);
    this.taskChanged();
    this.select("episode", several ? Math.min(...state.slots.map((slot) => slot.episode)) : state.episode);
    if (state.num_slots) by("slots").value = state.num_slots;
    this.select("policy", this.policyOf(state.policy));
    this.describe();
    if (this.place() && state.planned > state.slots.length) {
      by("placement").textContent = `${state.planned} episodes in ${state.slots.length} slots.`;
    }
  }

  /** The policy in the list that a running one is: a policy may add to its name, such as the model it asks. */
  policyOf(running) {
    const found = this.policies.map((each) => each.name).filter((name) => running?.startsWith(name));
    return found.sort((a, b) => b.length - a.length)[0];
  }
}
