// One asset: the verdict in words, where its inverse response is now, both tests, parameters, signals, alarms; live.
import { get, part, query } from "./api.js";
import { history as steps } from "./alarms.js";
import { plot } from "./charts.js";
import { commands, STATES } from "./commands.js";
import { signals as drawn, tests } from "./curves.js";
import { candidates, mimics } from "./diagnosis.js";
import { h, section, table, tell, titled } from "./dom.js";
import { growth } from "./growth.js";
import { follow } from "./live.js";
import { badge, mark, priority, prose, say, STATUS, VERDICTS } from "./marks.js";
import { parameters } from "./parameters.js";
import { planes } from "./planes.js";
import { capital, count, DASH, duration, moment, multiple, number, plain, size } from "./words.js";

const SPANS = { "1 h": 3600, "24 h": 86400, "7 d": 604800, "30 d": 2592000, "1 y": 31536000 };
const SIGNALS_S = 30;
const SIGNALS_EVERY_MS = 2000;
const POINTS = 500;

export async function show(main, { session, signal, linked, values, part: name, entitle }) {
  entitle(name);
  const path = `/assets/${part(name)}`;
  let asset = await get(path, signal);
  const units = asset.about.units ?? {};
  const verdict = verdictOf(name);
  const about = [asset.about.loop, asset.about.plant && `plant ${asset.about.plant}`, asset.about.point, asset.about.sample_rate_hz && `${asset.about.sample_rate_hz} Hz`].filter(Boolean).join(", ");
  const plane = planes(asset.responses, units.response ?? "", signal);
  const sizes = parameters(asset.parameters);
  const grown = growth(path, name, () => asset, { session, values, signal });
  const said = h("p", { class: "working", role: "status" });
  const [standing, past, diagnoses, counted] = [h("div", {}), h("div", {}), h("div", {}), h("p", { class: "note" })];
  const sure = h("div", {});
  const certainty = section("How sure, and what else it could be", null, sure);
  const statistic = h("div", { class: "plot tall" });
  const samples = h("div", { class: "plot tall" });
  const spans = Object.entries(SPANS).map(([words, seconds]) => h("button", { type: "button", class: "filter", "aria-pressed": "false", onclick: () => chosen(seconds) }, words));
  const baseline = asset.baseline && h("a", { href: `/design?baseline=${part(asset.baseline)}` }, "What this baseline can tell apart");

  main.replaceChildren(
    h("div", { class: "head" }, h("h1", {}, name), h("span", { class: "note" }, about), h("span", { class: "gap" }), baseline, h("button", { type: "button", class: "screen", onclick: () => print() }, "Print")),
    verdict.element,
    h(
      "div",
      { class: "columns" },
      grown.element,
      certainty,
      section("Inverse frequency response", "Input per unit of output, as a complex number: the diamond is healthy, the dot is now, its ellipse holds 95 %. Each panel has its own scales.", plane.element),
      half(titled("Distance from healthy", spans, statistic)),
      half(titled("Signals", h("small", {}, `the last ${SIGNALS_S} s`), samples)),
      half(section("Coefficients", "Against what a healthy loop would show under the same reference.", sizes.element)),
      half(section("Alarms", null, standing, said, past)),
      half(section("Diagnoses", null, diagnoses)),
      half(section("Stream", null, counted)),
    ),
  );

  // Live parts first: they need nothing but what is there already.
  plane.start(began(asset));
  let past24 = null;
  let span = SPANS["1 h"];
  const live = { t: [], statistic: [], level: [] };
  const both = plot(statistic, "Both tests over time, as multiples of their limits", (c) => tests(c, curves()), signal);
  let shown = { t: [], r: [], u: [], y: [] };
  const traces = plot(samples, "Reference, output and input of the last seconds", (c) => drawn(c, { ...relative(shown), units, name: "time before the last sample [s]" }), signal);

  function curves() {
    const cut = past24?.t.length ? past24.t.at(-1) : -Infinity;
    const from = live.t.findIndex((t) => t > cut);
    const rest = (values) => (from < 0 ? [] : values.slice(from));
    const marks = began(asset) === null ? [] : [[began(asset), "onset"]];
    const joined = (key) => [...(past24?.[key] ?? []), ...rest(live[key])];
    return { t: joined("t"), statistic: joined("statistic"), level: joined("level"), marks, range: [Math.max(asset.t - span, asset.counted.began), asset.t] };
  }

  async function chosen(seconds) {
    span = seconds;
    spans.forEach((button, i) => button.setAttribute("aria-pressed", String(Object.values(SPANS)[i] === seconds)));
    past24 = await get(query(`${path}/history`, { from: asset.t - seconds, points: POINTS }), signal);
    both.draw();
  }

  async function look() {
    const [alarms, found, advice] = await Promise.all([get(query(`${path}/alarms`, { last: 50 }), signal), get(query("/diagnoses", { asset: name, last: 20 }), signal), get("/alarms", signal)]);
    past.replaceChildren(steps(alarms.transitions, false));
    diagnoses.replaceChildren(list(found.diagnoses));
    verdict.advise(advice.alarms.find((one) => one.asset === name && one.alarm === "fault")?.operator_action);
    await explain(found.diagnoses.filter((one) => one.grounds === "full").at(-1));
    await grown.load();
  }

  // The candidates of the last full diagnosis; the numbers behind them are on its own page.
  async function explain(row) {
    certainty.hidden = !row || asset.verdict !== "fault";
    if (certainty.hidden || sure.dataset.id === row.id) return;
    sure.dataset.id = row.id;
    const full = await get(`/diagnoses/${part(row.id)}`, signal);
    const said = full.document ?? {};
    sure.replaceChildren(
      h("p", { class: "note" }, `By the full diagnosis of ${moment(row.t)}: `, h("a", { href: `/diagnoses/${part(row.id)}` }, "all of it, with the reasons"), "."),
      ...[said.candidates?.length && candidates(full, said), said.refit?.mimics?.length && mimics(said)].filter(Boolean),
    );
  }

  async function sample() {
    if (document.hidden) return;
    shown = await get(query(`${path}/signals`, { seconds: SIGNALS_S, points: 600 }), signal);
    traces.draw();
  }

  const answered = (words) => tell(said, words ?? "Done.");
  let alarmed = null;
  function take(next) {
    const moved = next.t !== live.t.at(-1);
    asset = next;
    verdict.update(asset);
    sizes.update(asset.parameters);
    plane.take(asset.responses, asset.t, began(asset));
    if (moved && asset.statistic !== null) {
      for (const key of ["t", "statistic", "level"]) {
        live[key].push(asset[key]);
        if (live[key].length > 2 * POINTS) live[key].splice(0, POINTS);
      }
    }
    both.draw();
    tell(counted, `${count(asset.counted.samples)} samples in ${count(asset.counted.blocks)} blocks since ${moment(asset.counted.began)}; ${count(asset.counted.lost)} blocks lost, ${count(asset.counted.repeated)} came twice.`);
    const key = JSON.stringify(asset.alarms);
    if (key !== alarmed) {
      alarmed = key;
      standing.replaceChildren(asset.alarms.length ? current(asset.alarms, session, answered) : h("p", { class: "empty" }, "Nothing asks for an answer."));
    }
  }

  take(asset);
  spans[0].setAttribute("aria-pressed", "true");
  follow(
    `?asset=${part(name)}`,
    ["asset", "alarm", "diagnosis"],
    ({ asset: told = [], alarm = [], diagnosis = [] }) => {
      told.forEach(take);
      if (alarm.length || diagnosis.length) look().catch(() => {});
    },
    linked,
    signal,
  );
  const timer = setInterval(() => sample().catch(() => {}), SIGNALS_EVERY_MS);
  signal.addEventListener("abort", () => clearInterval(timer));
  await Promise.all([chosen(span).then(() => (plane.past(past24), plane.take(asset.responses, asset.t, began(asset)))), look(), sample()]);
}

