// From any log to a loop file: drop a log, say which column is what, see what is proposed and why, change it, go on to learn.
import { get, job, mayChange, part } from "./api.js";
import { during, field, h, save, section, table } from "./dom.js";
import { inspected } from "./inspection.js";
import { keep } from "./kept.js";
import { mark, prose } from "./marks.js";
import { dropzone, earlier, mapping, preview } from "./uploads.js";

// As people call the keys of a loop file; those that need a choice have what may be chosen.
const SETTINGS = {
  sample_rate: "Sample rate [Hz]",
  time: "Column of the time",
  time_unit: "Unit of the time",
  reference: "Reference r",
  input: "Input u",
  output: "Output y",
  resample: "Put on an even rate",
  text: "Where the table begins",
  kind: "Kind of plant",
  order: "Order of the plant",
  friction: "Dry friction",
  stiffness: "Held by a spring",
  offset: "Constant force",
  cutoff: "Cutoff [Hz]",
  memory: "Memory [s]",
  frequencies: "Monitored frequencies [Hz]",
};
const CHOICES = {
  true: [["true", "yes"], ["false", "no"]],
  time_unit: ["s", "ms", "us", "ns", "min"].map((unit) => [`"${unit}"`, unit]),
  friction: [['"none"', "none"], ['"coulomb"', "the same in both directions"], ['"directional"', "of its own in each direction"]],
};

export async function show(main, { session, signal, values }) {
  const work = h("div", { class: "steps" });
  main.replaceChildren(h("div", { class: "head" }, h("h1", {}, "Begin with a log")), work);
  if (!mayChange(session.role, "operator")) {
    work.replaceChildren(h("p", { class: "note" }, "Uploading a recording is for operators and engineers."));
    return;
  }
  const chosen = h("div", { class: "steps" });
  const open = (one) => {
    history.replaceState(null, "", `/begin?upload=${part(one.id)}`);
    chosen.replaceChildren(...steps(one, session, signal));
  };
  const note = "A minute or more of the healthy machine at work: set point (reference r), output of the controller (input u), measured motion (output y).";
  work.append(section("Log", note, dropzone("Drop a log here", open, signal, { begun: () => chosen.replaceChildren(), examples: ["monday"] }), (await earlier(open, signal)) ?? ""), chosen);
  if (values.get("upload")) await get(`/uploads/${part(values.get("upload"))}`, signal).then(open, () => {}); // if it is still there
}

function steps(one, session, signal) {
  const columns = mapping(one, true);
  const said = h("div", { role: "status", class: "working" });
  const result = h("div", { class: "steps" });
  const propose = h("button", { type: "button", class: "first" }, "Propose settings");
  const axis = h("select", { name: "axis" }, Object.keys(one.axes).map((name) => h("option", {}, name)));
  const ofAxis = () => axis.value && ((one.mapping = one.axes[axis.value]), columns.suit(null));
  axis.addEventListener("change", ofAxis);
  ofAxis();
  const work = async (step) => {
    const found = await job("/proposals", { upload: one.id, columns: { time: null, ...columns.read() } }, { signal, step });
    result.replaceChildren(...proposed(one, found, session, signal));
  };
  propose.addEventListener("click", () => during(propose, said, work));
  const asked = section("What is what", null, preview(one), axis.options.length > 0 && field("Axis", axis), columns.element, h("div", { class: "actions" }, propose, said));
  if (columns.read().input && columns.read().output) during(propose, said, work);
  return [asked, result];
}

// The proposal as a form, what the log is worth with it, and where to go from there.
function proposed(one, found, session, signal) {
  const rows = found.lines.map((line) => ({ line, control: control(line) }));
  const toml = () => changed(found.toml, rows);
  const said = h("div", { role: "status", class: "working" });
  const look = h("button", { type: "button" }, "Inspect with these");
  const file = h("button", { type: "button" }, "Save loop.toml");
  const learn = h("button", { type: "button", class: "first" }, "Learn a baseline with these");
  const worth = h("div", {});
  const tellWorth = (judged) => {
    const shown = inspected(judged, null, signal);
    worth.replaceChildren(section("Is the log usable?", null, shown.element));
    shown.draw();
  };
  look.addEventListener("click", () => during(look, said, async (step) => tellWorth(await job("/inspections", { upload: one.id, loop: { toml: toml() } }, { signal, step }))));
  const download = async () => {
    const address = URL.createObjectURL(new Blob([toml()], { type: "application/toml" }));
    save(address, "loop.toml");
    URL.revokeObjectURL(address);
  };
  file.addEventListener("click", () => during(file, said, download));
  const goOn = async () => {
    keep("learn", { loop: "own", toml: toml() });
    location.assign(`/learn?upload=${part(one.id)}`);
  };
  learn.addEventListener("click", () => during(learn, said, goOn));
  const doubts = found.lines.filter((line) => line.doubtful).length;
  const form = section(
    "Proposed settings",
    null,
    doubts > 0 && h("p", { class: "note" }, mark("care"), " In doubt are the lines with this mark: check them before you learn."),
    table("Proposed settings", ["Setting", "Value", "Why"], rows.map(({ line, control }) => [h("span", {}, line.doubtful && mark("care", "in doubt"), " ", SETTINGS[line.key] ?? line.key), control, h("span", {}, prose(line.why))])),
    h("div", { class: "actions" }, mayChange(session.role, "engineer") && learn, look, file, said),
  );
  queueMicrotask(() => tellWorth(found)); // once both are in the page
  return [form, worth];
}

// Where a value is typed or chosen; its `data-toml` is what the loop file says.
function control(line) {
  const name = SETTINGS[line.key] ?? line.key;
  const choices = CHOICES[line.key] ?? (/^(true|false)$/.test(line.value) && CHOICES.true);
  if (choices) return h("select", { "aria-label": name }, choices.map(([value, words]) => h("option", { value, selected: value === line.value }, words)));
  const shown = line.value.startsWith('"') ? JSON.parse(line.value) : line.value.replace(/^\[(.*)\]$/, "$1");
  return h("input", { value: shown, "aria-label": name, autocomplete: "off", size: "28", readonly: line.key === "kind" });
}

// A control's value as TOML, in the way of what was proposed: text, list, number or choice.
function written(line, control) {
  const value = control.value.trim();
  if (control.options) return value;
  if (line.value.startsWith('"')) return JSON.stringify(value);
  const text = line.value.startsWith("[") ? `[${value}]` : value;
  if (line.value.startsWith("{") || isNumeric(text)) return text;
  throw new Error(`${SETTINGS[line.key] ?? line.key}: ${value || "nothing"} is no number`);
}

function isNumeric(text) {
  try {
    return [JSON.parse(text)].flat().every((each) => typeof each === "number" || typeof each === "string");
  } catch {
    return false;
  }
}

// The loop file with the values of the form; of what was changed it says so.
function changed(toml, rows) {
  const said = new Map(rows.map(({ line, control }) => [`${line.key} = ${line.value}`, [line, written(line, control)]]));
  const redone = (row) => {
    const known = [...said.keys()].find((start) => row === start || row.startsWith(`${start} `));
    const [line, value] = said.get(known) ?? [];
    return !line || value === line.value ? row : `${line.key} = ${value}  # changed by hand; proposed: ${line.value}`;
  };
  return toml.split("\n").map(redone).join("\n");
}
