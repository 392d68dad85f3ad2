// What `assess` measures in one log without a baseline: the verdict, why, what to do, and each fact.
import { h, table, translate } from "./dom.js";
import { mark, prose } from "./marks.js";
import { capital, number } from "./words.js";

const KINDS = { "nothing conspicuous": "healthy", "cannot tell": "undetermined" };

export function assessed(said) {
  const kind = KINDS[said.verdict] ?? "fault";
  const rows = said.facts.map((fact) => [capital(translate(fact.name)), `${number(fact.value, 3)} ${fact.unit}`, fact.source]);
  return h(
    "div",
    {},
    h("p", { class: `badge ${kind}` }, mark(kind), h("b", {}, capital(translate(said.verdict)))),
    h("p", {}, prose(said.reason)),
    h("h3", {}, "What to do"),
    h("p", {}, said.advice),
    rows.length > 0 && table("Facts", ["Fact", "*Value", "Source"], rows),
  );
}
