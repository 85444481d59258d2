// The keyboard: keys run the batch and change the slot, except where a field or a list uses them itself.

const FIELDS = "input, select, textarea, [contenteditable]";
const PRESSED = "button, summary, a[href], input[type=checkbox]";
const RUN = { " ": "play", ".": "step", s: "stop", r: "reset" };

/**
 * @param {{run: (id: string) => void, move: (by: number) => void, go: (slot: number) => void, columns: () => number}} to
 *   run a button by its id; move by some slots; go to a slot, -1 for the last; columns of the wall.
 */
export function controlKeys(to) {
  const help = document.getElementById("help");
  const wall = document.getElementById("wall");
  const used = document.getElementById("shortcuts");
  try {
    used.checked = localStorage.getItem("vecenv-keys") !== "off";
  } catch {
    // Storage is off: the keys are used.
  }
  used.addEventListener("change", () => {
    try {
      localStorage.setItem("vecenv-keys", used.checked ? "on" : "off");
    } catch {
      // It holds until the page is left.
    }
  });
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.isComposing) return;
    if (document.querySelector("dialog[open]")) return;
    const target = event.target instanceof Element ? event.target : document.body;
    if (target === wall && along(event.key)) {
      event.preventDefault();
      return;
    }
    if (!used.checked || target.closest(FIELDS)) return;
    if (event.key === " " && target.closest(PRESSED)) return;
    if (event.key === "?") help.showModal();
    else if (event.key in RUN) {
      if (!event.repeat || event.key === ".") to.run(RUN[event.key]);
    } else if (event.key === "ArrowLeft") to.move(-1);
    else if (event.key === "ArrowRight") to.move(1);
    else return;
    event.preventDefault();
  });

  /** Move in the wall; whether the key does. */
  function along(key) {
    const columns = to.columns();
    const steps = { ArrowLeft: -1, ArrowRight: 1, ArrowUp: -columns, ArrowDown: columns };
    if (key in steps) to.move(steps[key]);
    else if (key === "Home") to.go(0);
    else if (key === "End") to.go(-1);
    else return false;
    return true;
  }
}
