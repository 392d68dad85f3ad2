// One diagnosis at its permanent address: verdict, grounds, candidates, pictures, numbers; it prints on paper.
import { get, part, query } from "./api.js";
import { plot } from "./charts.js";
import { coefficient, signals, signature, tests } from "./curves.js";
import { h, section, table } from "./dom.js";
import { mark, prose, VERDICTS } from "./marks.js";
import { parameters } from "./parameters.js";
import { planes } from "./planes.js";
import { capital, DASH, moment, number, plain, probability, size } from "./words.js";

export async function show(main, { signal, part: id, entitle }) {
  const found = await get(`/diagnoses/${part(id)}`, signal);
  const said = found.document ?? {};
  const name = found.recording ?? found.asset ?? id;
  entitle(`${VERDICTS[found.verdict]}: ${name}`);
  const again = found.upload && query("/diagnose", { upload: found.upload, baseline: found.baseline.id });
  const drawn = [];
  // A picture is drawn once its element has its place, and so its size.
  const picture = (label, describe, kind = "plot") => {
    const element = h("div", { class: kind });
    drawn.push(() => plot(element, label, describe, signal));
    return element;
  };
  const where = found.asset ? h("a", { href: `/assets/${part(found.asset)}` }, found.asset) : name;
  main.replaceChildren(
    h(
      "div",
      { class: "head" },
      h("h1", {}, "Diagnosis of ", where),
      h("span", { class: "note" }, [moment(found.t), found.grounds, found.who && `by ${found.who}`].filter(Boolean).join(", ")),
      h("span", { class: "gap" }),
      h("div", { class: "actions" }, again && h("a", { class: "button", href: again }, "Diagnose again"), h("button", { type: "button", onclick: () => print() }, "Print"), found.report && h("a", { class: "button", href: found.report, target: "_blank", rel: "noopener" }, "Report as one file")),
    ),
    verdict(found, said),
    ...sections(found, said, picture, drawn, signal),
    h("p", { class: "note" }, [`Permanent address: ${location.origin}${location.pathname}`, found.baseline && `baseline ${found.baseline.name}, ${found.baseline.hash}`, said.point && `operating point ${said.point}`].filter(Boolean).join("; ")),
  );
  drawn.forEach((draw) => draw());
}

