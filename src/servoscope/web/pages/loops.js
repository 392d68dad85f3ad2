// Which loop: that of a baseline, an example, or the text of a loop file.
import { get } from "./api.js";
import { field, h } from "./dom.js";

const OWN = "own";

// `read()` returns the choice as the interface wants it.
export async function loopChoice(id, signal, wanted = null) {
  const { loops } = await get("/loops", signal);
  const words = (one) => `${one.name}${one.ref.example ? " (example)" : ""}, ${one.sample_rate_hz} Hz, ${one.plant}`;
  const at = loops.findIndex((one) => one.ref.baseline && one.ref.baseline === wanted);
  const select = h("select", { id: `${id}-loop` }, loops.map((one, i) => h("option", { value: i, selected: i === Math.max(at, 0) }, words(one))), h("option", { value: OWN }, "a loop file of your own"));
  const text = h("textarea", { class: "code", rows: "14", cols: "80", spellcheck: "false", "aria-label": "Loop file (TOML)" });
  const shown = h("div", { hidden: true }, field("Loop file (TOML)", text));
  const edit = h("button", { type: "button", class: "quiet" }, "Start from its text");
  const refresh = () => {
    shown.hidden = select.value !== OWN;
    edit.hidden = select.value === OWN || !loops[select.value]?.toml;
  };
  edit.addEventListener("click", () => {
    text.value = loops[select.value].toml;
    select.value = OWN;
    refresh();
    text.focus();
  });
  select.addEventListener("change", refresh);
  refresh();
  const element = h("div", {}, h("div", { class: "actions" }, field("Loop", select), edit), shown);
  // As `suit` of a mapping takes them.
  const columns = () => (select.value === OWN ? /^\s*\[columns\]/m.test(text.value) || null : loops[select.value].columns);
  const changed = (then) => [select, edit, text].forEach((each) => each.addEventListener(each === edit ? "click" : "change", then));
  return { element, columns, changed, read: () => (select.value === OWN ? { toml: text.value } : loops[select.value].ref) };
}
