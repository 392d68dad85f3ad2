// What has happened to an asset, in one list: steps of its alarms, diagnoses, and what people noted.
import { part } from "./api.js";
import { STATES } from "./commands.js";
import { h, table, translate } from "./dom.js";
import { badge, prose, VERDICTS } from "./marks.js";
import { DASH, moment, plain } from "./words.js";

const LISTED = 40;

// The newest first; what was said just before is not said once more.
export function events(transitions, diagnoses, notes) {
  const all = [
    ...transitions.map((one) => ({ t: one.t, what: [`${translate(plain(one.alarm))}: `, `${STATES[one.before]} → ${STATES[one.after]}`], words: one.cause, who: one.who })),
    ...diagnoses.map((one) => ({ t: one.t, link: `/diagnoses/${part(one.id)}`, what: badge(one.verdict, VERDICTS[one.verdict]), words: one.summary, who: one.grounds === "full" ? "full diagnosis" : one.grounds })),
    ...notes.map((one) => ({ t: one.t, what: "Note", words: one.text, who: one.who })),
  ].sort((a, b) => a.t - b.t);
  if (!all.length) return h("p", { class: "empty" }, "Nothing has happened yet.");
  let said = "";
  for (const one of all) {
    one.shown = one.words && one.words !== said ? prose(one.words) : DASH;
    said = one.words || said;
  }
  const when = (one) => (one.link ? h("a", { class: "t", href: one.link }, moment(one.t)) : h("span", { class: "t" }, moment(one.t)));
  return table(
    "Events, the newest first",
    ["When", "What", "In words", "Who"],
    all.slice(-LISTED).reverse().map((one) => [when(one), one.what, one.shown, one.who || DASH]),
  );
}

export function list(diagnoses) {
  if (!diagnoses.length) return h("p", { class: "empty" }, "No diagnosis yet.");
  return table(
    "Diagnoses, the newest first",
    ["When", "Verdict", "Grounds", "In words"],
    [...diagnoses].reverse().map((one) => [h("a", { class: "t", href: `/diagnoses/${part(one.id)}` }, moment(one.t)), badge(one.verdict, VERDICTS[one.verdict]), one.recording ?? one.grounds, prose(one.summary)]),
  );
}