function verdict(found, said) {
  const facts = [];
  const at = (t) => (found.began ? moment(found.began + t, { fraction: 2 }) : `${number(t, 4)} s`);
  const carried = found.began && found.onset !== null && found.onset < found.began; // an earlier window has seen it
  if (said.onset_s && (carried || /or before/.test(found.summary))) facts.push(["Since when", carried ? moment(found.onset, { fraction: 2 }) : `${at(0)} or before`, carried ? "as an earlier diagnosis has it" : "it was there from the beginning"]);
  else if (said.onset_s) facts.push(["Since when", at(said.onset_s[1]), `95 %: ${at(said.onset_s[0])} to ${at(said.onset_s[2])}`]);
  else if (found.onset) facts.push(["Since about", moment(found.onset), "as the tests tell it"]);
  for (const fault of said.faults ?? []) {
    const [value, low, high] = size(fault);
    facts.push(["How large", prose(`${fault.parameter} ${value}`), `95 %: ${low} to ${high}`]);
  }
  if (said.probability) facts.push(["How sure", probability(said.probability), said.faults.length ? "among the faults that this plant knows" : `for ${said.candidates[0]?.name ?? "it"}`]);
  if (said.detected_at_s !== null && said.detected_at_s !== undefined) facts.push(["Detected at", at(said.detected_at_s), "first evaluation above a limit"]);
  if (said.duration_s) facts.push(["Watched", `${number(said.duration_s, 4)} s`, `${said.samples} samples`]);
  const names = (said.faults ?? []).map((fault) => (found.words?.[fault.name] ?? plain(fault.name)).replace(/ \(.*/, ""));
  const headline = { healthy: "No change from the healthy baseline", undetermined: "This recording cannot tell" }[found.verdict];
  return h(
    "div",
    { class: `verdict ${found.verdict}`, role: "region", "aria-label": "Verdict" },
    h("p", { class: "kind" }, mark(found.verdict), VERDICTS[found.verdict]),
    h("h2", {}, headline ?? (names.length ? capital(names.join(" and ")) : "The actuator has changed")),
    h("p", { class: "summary" }, prose(found.summary)),
    facts.length > 0 && h("dl", { class: "facts" }, facts.map(([key, value, more]) => h("div", {}, h("dt", {}, key), h("dd", {}, h("b", {}, value), h("small", {}, more))))),
  );
}

function sections(found, said, picture, drawn, signal) {
  const { trace } = found;
  const units = found.units ?? {};
  const marks = said.onset_s ? [[said.onset_s[1], "onset"]] : [];
  const made = [];
  const counted = found.began ? `Seconds count from ${moment(found.began, { fraction: 2 })}, where the window begins.` : null;
  if (said.explanation?.length) made.push(section("Why", counted, h("ul", { class: "why" }, said.explanation.map((words) => h("li", {}, prose(words))))));
  if (said.candidates?.length) made.push(section("Candidates", "What could explain the change, how large each explanation would have to be, how probable it is.", candidates(found, said)));
  if (said.refit?.mimics?.length) made.push(section("What else it could be", null, mimics(said)));
  if (trace) {
    made.push(section("Change over time", "Above the dashed line, chance is no longer an explanation.", picture("Both tests over time, as multiples of their limits", (c) => tests(c, { ...trace, marks, clock: false, range: [trace.t[0], trace.t.at(-1)] }))));
  }
  if (found.signals) made.push(section("Signals", null, picture("Reference, output and input", (c) => signals(c, { ...found.signals, units, marks }), "plot tall")));
  if (found.signature?.length) made.push(section("Motion signature", "Mean input over position, forward (solid) and backward (dashed), and over speed: the gap between the two directions is friction.", picture("Mean input over position and speed", (c) => signature(c, { curves: found.signature, units }))));
  if (said.ifrf?.length) {
    const plane = planes(said.ifrf.map(response), units.response ?? "", signal);
    if (trace) plane.trails(trace.responses, trace.t);
    drawn.push(() => plane.start(said.onset_s ? said.onset_s[1] : null));
    made.push(section("Inverse frequency response", "Input per unit of output, as a complex number: the diamond is healthy, the dot is the estimate, its ellipse two standard deviations each way.", plane.element));
  }
  if (trace?.parameters?.length) {
    const panels = trace.parameters.map((one) => h("div", {}, h("h3", {}, prose(one.name)), picture(`Deviation of ${one.name} over time`, (c) => coefficient(c, { t: trace.t, one }))));
    made.push(section("Coefficients over time", "Deviation from what a healthy loop would show under the same reference, with two standard deviations.", h("div", { class: "planes" }, panels)));
  }
  const names = Object.entries(said.parameters ?? {});
  if (names.length) {
    const rows = names.map(([name, one], i) => ({ name, ...one, low: one.value - 1.96 * one.std, high: one.value + 1.96 * one.std, unit: found.coefficient_units[i] ?? "" }));
    made.push(section("Coefficients at the end", null, parameters(rows).element));
  }
  if (said.warnings?.length) {
    const rows = said.warnings.map((one) => [plain(one.kind), `${number(one.from_s, 4)} to ${number(one.to_s, 4)}`, String(one.count), h("span", {}, prose(one.message))]);
    made.push(section("Warnings", null, table("Defects and doubts", ["Kind", "*When [s]", "*Count", "In words"], rows)));
  }
  return made;
}

const response = (one) => ({ ...one, ellipse: [2 * one.real_std, 2 * one.imag_std, 0] });

export function mimics(said) {
  const rows = said.refit.mimics.map((one) => [h("span", {}, prose(one.name)), one.words, one.unit === "ratio" ? `× ${number(one.value, 4)}` : `${number(one.value, 3)} ${one.unit}`]);
  return table("Causes outside the list of faults", ["Cause", "In words", "*Size"], rows);
}

export function candidates(found, said) {
  const rows = said.candidates.map((one) => {
    const sizes = one.faults.map((fault) => [fault, size(fault)]);
    const bar = h("i");
    bar.style.width = `${(100 * one.probability).toFixed(1)}%`;
    return [
      h("span", {}, plain(one.name)),
      sizes.length ? h("span", {}, sizes.map(([fault, [value]], i) => [i > 0 && h("br"), ...prose(`${fault.parameter} ${value}`)])) : DASH,
      sizes.length ? h("span", {}, sizes.map(([, [, low, high]], i) => [i > 0 && h("br"), `${low} to ${high}`])) : DASH,
      one.misfit === null || one.misfit === undefined ? DASH : `${number(Math.sqrt(Math.max(one.misfit, 0)), 3)} σ`,
      h("span", {}, h("span", { class: "share", "aria-hidden": "true" }, bar), probability(one.probability)),
    ];
  });
  const made = table("Candidates, the most probable first", ["Explanation", "*Size", "*95 % interval", "*Fits worse by", "Probability"], rows);
  made.classList.add(found.verdict);
  made.querySelector("tbody tr")?.classList.add("first");
  return made;
}
