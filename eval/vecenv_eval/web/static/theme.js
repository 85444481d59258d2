// The page's colours: those of the system, or light or dark where the reader chose. Runs before anything is drawn.
"use strict";
(function () {
  const NAMES = ["system", "light", "dark"];
  const root = document.documentElement;

  function stored() {
    try {
      const name = localStorage.getItem("vecenv-theme");
      return NAMES.includes(name) ? name : "system";
    } catch {
      return "system"; // storage is off
    }
  }

  function use(name) {
    if (name === "system") root.removeAttribute("data-theme");
    else root.setAttribute("data-theme", name);
    const button = document.getElementById("theme");
    if (button) button.textContent = `Theme: ${name}`;
    document.dispatchEvent(new Event("themechange"));
  }

  let current = stored();
  use(current);
  document.addEventListener("DOMContentLoaded", () => {
    use(current);
    document.getElementById("theme")?.addEventListener("click", () => {
      current = NAMES[(NAMES.indexOf(current) + 1) % NAMES.length];
      try {
        localStorage.setItem("vecenv-theme", current);
      } catch {
        // It holds until the page is left.
      }
      use(current);
    });
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => use(current));
})();
