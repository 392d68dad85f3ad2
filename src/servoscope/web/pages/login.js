// Asks who is there, and goes on to where they wanted to be.
import { login, Problem } from "./api.js";
import { complaint, field, h } from "./dom.js";

export async function show(main, { session, values }) {
  // Only to our own pages: an address of elsewhere could imitate them.
  const next = new URL(values.get("next") ?? "/", location.origin);
  const target = next.origin === location.origin ? next.pathname + next.search : "/";
  if (!session.login_required || session.user) return location.replace(target);
  const user = h("input", { name: "user", autocomplete: "username", required: true, autofocus: true });
  const password = h("input", { name: "password", type: "password", autocomplete: "current-password", required: true });
  const said = h("div", {});
  const button = h("button", { class: "first", type: "submit" }, "Log in");
  const enter = async (event) => {
    event.preventDefault();
    button.disabled = true;
    said.replaceChildren();
    try {
      await login(user.value, password.value);
      location.replace(target);
    } catch (error) {
      if (!(error instanceof Problem)) throw error;
      said.replaceChildren(complaint(error));
      password.value = "";
      password.focus();
    } finally {
      button.disabled = false;
    }
  };
  main.replaceChildren(h("form", { class: "login", onsubmit: enter }, h("h1", {}, "Log in"), field("User", user), field("Password", password), said, h("div", {}, button)));
  user.focus();
}
