// Which loop: that of a baseline, an example, or the text of a loop file.
import { get } from "./api.js";
import { field, h } from "./dom.js";
import { kept } from "./kept.js";

const OWN = "own";

// `read()` returns the choice as the interface wants it.
export async function loopChoice(id, signal, wanted = null) {
  const { loops } = await get("/loops", signal);
  const words = (one) => `${one.name} (${one.ref.example ? "example" : one.ref.baseline}), ${one.sample_rate_hz} Hz, ${one.plant}`;
  const select = h("select", { id: `${id}-loop`, name: "loop" }, loops.map((one) => h("option", { value: keyOf(one), selected: one.ref.baseline === wanted }, words(one))), h("option", { value: OWN }, "a loop file of your own"));
  const chosen = () => loops.find((one) => keyOf(one) === select.value);
  const text = h("textarea", { class: "code", name: "toml", rows: "14", cols: "80", spellcheck: "false", "aria-label": "Loop file (TOML)" });
  const shown = h("div", { hidden: true }, field("Loop file (TOML)", text));
  const edit = h("button", { type: "button", class: "quiet" }, "Start from its text");
  const refresh = () => {
    shown.hidden = select.value !== OWN;
    edit.hidden = !chosen()?.toml;
  };
  const take = (toml) => {
    text.value = toml;
    select.value = OWN;
    for (const each of [select, text]) each.dispatchEvent(new Event("input", { bubbles: true }));
    refresh();
  };
  edit.addEventListener("click", () => (take(chosen().toml), text.focus()));
  select.addEventListener("change", refresh);
  refresh();
  const element = h("div", {}, h("div", { class: "actions" }, field("Loop", select), edit), shown);
  if (wanted === null) kept(id, element);
  // As `suit` of a mapping takes them.
  const columns = () => (select.value === OWN ? /^\s*\[columns\]/m.test(text.value) || null : chosen().columns);
  const changed = (then) => [select, edit, text].forEach((each) => each.addEventListener(each === edit ? "click" : "change", then));
  const units = () => chosen()?.units ?? null;
  return { element, columns, units, changed, take, read: () => (select.value === OWN ? { toml: text.value } : chosen().ref) };
}

const keyOf = (one) => Object.entries(one.ref).flat().join(" ");
