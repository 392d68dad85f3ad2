// Recordings on their way in: dropped or chosen files, what is in them, which column is what.
import { get, job, part, post, upload } from "./api.js";
import { complaint, during, field, h, translate, table, tell } from "./dom.js";
import { count, moment, number } from "./words.js";

const UNITS = ["s", "ms", "us", "ns", "min"];
const COMBINED = "*"; // no name of a column alone
const SIGNALS = [
  ["time", "Time"],
  ["reference", "Reference r"],
  ["input", "Input u"],
  ["output", "Output y"],
];

// A log of the tutorial's axis: healthy on monday and tuesday; on friday its guide runs dry.
export async function exampleLog(day, signal) {
  const answer = await fetch(`/static/examples/${day}.csv`, { signal });
  if (!answer.ok) throw new Error("The service does not answer.");
  return new File([await answer.blob()], `${day}.csv`);
}

// The loop file that is proposed for these logs.
export async function exampleLoop(step, signal, one = null) {
  one ??= await upload(await exampleLog("monday", signal), signal);
  const { toml } = await job("/proposals", { upload: one.id, columns: { time: null, ...one.mapping } }, { signal, step });
  return toml;
}

export async function exampleBaseline(name, step, signal) {
  const one = await upload(await exampleLog("monday", signal), signal);
  const toml = await exampleLoop(step, signal, one);
  const { learning } = await job("/learnings", { loop: { toml }, recordings: [{ upload: one.id }], columns: {} }, { signal, step });
  await post("/baselines", { name, learning }, signal);
}

// A place for files; `taken(upload)` is called for each that could be read, `begun` before the first. `examples`: days
// whose logs may be tried; `prepare(step)` makes what these need.
export function dropzone(words, taken, signal, { several = false, begun = () => {}, examples, prepare = () => {} }) {
  const said = h("div", { role: "status", class: "working" });
  const input = h("input", { type: "file", class: "hidden", id: "files", multiple: several, "aria-label": words });
  const choose = h("button", { type: "button", class: "first", onclick: () => input.click() }, several ? "Choose files" : "Choose a file");
  const kinds = h("small", {});
  const tried = h("button", { type: "button", onclick: () => attempt() }, "Try it with an example");
  const element = h("div", { class: "drop" }, h("span", {}, words), h("div", { class: "actions" }, choose, tried), input, kinds, said);
  // what the server can read depends on what is installed there
  get("/uploads", signal).then((found) => {
    kinds.replaceChildren(found.suffixes.join(" "));
    input.accept = found.suffixes.join(",");
  }, () => kinds.replaceChildren());
  const take = async (files) => {
    begun();
    for (const file of several ? files : [...files].slice(0, 1)) {
      tell(said, `Reading ${file.name}`);
      try {
        await taken(await upload(file, signal));
        said.replaceChildren();
      } catch (error) {
        said.replaceChildren(complaint(error));
        return;
      }
    }
  };
  const attempt = () =>
    during(tried, said, async (step) => {
      step("Reading the example");
      const files = await Promise.all(examples.map((day) => exampleLog(day, signal)));
      await prepare(step);
      await take(files);
    });
  input.addEventListener("change", () => take([...input.files]));
  element.addEventListener("dragover", (event) => (event.preventDefault(), element.classList.add("over")));
  element.addEventListener("dragleave", () => element.classList.remove("over"));
  element.addEventListener("drop", (event) => {
    event.preventDefault();
    element.classList.remove("over");
    take([...event.dataTransfer.files]);
  });
  return element;
}

// Those that are still here, as choices.
export async function earlier(chosen, signal) {
  const { uploads } = await get("/uploads", signal);
  if (!uploads.length) return null;
  const select = h("select", {}, h("option", { value: "" }, "choose"), [...uploads].reverse().map((one) => h("option", { value: one.id, translate: "no" }, `${one.name}, ${moment(one.at)}`)));
  select.addEventListener("change", async () => select.value && chosen(await get(`/uploads/${part(select.value)}`, signal)));
  return field("or one that was uploaded before", select);
}

