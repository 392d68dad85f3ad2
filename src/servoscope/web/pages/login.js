// Asks who is there, and goes on to where they wanted to be.
import { login, Problem } from "./api.js";
import { complaint, field, h } from "./dom.js";

export async function show(main, { session, values }) {
  // Only to our own pages: an address of elsewhere could imitate them.
  const next = new URL(values.get("next") ?? "/", location.origin);
  const target = next.origin === location.origin ? next.pathname + next.search : "/";
  if (!session.login_required || session.user) return location.replace(target);
  const { element, user } = form("Log in", () => location.replace(target));
  main.replaceChildren(element);
  user.focus();
}

// Asks in a dialog over a page whose session is over; returns the new session, null if nobody logs in.
export function again() {
  return new Promise((resolve) => {
    let begun = null;
    const { element, user } = form("Log in again", (session) => ((begun = session), dialog.close()), "The session is over. What is on the page stays as it is.");
    const dialog = h("dialog", { "aria-label": "Log in again" }, element);
    dialog.addEventListener("close", () => (dialog.remove(), resolve(begun)));
    document.body.append(dialog);
    dialog.showModal();
    user.focus();
  });
}

function form(title, done, note = null) {
  const user = h("input", { name: "user", autocomplete: "username", required: true, autofocus: true });
  const password = h("input", { name: "password", type: "password", autocomplete: "current-password", required: true });
  const said = h("div", {});
  const button = h("button", { class: "first", type: "submit" }, "Log in");
  const enter = async (event) => {
    event.preventDefault();
    button.disabled = true;
    said.replaceChildren();
    try {
      done(await login(user.value, password.value));
    } catch (error) {
      if (!(error instanceof Problem)) throw error;
      said.replaceChildren(complaint(error));
      password.value = "";
      password.focus();
    } finally {
      button.disabled = false;
    }
  };
  const element = h("form", { class: "login", onsubmit: enter }, h("h1", {}, title), note && h("p", { class: "note" }, note), field("User", user), field("Password", password), said, h("div", {}, button));
  return { element, user };
}
