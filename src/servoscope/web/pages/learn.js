// Healthy recordings to a baseline: choose the loop, choose recordings, see excitation and quality, learn, save.
import { get, job, mayChange, part, post } from "./api.js";
import { complaint, during, field, h, section, translate, table, tell } from "./dom.js";
import { findings, inspected } from "./inspection.js";
import { kept } from "./kept.js";
import { loopChoice } from "./loops.js";
import { mark, prose } from "./marks.js";
import { dropzone, earlier, exampleLoop, mapping, preview } from "./uploads.js";
import { change, count, DASH, duration, general, moment, number, plain, withStd } from "./words.js";

const FEWEST = 5; // like machines, of which something in common is known
const KINDS = { usable: "healthy", "usable with care": "care", "not usable": "stop" };

export async function show(main, { session, signal, values }) {
  const saved = h("div", {});
  const work = h("div", { class: "steps" });
  main.replaceChildren(h("div", { class: "head" }, h("h1", {}, "Learn a baseline")), work, section("Baselines", null, saved));
  const machines = likes();
  const refresh = async () => {
    const all = (await get("/baselines", signal)).baselines;
    saved.replaceChildren(baselines(all));
    machines.list(all);
  };
  await refresh();
  if (!mayChange(session.role, "engineer")) {
    work.replaceChildren(h("p", { class: "note" }, "Learning a baseline is for engineers; these are known."));
    return;
  }
  const loop = await loopChoice("learn", signal);
  const chosen = []; // { upload, point, box, said }
  const listed = h("div", {});
  const columns = h("div", {});
  const said = h("div", { role: "status", class: "working" });
  const result = h("div", {});
  const look = h("button", { type: "button" }, "Inspect them");
  const learn = h("button", { type: "button", class: "first" }, "Learn");
  let mapped = null;

  const add = (one) => {
    if (chosen.some((each) => each.upload.id === one.id)) return;
    const entry = { upload: one, point: h("input", { size: "10", "aria-label": `Operating point of ${one.name}`, placeholder: "all" }), box: h("input", { type: "checkbox", checked: true, "aria-label": `Use ${one.name}` }), said: h("div", {}, h("small", {}, "not inspected")) };
    entry.box.addEventListener("change", enable);
    chosen.push(entry);
    history.replaceState(null, "", `/learn?${new URLSearchParams(chosen.map((each) => ["upload", each.upload.id]))}`);
    listed.replaceChildren(table("Recordings to learn from", ["Recording", "Use", "*Rows", "Operating point", "Quality"], chosen.map((each) => [each.upload.name, each.box, count(each.upload.rows), each.point, each.said])));
    if (!mapped) {
      mapped = mapping(one);
      mapped.suit(loop.columns());
      columns.replaceChildren(h("h3", {}, "What is what, in all of them"), preview(one), mapped.element);
      kept(one.id, mapped.element);
    }
    enable();
  };
  loop.changed(() => mapped?.suit(loop.columns()));
  const used = () => chosen.filter((each) => each.box.checked);
  function enable() {
    learn.disabled = look.disabled = !used().length;
  }
  enable();

  look.addEventListener("click", () =>
    during(look, said, async () => {
      for (const each of used()) {
        tell(said, `Inspecting ${each.upload.name} …`);
        const units = loop.units();
        const found = await job("/inspections", { upload: each.upload.id, columns: mapped.read(), loop: loop.read() }, { signal });
        judged(each, found.inspection, () => {
          const shown = inspected(found, units, signal);
          result.replaceChildren(section(each.upload.name, null, shown.element));
          shown.draw();
        });
      }
    }, enable),
  );
  learn.addEventListener("click", () =>
    during(learn, said, async (step) => {
      const recordings = used().map((each) => ({ upload: each.upload.id, ...(each.point.value.trim() && { point: each.point.value.trim() }) }));
      const found = await job("/learnings", { loop: loop.read(), recordings, columns: mapped.read(), population: [...machines.chosen] }, { signal, step });
      for (const one of found.recordings) judged(chosen.find((each) => each.upload.id === one.upload), one.inspection);
      result.replaceChildren(learned(found, refresh));
      result.scrollIntoView({ block: "start" });
    }, enable),
  );
  work.append(
    section("Loop", ["What is known of it: sampling, plant, controller. A baseline has it inside. Without a loop file ", h("a", { href: "/begin" }, "begin with a log"), "."], loop.element),
    section("Healthy recordings", "Take several days and temperatures: then the baseline includes their scatter.", dropzone("Drop healthy recordings here", add, signal, { several: true, examples: ["monday", "tuesday"], prepare: async (step) => loop.take(await exampleLoop(step, signal)) }), (await earlier(add, signal)) ?? "", listed, columns, machines.element, h("div", { class: "actions" }, learn, look, said)),
    result,
  );
  for (const id of values.getAll("upload")) await get(`/uploads/${part(id)}`, signal).then(add, () => {}); // those that are still there
}