// Since when there is a fault.
function began({ verdict, onset, since }) {
  return verdict === "fault" ? (onset ?? since) : null;
}

// What is known of a fault once it has a name; before that, what the service says.
function told(asset) {
  if (asset.verdict !== "fault" || !asset.sizes.length) return asset.summary;
  const each = asset.sizes.map((one) => `${one.parameter} is ${number(one.ratio, 4)} times its healthy value (95 %: ${number(one.low, 4)} to ${number(one.high, 4)})`);
  return `${capital(each.join(", "))}${asset.sized ? ` on ${moment(asset.sized)}` : ""}.`;
}

const half = (element) => (element.classList.add("half"), element);

function relative({ t, r, u, y }) {
  const end = t.at(-1) ?? 0;
  return { t: t.map((at) => at - end), r, u, y };
}

// The verdict: a shape, a headline, a sentence, and facts at fixed places.
function verdictOf(name) {
  const kind = h("p", { class: "kind" });
  const headline = h("h2", {});
  const summary = h("p", { class: "summary" });
  const facts = Object.fromEntries(["since", "size", "statistic", "level", "data", "last"].map((key) => [key, { value: h("b", {}), more: h("small", {}) }]));
  const names = { since: "Since", size: "How large", statistic: "Statistic T², × limit", level: "Sequential test, × limit", data: "Data", last: "Last sample" };
  const advice = h("p", { class: "advice" });
  const advise = (words) => say(advice, words ? `What to check: ${words}.` : "");
  const element = h("div", { class: "verdict", "aria-label": `Verdict on ${name}`, role: "region" }, kind, headline, summary, advice, h("dl", { class: "facts" }, Object.entries(facts).map(([key, one]) => h("div", {}, h("dt", {}, names[key]), h("dd", {}, one.value, one.more)))));
  const put = (key, value, more = "") => (say(facts[key].value, value), tell(facts[key].more, more));
  let look = "";
  const update = (asset) => {
    const now = [asset.verdict, asset.ne107, ...asset.reasons].join();
    if (look !== now) {
      look = now;
      element.className = `verdict ${asset.verdict}`;
      kind.replaceChildren(mark(asset.verdict), VERDICTS[asset.verdict], badge(asset.ne107, `NE 107: ${STATUS[asset.ne107]}${asset.reasons.length ? `, for ${asset.reasons.map(plain).join(", ")}` : ""}`));
    }
    tell(headline, headlineOf(asset));
    say(summary, told(asset));
    const since = began(asset) ?? asset.since;
    put("since", moment(since), `for ${duration(asset.t - since)}${asset.verdict === "fault" ? ", onset as estimated" : ""}`);
    const found = asset.sizes.map((one) => [one.parameter, ...size({ ...one, interval: [one.low, one.high] })]);
    put("size", found.map(([parameter, value]) => `${parameter} ${value}`).join(", ") || DASH, found.length ? `95 %: ${found.map(([, , low, high]) => `${low} to ${high}`).join(", ")}` : asset.verdict === "fault" && asset.awaited.length ? "the full diagnosis is under way" : "no fault that is named");
    put("statistic", multiple(asset.statistic), asset.statistic >= 1 ? "above its limit" : "alarm at 1");
    put("level", multiple(asset.level), asset.level >= 1 ? "above its limit" : "alarm at 1");
    put("data", capital(asset.quality.map(plain).join(", ") || "sound"), `${count(asset.counted.lost)} blocks lost`);
    put("last", moment(asset.t).slice(11), moment(asset.t).slice(0, 10));
  };
  return { element, update, advise };
}

function headlineOf(asset) {
  if (asset.verdict === "healthy") return "No change from the healthy baseline";
  if (asset.verdict === "undetermined") return "Nothing can be told for the time being";
  if (asset.sizes.length) return capital(asset.sizes.map((one) => one.words.replace(/ \(.*/, "")).join(" and "));
  return "The actuator has changed";
}

function current(alarms, session, answered) {
  return table(
    "Alarms of this asset that are not normal",
    ["Alarm", "Priority", "State", "Since", "Answer"],
    alarms.map((one) => [
      plain(one.alarm),
      one.priority ? priority(one.priority) : DASH,
      STATES[one.state] + (one.state === "shelved" && one.until ? ` until ${moment(one.until, { seconds: false })}` : ""),
      h("span", { class: "t" }, moment(one.since)),
      commands(one, session, answered),
    ]),
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
