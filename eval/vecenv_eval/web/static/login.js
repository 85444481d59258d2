// The dialog that asks for the server's token. Only scripts send one, so it is made here and not written into the pages.

import { post } from "./api.js";

/**
 * @param {() => void} done called when the server has taken the token.
 * @returns {() => void} opens the dialog.
 */
export function loginDialog(done) {
  const token = made("input", { id: "token", type: "password", autocomplete: "current-password", required: "" });
  const problem = made("p", { id: "login-problem", class: "bad", role: "alert" });
  const form = made(
    "form",
    {},
    made("label", { for: "token" }, "The server was started with a token; enter it to go on."),
    made("input", { type: "text", autocomplete: "username", value: "vecenv", hidden: "" }),
    token,
    problem,
    made("button", { class: "main" }, "Go on"),
  );
  const title = made("h2", { id: "login-title" }, "Token");
  const dialog = made("dialog", { id: "login", "aria-labelledby": "login-title" }, title, form);
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    try {
      await post("/api/login", { token: token.value });
    } catch (error) {
      problem.textContent = error.message;
      return;
    }
    token.value = problem.textContent = "";
    dialog.close();
    done();
  });
  document.body.append(dialog);
  return () => {
    if (!dialog.open) dialog.showModal();
  };
}

/** An element with attributes and children. */
function made(tag, attributes, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}
