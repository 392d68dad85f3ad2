// What `inspect` finds in a recording: usable or not and why, its signals, how well each frequency is excited.
import { plot, axis, legend, line, tooltip } from "./charts.js";
import { short, signals } from "./curves.js";
import { h, table } from "./dom.js";
import { mark, prose } from "./marks.js";
import { capital, DASH, general, number } from "./words.js";

const VERDICTS = { usable: "healthy", "usable with care": "care", "not usable": "stop" };

// `found` is the result of an inspection; `draw` is called once its element is in the page.
export function inspected(found, units, signal) {
  const said = found.inspection;
  const [curves, spectrum] = [h("div", { class: "plot tall" }), h("div", { class: "plot" })];
  const percent = (value) => (value === null || value === undefined ? DASH : `${number(100 * value, 2)} %`);
  const element = h(
    "div",
    {},
    h("p", { class: `badge ${VERDICTS[said.verdict]}` }, mark(VERDICTS[said.verdict]), h("b", {}, capital(said.verdict))),
    !said.summary.endsWith(`: ${said.verdict}`) && h("p", {}, prose(said.summary)), // else the same once more
    findings(said),
    said.recommendations.length > 0 && [h("h3", {}, "What to do"), h("ul", { class: "why" }, said.recommendations.map((words) => h("li", {}, prose(words))))],
    found.signals && curves,
    said.frequencies.length > 0 && [
      h("h3", {}, "Excitation"),
      table(
        "How well each monitored frequency is excited",
        ["Frequency", "*Coherence r → u", "*Coherence r → y", "*Signal to noise", "*Spread of the response, whole recording", "*within the memory"],
        said.frequencies.map((one) => [`${general(one.frequency_hz)} Hz`, number(one.coherence_u, 3), number(one.coherence_y, 3), number(one.snr, 3), percent(one.relative_std), percent(one.relative_std_memory)]),
      ),
    ],
    found.spectra && spectrum,
  );
  const draw = () => {
    if (found.signals) plot(curves, "Reference, output and input of the recording", (c) => signals(c, { ...found.signals, units }), signal);
    if (found.spectra) plot(spectrum, "Coherence of u and y with the reference over frequency", (c) => coherence(c, found.spectra), signal);
  };
  return { element, draw };
}

export function findings(said) {
  const words = { stop: "stops: ", care: "care: ", note: "" };
  return h("ul", { class: "findings" }, said.findings.map((one) => h("li", { class: one.severity === "note" ? "note" : one.severity }, mark(one.severity), h("span", {}, h("span", { class: "hidden" }, words[one.severity]), prose(one.message)))));
}

function coherence(c, { frequency_hz: f, coherence_u: u, coherence_y: y }) {
  const pairs = (values) => f.map((at, i) => [at, values[i]]).filter(([at]) => at > 0);
  return {
    grid: { left: 62, right: 14, top: 30, bottom: 40 },
    legend: legend(c, ["r → u", "r → y"]),
    tooltip: tooltip(c, { formatter: (points) => [`${number(points[0].value[0], 3)} Hz`, ...points.map((one) => `${one.seriesName} ${number(one.value[1], 3)}`)].join("\n") }),
    xAxis: axis(c, "frequency [Hz]", { type: "log", max: f.at(-1), label: { formatter: short, showMaxLabel: false } }),
    yAxis: axis(c, "coherence", { type: "value", min: 0, max: 1, gap: 40 }),
    series: [line("r → u", pairs(u), c.healthy), line("r → y", pairs(y), c.measured)],
  };
}