export function preview(one) {
  const about = h("p", { class: "note" }, `${one.name}: ${count(one.rows)} rows, ${(one.bytes / 1e6).toFixed(2)} MB. The first rows, and the range of each column:`);
  const range = (column) => (column.min === null ? column.type : `${number(column.min, 3)} to ${number(column.max, 3)}`);
  const data = (words) => h("span", { translate: "no" }, words);
  const head = one.preview.columns;
  const ranges = one.preview.columns.map((name) => h("td", { class: "n" }, h("small", {}, range(one.columns.find((each) => each.name === name) ?? { min: null, type: "" }))));
  const rows = one.preview.rows.map((row) => row.map((cell) => h("td", { class: "n" }, typeof cell === "number" ? number(cell, 5) : data(String(cell ?? "")))));
  const made = table(`The first rows of ${one.name}`, head, [ranges, ...rows], { translate: "no" });
  made.classList.add("preview");
  return h("div", {}, about, made);
}

// Which column is what; `read()` returns it as the interface wants it. `suit` takes the columns of the loop that the
// recording is compared with (null: nothing is known of them; true: they stand in its text, which the server reads): a
// guess by names must not overrule what somebody has said. What was typed in stays. `loopless`: no loop is known yet.
export function mapping(one, loopless = false) {
  const names = one.columns.map((column) => column.name);
  const typed = new Set();
  const chosen = (key, words) => columnChoice(key, words, names, () => typed.add(key));
  const fields = Object.fromEntries(SIGNALS.map(([key, words]) => [key, chosen(key, words)]));
  const segment = chosen("segment", "New run where this changes");
  const unit = h("select", { name: "time_unit", onchange: () => typed.add("time_unit") }, !loopless && h("option", { value: "" }, "as in the loop file"), UNITS.map((name) => h("option", { value: name }, name)));
  const origin = h("p", { class: "note" });
  const element = h(
    "div",
    {},
    h("div", { class: "fields" }, SIGNALS.map(([key]) => fields[key].element), field("Unit of time", unit), segment.element),
    origin,
    h("p", { class: "note" }, "A combination of columns: 0.025 * counts, set_point - error. ", loopless ? "In SI units where you can: 0.001 * position_mm." : "Units are those that the baseline was learned in."),
  );
  const suit = (columns) => {
    const own = columns === true;
    const fit = !own && columns !== null && SIGNALS.every(([key]) => fits(columns[key], names));
    const found = own ? {} : fit ? columns : one.mapping;
    for (const [key] of SIGNALS) {
      fields[key].blank(own ? "as in the loop file" : "none");
      if (!typed.has(key)) fields[key].set(found[key] ?? "");
    }
    if (!typed.has("segment")) segment.set((found.segment ?? []).join(", "));
    if (!typed.has("time_unit")) unit.value = found.time_unit ?? "";
    tell(origin, own ? "As the loop file says." : fit ? "As the loop says." : "Guessed from the names: please check.");
  };
  suit(null);
  const read = () => {
    const said = Object.fromEntries(SIGNALS.map(([key]) => [key, fields[key].read()]).filter(([, value]) => value));
    const runs = segment.read().split(",").map((name) => name.trim()).filter(Boolean);
    return { ...said, ...(unit.value && { time_unit: unit.value }), ...(runs.length && { segment: runs }) };
  };
  return { element, read, suit };
}

// One column of a file, chosen, or what is typed in where it takes several.
function columnChoice(key, words, names, touched) {
  const none = h("option", { value: "" }, "none");
  const select = h("select", { name: key, "aria-label": words }, none, names.map((name) => h("option", { value: name, translate: "no" }, name)), h("option", { value: COMBINED }, "a combination"));
  const text = h("input", { name: `${key}-combined`, autocomplete: "off", hidden: true, "aria-label": `${translate(words)}: ${translate("a combination")}`, oninput: touched });
  const show = () => (text.hidden = select.value !== COMBINED);
  select.addEventListener("change", () => (touched(), show()));
  const set = (value) => {
    select.value = value && !names.includes(value) ? COMBINED : value;
    text.value = value;
    show();
  };
  return { element: h("div", { class: "steps" }, field(words, select), text), set, read: () => (select.value === COMBINED ? text.value.trim() : select.value), blank: (said) => tell(none, said) };
}

// Whether an expression is made of these columns alone; null: a recording without time.
function fits(expression, names) {
  let rest = expression ?? "";
  for (const name of [...names].sort((a, b) => b.length - a.length)) rest = rest.replaceAll(name, " ");
  return !/\p{L}/u.test(rest.replace(/\d\.?e[-+]?\d+/gi, "0"));
}
