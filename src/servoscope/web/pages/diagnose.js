// A recording from a file to its verdict: drop it, see what is in it, say which column is what, compare it with a baseline.
import { get, job, mayChange, part, query } from "./api.js";
import { assessed } from "./assessment.js";
import { list } from "./events_list.js";
import { during, field, h, section } from "./dom.js";
import { inspected } from "./inspection.js";
import { kept } from "./kept.js";
import { dropzone, earlier, exampleBaseline, mapping, preview } from "./uploads.js";

const EXAMPLE = "example-axis"; // name of the baseline

export async function show(main, { session, signal, values }) {
  const past = h("div", {});
  const work = h("div", { class: "steps" });
  main.replaceChildren(h("div", { class: "head" }, h("h1", {}, "Diagnose a recording")), work, section("Diagnoses of recordings", null, past));
  const { diagnoses } = await get("/diagnoses?grounds=upload&last=20", signal);
  past.replaceChildren(list(diagnoses));
  if (!mayChange(session.role, "operator")) {
    work.replaceChildren(h("p", { class: "note" }, "Uploading a recording is for operators and engineers; you can look at what they found."));
    return;
  }
  let { baselines } = await get("/baselines", signal);
  const chosen = h("div", { class: "steps" });
  let wanted = values.get("baseline");
  const open = (one) => chosen.replaceChildren(...steps(one, baselines, wanted, signal));
  // The example's baseline is learned once, by somebody who may.
  const prepare = async (step) => {
    if (!baselines.some((one) => one.id === EXAMPLE) && mayChange(session.role, "engineer")) {
      await exampleBaseline(EXAMPLE, step, signal);
      ({ baselines } = await get("/baselines", signal));
    }
    wanted = EXAMPLE;
  };
  work.append(section("Recording", null, dropzone("Drop a recording here", open, signal, { begun: () => chosen.replaceChildren(), examples: ["friday"], prepare }), (await earlier(open, signal)) ?? ""), chosen);
  const known = values.get("upload");
  if (known) open(await get(`/uploads/${part(known)}`, signal));
}

function steps(one, baselines, wanted, signal) {
  const columns = mapping(one);
  const baseline = h("select", { name: "baseline" }, baselines.map((each) => h("option", { value: each.id, selected: each.id === wanted }, `${each.name} (${each.loop})`)));
  const point = h("select", { name: "point" });
  const pointed = field("Operating point", point);
  const [from, to] = ["from_s", "to_s"].map((name) => h("input", { type: "number", step: "any", name, placeholder: name === "from_s" ? "beginning" : "end" }));
  const said = h("div", { role: "status", class: "working" });
  const result = h("div", {});
  const look = h("button", { type: "button" }, "Inspect");
  const assess = h("button", { type: "button" }, "Assess without a baseline");
  const diagnose = h("button", { type: "button", class: "first", disabled: !baselines.length }, "Diagnose");

  const repoint = () => {
    const { points = [], columns: known = null } = baselines.find((each) => each.id === baseline.value) ?? {};
    columns.suit(known);
    point.replaceChildren(...points.map((name) => h("option", {}, name)));
    pointed.hidden = !points.length;
    history.replaceState(null, "", query("/diagnose", { upload: one.id, baseline: baseline.value })); // a reload, or the way back, finds it again
  };
  baseline.addEventListener("change", repoint);
  repoint();

  const part = () => ({ upload: one.id, columns: columns.read(), ...(from.value && { from_s: Number(from.value) }), ...(to.value && { to_s: Number(to.value) }) });
  const inspect = (step) =>
    job("/inspections", { ...part(), ...(baseline.value && { loop: { baseline: baseline.value } }) }, { signal, step }).then((found) => {
      const shown = inspected(found, baselines.find((each) => each.id === baseline.value)?.units, signal);
      result.replaceChildren(section("Is it usable?", null, shown.element));
      shown.draw();
    });
  look.addEventListener("click", () => during(look, said, inspect));
  assess.addEventListener("click", () =>
    during(assess, said, async (step) => {
      const { assessment } = await job("/assessments", part(), { signal, step });
      result.replaceChildren(section("What is wrong, without a baseline", null, assessed(assessment)));
    }),
  );
  diagnose.addEventListener("click", () =>
    during(diagnose, said, async (step) => {
      const { diagnosis } = await job("/diagnoses", { ...part(), baseline: baseline.value, ...(point.value && { point: point.value }) }, { signal, step });
      location.assign(`/diagnoses/${encodeURIComponent(diagnosis)}`);
    }),
  );
  const asked = section(
    "What is what",
    null,
    preview(one),
    columns.element,
    h("div", { class: "fields" }, baselines.length ? field("Compare with the baseline", baseline) : h("p", { class: "complaint" }, "There is no baseline yet: ", h("a", { href: `/begin?upload=${encodeURIComponent(one.id)}` }, "begin with a log of the healthy machine"), "."), pointed, field("From [s]", from), field("To [s]", to)),
    h("div", { class: "actions" }, diagnose, look, assess, said),
  );
  kept(one.id, asked);
  if (columns.read().input && columns.read().output) during(look, said, inspect);
  return [asked, result];
}
