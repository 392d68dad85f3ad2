// Two periods of an asset side by side: sizes and coefficients in each, and both tests.
import { get, query } from "./api.js";
import { plot } from "./charts.js";
import { tests } from "./curves.js";
import { during, field, h, section, table } from "./dom.js";
import { DASH, moment, number, plain, signed } from "./words.js";

const NAMES = ["First period", "Second period"];
const KEYS = ["first", "second"]; // in the address: from,to [UTC s]
const POINTS = 500;

export function periods(path, asset, values, signal) {
  const ends = KEYS.map(() => ["from", "to"].map(() => h("input", { type: "datetime-local", required: true, step: "1" })));
  const said = h("p", { class: "working", role: "status" });
  const result = h("div", { class: "columns" });
  const button = h("button", {}, "Compare");
  const submit = (event) => {
    event.preventDefault();
    return during(button, said, compare);
  };
  const fields = ends.flatMap((pair, i) => pair.map((input, k) => field(`${NAMES[i]}, ${k ? "to" : "from"}`, input)));
  const form = h("form", { class: "screen", onsubmit: submit }, h("div", { class: "fields" }, fields), h("div", { class: "actions" }, button), said);
  const element = section("Two periods side by side", "What sizes, coefficients and tests were in one period, and in another one.", form, result);
  const span = (i) => ends[i].map((input) => new Date(input.value).getTime() / 1000);

  // What the address says; else what was before the fault, or the first half, and what came after it.
  function start() {
    const { onset, counted, t } = asset();
    const middle = onset > counted.began ? onset : (counted.began + t) / 2;
    const usual = [[counted.began, middle], [middle, t]];
    ends.forEach((pair, i) => pair.forEach((input, k) => (input.value = moment((values.get(KEYS[i])?.split(",").map(Number) ?? usual[i])[k]).replace(" ", "T"))));
    if (values.has(KEYS[0])) during(button, said, compare);
    else if (onset > counted.began) during(button, said, show); // before the fault, and since
  }

  async function compare() {
    const told = new URLSearchParams(location.search);
    KEYS.forEach((key, i) => told.set(key, span(i).join()));
    history.replaceState(null, "", `${location.pathname}?${told}`);
    await show();
  }

  async function show() {
    const found = await Promise.all(KEYS.map((_, i) => fetched(span(i))));
    const charts = found.map((one, i) => ({ words: NAMES[i], element: h("div", { class: "plot" }), history: one.history }));
    result.replaceChildren(beside(found), ...charts.map(({ words, element }) => h("div", { class: "half" }, h("h3", {}, words), element)));
    charts.forEach(({ words, element, history }, i) => plot(element, `Both tests, ${words.toLowerCase()}`, (c) => tests(c, { ...history, range: span(i) }), signal));
  }

  async function fetched([from, to]) {
    const [faults, coefficients, past] = await Promise.all([
      ...["faults", "coefficients"].map((of) => get(query(`${path}/sizes`, { of, from, to, points: POINTS }), signal)),
      get(query(`${path}/history`, { from, to, points: POINTS }), signal),
    ]);
    const curves = [...faults.curves, ...coefficients.curves];
    const named = [...new Set(curves.map((one) => one.name))];
    return { history: past, means: new Map(named.map((name) => [name, mean(curves.filter((one) => one.name === name))])) };
  }

  return { element, start };
}

// Mean value and interval of all curves of one name. The errors of its values may be the same, so it is as unsure as they are.
function mean(curves) {
  const of = (key) => curves.flatMap((one) => one[key]);
  const [value, low, high] = ["value", "low", "high"].map((key) => of(key).reduce((sum, each) => sum + each, 0) / of(key).length);
  return { value, low, high };
}

function beside([first, second]) {
  const names = [...new Set([...first.means.keys(), ...second.means.keys()])];
  if (!names.length) return h("p", { class: "empty" }, "No sizes were stored in these periods.");
  const told = (one) => (one ? `${number(one.value, 4)} (${number(one.low, 4)} to ${number(one.high, 4)})` : DASH);
  const changed = (a, b) => (a && b && a.value ? `${signed((100 * (b.value - a.value)) / Math.abs(a.value), 3)} %` : DASH);
  const apart = (a, b) => (a && b ? (b.low > a.high || b.high < a.low ? "yes" : "no") : DASH);
  return table(
    "Two periods side by side",
    ["What", "*First period (95 %)", "*Second period (95 %)", "*Change", "Intervals apart"],
    names.map((name) => [plain(name), ...[first, second].map((one) => told(one.means.get(name))), changed(first.means.get(name), second.means.get(name)), apart(first.means.get(name), second.means.get(name))]),
  );
}
