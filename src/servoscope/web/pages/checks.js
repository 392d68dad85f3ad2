// What to check in words of one's own, for each fault that is suspected on an asset.
import { mayChange, post } from "./api.js";
import { during, field, h } from "./dom.js";
import { moment } from "./words.js";

export function editor(path, checks, session, signal) {
  const known = checks.filter((one) => one.fault);
  const written = known.filter((one) => one.who).map((one) => h("p", { class: "note" }, `Written by ${one.who}, ${moment(one.at)}`));
  if (!known.length || !mayChange(session.role, "operator")) return written;
  return [...written, h("details", { class: "screen" }, h("summary", {}, "Change what to check on this machine"), known.map((one) => form(path, one, signal)))];
}

function form(path, check, signal) {
  const text = h("textarea", { rows: "4", maxlength: "3000" }, check.texts.join("\n"));
  const [answer, button] = [h("p", { class: "working", role: "status" }), h("button", {}, "Save")];
  const submit = (event) => {
    event.preventDefault();
    return during(button, answer, async () => {
      const texts = text.value.split("\n").map((line) => line.trim()).filter(Boolean);
      await post(`${path}/checks`, { fault: check.fault, texts }, signal);
      location.reload();
    });
  };
  return h("form", { onsubmit: submit }, field(check.label, text, "One line for each check; none: as the plant has it."), h("div", { class: "actions" }, button), answer);
}
