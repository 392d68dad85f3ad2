// Asks who is there, and goes on to where they wanted to be.
import { login, Problem, session as ask } from "./api.js";
import { complaint, field, h } from "./dom.js";

export async function show(main, { session, values }) {
  // Only to our own pages: an address of elsewhere could imitate them.
  const next = new URL(values.get("next") ?? "/", location.origin);
  const target = next.origin === location.origin ? next.pathname + next.search : "/";
  if (!session.login_required || session.user) return location.replace(target);
  const { element, user } = form("Log in", () => location.replace(target), { session, target });
  main.replaceChildren(element);
  user?.focus();
}

// Asks in a dialog over a page whose session is over; returns the new session, null if nobody logs in.
export async function again() {
  const session = await ask();
  return new Promise((resolve) => {
    let begun = null;
    const { element, user } = form("Log in again", (session) => ((begun = session), dialog.close()), {
      session,
      note: "The session is over. What is on the page stays as it is.",
    });
    const dialog = h("dialog", { "aria-label": "Log in again" }, element);
    dialog.addEventListener("close", () => (dialog.remove(), resolve(begun)));
    document.body.append(dialog);
    dialog.showModal();
    user?.focus();
  });
}

// With `target`, the page that a login leads to; without, a login is in another tab, and the page stays.
function form(title, done, { session, target = null, note = null }) {
  if (!session.password_login) {
    const signOn = h("a", { class: "button", href: target ?? "/", target: target ? null : "_blank" }, "Try again");
    const why = "The proxy in front of these pages signs users in, and has named nobody: try again, or ask who runs this server.";
    return { element: h("div", { class: "login" }, h("h1", {}, title), h("p", { class: "note" }, why), h("div", {}, signOn, !target && renew(done))), user: null };
  }
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

// Goes on where another tab has logged in.
function renew(done) {
  const enter = async () => {
    const session = await ask();
    if (session.user) done(session);
  };
  return h("button", { type: "button", onclick: enter }, "I have logged in there");
}
