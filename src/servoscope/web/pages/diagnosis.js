// One diagnosis at its permanent address: verdict, grounds, candidates, pictures, numbers; it prints on paper.
import { get, part, query } from "./api.js";
import { drawnArm } from "./arm.js";
import { plot } from "./charts.js";
import { coefficient, showsChange, signals, signature, tests } from "./curves.js";
import { details, evidence, experts, verdict } from "./document.js";
import { h } from "./dom.js";
import { prose, VERDICTS } from "./marks.js";
import { planes } from "./planes.js";
import { moment } from "./words.js";

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
  const draw = () => drawn.splice(0).forEach((one) => one());
  const pictures = picturesOf(found, said, picture, drawn, signal);
  const folded = experts(() => details(found.sections, pictures), draw);
  const where = found.asset ? h("a", { href: `/assets/${part(found.asset)}` }, found.asset) : name;
  main.replaceChildren(...[
    h(
      "div",
      { class: "head" },
      h("h1", {}, "Diagnosis of ", where),
      h("span", { class: "note" }, [moment(found.t), found.grounds, found.who && `by ${found.who}`].filter(Boolean).join(", ")),
      h("span", { class: "gap" }),
      h("div", { class: "actions" }, found.asset && h("a", { class: "button", href: query("/alarms", { asset: found.asset }) }, "Its alarms"), again && h("a", { class: "button", href: again }, "Diagnose again"), h("button", { type: "button", onclick: () => print() }, "Print"), found.report && h("a", { class: "button", href: found.report, target: "_blank", rel: "noopener" }, "Report as one file")),
    ),
    found.sections.length ? verdict(found.verdict, found.sections) : h("p", { class: "summary" }, prose(found.summary)),
    ...evidence(found.sections, pictures),
    found.sections.some((one) => one.level === 2) && folded,
    h("p", { class: "note" }, [`Permanent address: ${location.origin}${location.pathname}`, found.baseline && `baseline ${found.baseline.name}, ${found.baseline.hash}`, said.point && `operating point ${said.point}`].filter(Boolean).join("; ")),
  ].filter(Boolean));
  draw();
}

// What this page can draw, by its name in the document.
function picturesOf(found, said, picture, drawn, signal) {
  const { trace } = found;
  const units = found.units ?? {};
  const marks = said.onset_s ? [[said.onset_s[1], "onset"]] : [];
  const made = {};
  if (found.arm) made.arm = () => drawnArm(found.arm);
  if (found.signals) made.signals = () => picture("Reference, output and input", (c) => signals(c, { ...found.signals, units, marks }), "plot tall");
  if (trace) made.statistic = () => picture("Both tests over time, as multiples of their limits", (c) => tests(c, { ...trace, marks, clock: false, range: [trace.t[0], trace.t.at(-1)] }));
  const changed = showsChange(found.signature ?? []);
  if (found.verdict === "fault" && changed) made.change = () => picture("Mean input for the same motion, before and after", (c) => signature(c, { curves: found.signature, units }));
  else if (found.verdict === "fault" && trace?.parameters?.length) {
    const one = farthest(trace.parameters);
    made.change = () => picture(`Deviation of ${one.name}, which moved most`, (c) => coefficient(c, { t: trace.t, one }));
  }
  if (found.signature?.length && !(changed && found.verdict === "fault")) made.signature = () => picture("Mean input over position and speed", (c) => signature(c, { curves: found.signature, units }));
  if (said.ifrf?.length) {
    made.ifrf = () => {
      const plane = planes(said.ifrf.map(response), units.response ?? "", signal);
      if (trace) plane.trails(trace.responses, trace.t);
      drawn.push(() => plane.start(said.onset_s ? said.onset_s[1] : null));
      return plane.element;
    };
  }
  if (trace?.parameters?.length) {
    made.coefficients = () => h("div", { class: "planes" }, trace.parameters.map((one) => h("div", {}, h("h3", {}, prose(one.name)), picture(`Deviation of ${one.name} over time`, (c) => coefficient(c, { t: trace.t, one })))));
  }
  return made;
}

// The coefficient that is farthest from healthy at the end, in standard deviations.
function farthest(parameters) {
  const distance = ({ value, nominal, std }) => {
    const last = value.findLastIndex((each, i) => each !== null && std[i]);
    return last < 0 ? 0 : Math.abs(value[last] - nominal[last]) / std[last];
  };
  return parameters.reduce((best, one) => (distance(one) > distance(best) ? one : best));
}

const response = (one) => ({ ...one, ellipse: [2 * one.real_std, 2 * one.imag_std, 0] });
