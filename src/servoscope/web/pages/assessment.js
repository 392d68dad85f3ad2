// What `assess` finds in one log without a baseline: the likeliest cause, why, what to do, and the probability of each.
import { h, table, translate } from "./dom.js";
import { mark, prose } from "./marks.js";
import { capital, number } from "./words.js";

export function assessed(said) {
  const kind = said.verdict === "good" ? "healthy" : said.verdict === "cannot tell" ? "undetermined" : "fault";
  const sizes = [
    ["Apparent stiction", said.stiction_percent, "% of travel"],
    ["Apparent backlash", said.backlash_percent, "% of travel"],
    ["Period", said.regularity > 1 ? said.period_s : null, "s"],
    ["Gain margin as seen", said.gain_margin, ""],
    ["Harris index", said.performance, ""],
  ].filter(([, value]) => value !== null);
  const causes = Object.entries(said.probabilities).filter(([, p]) => p >= 0.005).sort((a, b) => b[1] - a[1]);
  return h(
    "div",
    {},
    h("p", { class: `badge ${kind}` }, mark(kind), h("b", {}, capital(translate(said.verdict))), ` ${number(said.probability, 2)}`),
    h("p", {}, prose(said.reason)),
    h("h3", {}, "What to do"),
    h("p", {}, said.advice),
    causes.length > 0 && table("Causes", ["Cause", "*Probability"], causes.map(([name, p]) => [capital(translate(name)), number(p, 2)])),
    sizes.length > 0 && table("Sizes", ["Quantity", "*Value"], sizes.map(([name, value, unit]) => [name, `${number(value, 2)} ${unit}`])),
  );
}