function judged(each, inspection, open = null) {
  if (!each) return;
  const kind = KINDS[inspection.verdict];
  const words = h("span", { class: `badge ${kind}`, title: inspection.summary }, mark(kind), inspection.verdict);
  each.said.replaceChildren(words, open ? h("button", { type: "button", class: "quiet", onclick: open }, "show") : findings({ findings: inspection.findings.filter((one) => one.severity !== "note") }));
}

function learned(found, refresh) {
  const points = found.summary.points ? Object.entries(found.summary.points) : [["", found.summary]];
  const name = h("input", { required: true, pattern: "[\\w][\\w.:\\-]*", title: "letters, digits, . : - _", value: (found.summary.loop ?? "").replace(/[^\w.-]+/g, "-"), oninput: () => (button.disabled = false) });
  const button = h("button", { class: "first" }, "Save");
  const [said, link] = [h("div", { role: "status", class: "working" }), h("div", {})];
  const save = async (event) => {
    event.preventDefault();
    try {
      const made = await post("/baselines", { name: name.value, learning: found.learning });
      said.replaceChildren();
      button.disabled = true; // the name is taken now, by this
      const words = [translate(`Saved as ${made.name}: `), h("a", { href: `/diagnose?baseline=${part(made.id)}` }, "diagnose a recording with it")];
      await refresh().finally(() => link.replaceChildren(...words)); // saved it is, even if the list cannot be fetched
    } catch (error) {
      said.replaceChildren(complaint(error));
    }
  };
  return section(
    "What was learned",
    null,
    points.map(([point, summary]) => [point && h("h3", {}, `Operating point ${point}`), told(summary)]),
    h("form", { class: "actions", onsubmit: save }, field("Save as", name), button, link, said),
  );
}

function told(summary) {
  const promises = (summary.promises ?? []).map((one) => [plain(one.name), h("span", {}, prose(one.parameter)), one.change === null ? "never" : change(1 + one.change)]);
  const values = Object.entries(summary.parameters ?? {}).map(([name, one]) => [h("span", {}, prose(name)), ...withStd(one.value, one.std)]);
  return h(
    "div",
    {},
    h("p", {}, prose(`Explains ${number(100 * summary.explained, 4)} % of the input; threshold of T² ${number(summary.threshold, 4)}, for ${general(summary.false_alarms_per_year)} false alarm${summary.false_alarms_per_year === 1 ? "" : "s"} a year.`)),
    h(
      "div",
      { class: "columns" },
      promises.length > 0 && h("div", { class: "half" }, h("h3", {}, "The smallest change that it detects"), table("Promises", ["Fault", "Parameter", "*Seen from"], promises)),
      values.length > 0 && h("div", { class: "half" }, h("h3", {}, "Coefficients, in units of u per derivative of y [s]"), table("Learned coefficients", ["Name", "*Value", "*Standard deviation"], values)),
    ),
    (summary.notes ?? []).length > 0 && h("ul", { class: "why" }, summary.notes.map((words) => h("li", {}, prose(typeof words === "string" ? words : (words.message ?? ""))))),
  );
}

/** The choice of like machines: what is open and chosen stays so when the list is fetched again. */
function likes() {
  const chosen = new Set();
  const listed = h("div", {});
  const box = (one) => h("input", { type: "checkbox", checked: chosen.has(one.id), "aria-label": `Use ${one.name}`, onchange: (event) => chosen[event.target.checked ? "add" : "delete"](one.id) });
  const element = h(
    "details",
    { hidden: true },
    h("summary", {}, "A new machine among like ones"),
    h("p", { class: "note" }, "Choose the baselines of five or more like machines: they are a prior, which its own recordings refine."),
    listed,
  );
  const list = (all) => {
    element.hidden = all.length < FEWEST;
    listed.replaceChildren(table("Like machines", ["Use", "Name", "Loop"], all.map((one) => [box(one), one.name, one.loop])));
  };
  return { element, chosen, list };
}

function baselines(all) {
  if (!all.length) return h("p", { class: "empty" }, "No baseline yet.");
  return table(
    "Baselines that are known",
    ["Name", "Loop", "Of", "Assets", "*Recordings", "*Length", "Since", ""],
    all.map((one) => [
      one.name,
      one.loop,
      one.origin === "service" ? "the service" : (one.who ?? "saved"),
      one.assets.join(", ") || DASH,
      String(one.recordings),
      duration(one.duration_s),
      one.at ? moment(one.at, { seconds: false }) : DASH,
      h("span", {}, h("a", { href: `/diagnose?baseline=${part(one.id)}` }, "diagnose"), ", ", h("a", { href: `/design?baseline=${part(one.id)}` }, "study"), ", ", h("a", { href: `/api/v1/baselines/${part(one.id)}/file`, download: true, "aria-label": `Download ${one.name}` }, "download")),
    ]),
  );
}
