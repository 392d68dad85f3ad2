// One asset: the verdict in words, where its inverse response is now, both tests, parameters, signals, alarms; live.
import { get, part, query } from "./api.js";
import { drawnArm } from "./arm.js";
import { bode } from "./bode.js";
import { plot } from "./charts.js";
import { commands, STATES } from "./commands.js";
import { showsChange, signals as drawn, signature, tests } from "./curves.js";
import { editor } from "./checks.js";
import { evidence, outline, refresh, verdict } from "./document.js";
import { h, section, table, tell, titled, translate } from "./dom.js";
import { growth } from "./growth.js";
import { follow } from "./live.js";
import { events } from "./events_list.js";
import { badge, priority, STATUS } from "./marks.js";
import { parameters } from "./parameters.js";
import { periods } from "./periods.js";
import { planes } from "./planes.js";
import { relearning } from "./relearn.js";
import { timeline } from "./timeline.js";
import { capital, count, DASH, moment, multiple, number, plain } from "./words.js";

const SPANS = { "1 h": 3600, "24 h": 86400, "7 d": 604800, "30 d": 2592000, "1 y": 31536000 };
const SIGNALS = { "30 s": 30, "10 min": 600, "1 h": 3600 };
const SIGNALS_EVERY_MS = 2000;
const POINTS = 500;

export async function show(main, { session, signal, linked, values, part: name, entitle }) {
  entitle(name);
  const path = `/assets/${part(name)}`;
  let asset = await get(path, signal);
  const units = asset.about.units ?? {};
  const top = topOf(session, path, signal);
  const about = [asset.about.loop, asset.about.plant && `plant ${asset.about.plant}`, asset.about.point, asset.about.sample_rate_hz && `${asset.about.sample_rate_hz} Hz`].filter(Boolean).join(", ");
  const plane = planes(asset.responses, units.response ?? "", signal);
  const sizes = parameters(asset.parameters);
  const grown = growth(path, name, () => asset, { session, values, signal });
  const happened = timeline(path, () => asset, signal);
  const said = h("p", { class: "working", role: "status" });
  const [standing, past, counted] = [h("div", {}), h("div", {}), h("p", { class: "note" })];
  const alarms = section("Alarms", null, standing, said);
  const certainty = h("div", {});
  const learned = relearning(path, session, () => asset, signal);
  const [response, motion, widths] = [h("div", { class: "plot" }), h("div", { class: "plot" }), h("p", { class: "note" })];
  const signed = section("Motion signature", "Mean input over position, forward (solid) and backward (dashed), and over speed: the gap between the two directions is friction.", motion, widths);
  const place = h("div", {});
  const compared = periods(path, () => asset, values, signal);
  const statistic = h("div", { class: "plot tall" });
  const samples = h("div", { class: "plot tall" });
  const isArm = asset.about.plant === "arm";
  const joints = h("div", {});
  const arm = section("The arm and its joints", "Filled by the probability that the joint has changed.", joints);
  const spans = Object.entries(SPANS).map(([words, seconds]) => h("button", { type: "button", class: "filter", "aria-pressed": "false", onclick: () => chosen(seconds) }, words));
  const lengths = Object.entries(SIGNALS).map(([words, seconds]) => h("button", { type: "button", class: "filter", "aria-pressed": String(seconds === 30), onclick: () => looked(seconds) }, words));
  const baseline = asset.baseline && !isArm && h("a", { href: `/design?baseline=${part(asset.baseline)}` }, "What this baseline can tell apart");

  main.replaceChildren(
    h("div", { class: "head" }, h("h1", {}, name), h("span", { class: "note" }, about), h("span", { class: "gap" }), baseline, h("details", { class: "code" }, h("summary", {}, "On a phone"), h("img", { src: `/api/v1${path}/code.svg`, alt: translate("QR code of this page"), loading: "lazy" })), h("button", { type: "button", class: "screen", onclick: () => print() }, "Print")),
    top.element,
    // what shows the change first; of the rest a phone shows the titles
    h("div", { class: "columns" }, arm, place, grown.element, alarms),
    certainty,
    h("div", { class: "columns" }, [section("Events", "What its alarms did, what diagnoses found, and what people did and noted.", past), happened.element, learned.element, compared.element, half(titled("Signals", lengths, samples)), half(section("Stream", null, counted))].map(folded)),
    h("details", { class: "experts" }, h("summary", {}, "For experts"), h(
      "div",
      { class: "columns" },
      top.tests,
      section("Inverse frequency response", "Input per unit of output, as a complex number: the diamond is healthy, the dot is now, its ellipse holds 95 %. Each panel has its own scales.", plane.element),
      section("Inverse response over frequency", "Magnitude and phase, before (healthy) and now, with the band that holds 95 %.", response),
      half(titled("Distance from healthy", spans, statistic)),
      signed,
      half(section("Coefficients", "Against what a healthy loop would show under the same reference.", sizes.element)),
    )),
  );

  arm.hidden = true; // until there is a diagnosis
  if (isArm) for (const element of [samples, plane.element, response]) element.closest("section").hidden = true; // of one loop
  // Live parts first: they need nothing but what is there already.
  plane.start(began(asset));
  let past24 = null;
  let span = SPANS["1 h"];
  let closer = null; // of what is zoomed into, with more of its values
  const live = { t: [], statistic: [], level: [] };
  const both = plot(statistic, "Both tests over time, as multiples of their limits", (c) => tests(c, curves()), signal, { clock: true, moved: (part) => near(part).catch(() => {}) });
  let [shown, length, held] = [{ t: [], r: [], u: [], y: [] }, 30, null];
  const traces = plot(samples, "Reference, output and input of the last seconds", (c) => drawn(c, { ...relative(shown), units, name: "time before the last sample [s]" }), signal, { moved: (part) => hold(part).catch(() => {}) });
  const gain = plot(response, "Magnitude and phase over frequency, before and now", (c) => bode(c, asset.responses, units), signal);
  let moved = null; // motion signatures, before and now
  signed.hidden = true;

  function curves() {
    const cut = past24?.t.length ? past24.t.at(-1) : -Infinity;
    const from = live.t.findIndex((t) => t > cut);
    const rest = (values) => (from < 0 ? [] : values.slice(from));
    const marks = began(asset) === null ? [] : [[began(asset), "onset"]];
    const stored = past24 && spliced(past24, closer, ["t", "statistic", "level"]);
    const joined = (key) => [...(stored?.[key] ?? []), ...rest(live[key])];
    return { t: joined("t"), statistic: joined("statistic"), level: joined("level"), marks, range: [Math.max(asset.t - span, asset.counted.began), asset.t] };
  }

  async function chosen(seconds) {
    span = seconds;
    spans.forEach((button, i) => button.setAttribute("aria-pressed", String(Object.values(SPANS)[i] === seconds)));
    past24 = await get(query(`${path}/history`, { from: asset.t - seconds, points: POINTS }), signal);
    closer = null;
    both.draw();
  }

  // From a year down to every value that is stored: what is zoomed into is asked for anew.
  async function near(part) {
    closer = part && (await get(query(`${path}/history`, { from: part[0] / 1000, to: part[1] / 1000, points: POINTS }), signal));
    both.draw();
  }

  async function look() {
    const [{ transitions }, found, { notes }] = await Promise.all([get(query(`${path}/alarms`, { last: 50 }), signal), get(query("/diagnoses", { asset: name, last: 50 }), signal), get(`${path}/notes`, signal)]);
    past.replaceChildren(events(transitions, found.diagnoses, notes));
    const inFull = found.diagnoses.filter((one) => one.grounds === "full");
    if (isArm && inFull.length) await draw(inFull.at(-1));
    await explain(inFull.at(-1), inFull.find((one) => one.t >= began(asset)));
    await Promise.all([grown.load(), happened.load(found.diagnoses)]);
  }

  async function draw(row) {
    const { arm: drawing } = await get(`/diagnoses/${part(row.id)}`, signal);
    if (drawing) joints.replaceChildren(drawnArm(drawing));
    arm.hidden = !drawing;
  }

  // The motion by the last full diagnosis, beside that of the first one of this fault.
  async function explain(row, first) {
    signed.hidden = !moved || asset.verdict !== "fault";
    if (!row || asset.verdict !== "fault" || signed.dataset.id === row.id) return;
    signed.dataset.id = row.id;
    await compareMotion(await get(`/diagnoses/${part(row.id)}`, signal), first);
  }

  // Now is the newest full diagnosis; before, the first one of this fault, whose window holds its onset.
  async function compareMotion(full, first) {
    const earliest = first && first.id !== full.id ? await get(`/diagnoses/${part(first.id)}`, signal) : full;
    const now = full.signature.at(-1);
    if (!now) return;
    const before = [...earliest.signature, ...full.signature].find((one) => one.words === "before");
    const fresh = moved === null;
    moved = [before, { ...now, words: "after" }].filter(Boolean);
    signed.hidden = false;
    if (showsChange(moved)) place.replaceChildren(signed); // else the growth of the fault shows it
    if (fresh) plot(motion, "Mean input over position and speed, before and now", (c) => signature(c, { curves: moved, units }), signal);
    const width = (key, of) => moved.filter((one) => one[key]).map((one) => `${one.words === "before" ? "before" : "now"} ${number(one[key][0], 3)} ± ${number(1.96 * one[key][1], 2)}${of ? ` ${of}` : ""}`);
    const told = [["Friction band", width("friction_band", units.u)], ["Lost motion", width("lost_motion", units.y)]].filter(([, each]) => each.length);
    tell(widths, told.map(([words, each]) => `${words}: ${each.join(", ")}.`).join(" "));
  }

  async function sample() {
    if (document.hidden || held) return;
    shown = await get(query(`${path}/signals`, { seconds: length, points: 600 }), signal);
    traces.draw();
  }

  async function looked(seconds) {
    length = seconds;
    lengths.forEach((button) => button.setAttribute("aria-pressed", String(SIGNALS[button.textContent] === seconds)));
    await sample();
  }

  // Whoever zooms in looks at samples that stand still, down to each of them.
  async function hold(part) {
    held = part;
    const end = shown.t.at(-1);
    if (!part) return sample();
    const fine = await get(query(`${path}/signals`, { seconds: Math.max(part[1] - part[0], 0.1), to: end + part[1], points: 2000 }), signal);
    shown = spliced(shown, fine, ["t", "r", "u", "y"]);
    traces.draw();
  }

  const answered = (words) => tell(said, words ?? "Done.");
  let alarmed = null;
  function take(next) {
    const moved = next.t !== live.t.at(-1);
    asset = next;
    if (top.update(asset)) {
      const full = asset.diagnosis && h("p", { class: "note" }, `By the full diagnosis of ${moment(asset.diagnosis.t)}: `, h("a", { href: `/diagnoses/${part(asset.diagnosis.id)}` }, "all of it, with the reasons"), ".");
      certainty.replaceChildren(...evidence(asset.sections), ...(full ? [full] : []));
    }
    sizes.update(asset.parameters);
    plane.take(asset.responses, asset.t, began(asset));
    if (moved && asset.statistic !== null) {
      for (const key of ["t", "statistic", "level"]) {
        live[key].push(asset[key]);
        if (live[key].length > 2 * POINTS) live[key].splice(0, POINTS);
      }
    }
    both.draw();
    gain.draw();
    tell(counted, `${count(asset.counted.samples)} samples in ${count(asset.counted.blocks)} blocks since ${moment(asset.counted.began)}; ${count(asset.counted.lost)} blocks lost, ${count(asset.counted.repeated)} came twice.`);
    const key = JSON.stringify(asset.alarms);
    if (key !== alarmed) {
      alarmed = key;
      alarms.hidden = !asset.alarms.length;
      standing.replaceChildren(...(asset.alarms.length ? [current(asset.alarms, session, answered)] : []));
    }
  }

  take(asset);
  compared.start();
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
  await Promise.all([learned.load(), chosen(span).then(() => (plane.past(past24), plane.take(asset.responses, asset.t, began(asset)))), look(), sample()]);
}

// Since when there is a fault.
function began({ verdict, onset, since }) {
  return verdict === "fault" ? (onset ?? since) : null;
}

// On a phone a section is its title, until somebody unfolds it.
function folded(element) {
  if (!matchMedia("(max-width: 34rem)").matches) return element;
  return h("details", { class: "fold" }, h("summary", {}, element.querySelector("h2").textContent), element);
}

const half = (element) => (element.classList.add("half"), element);

// Columns over time, with what is known of a part of them more closely in its place.
function spliced(coarse, fine, keys) {
  if (!fine?.t.length) return coarse;
  const [from, to] = [fine.t[0], fine.t.at(-1)];
  const outside = (key, side) => coarse[key].filter((_, i) => side(coarse.t[i]));
  return Object.fromEntries(keys.map((key) => [key, [...outside(key, (t) => t < from), ...fine[key], ...outside(key, (t) => t > to)]]));
}

function relative({ t, r, u, y }) {
  const end = t.at(-1) ?? 0;
  return { t: t.map((at) => at - end), r, u, y };
}

// The verdict and what to check, drawn anew where it changes; beside it, for experts, how far both tests are from their limits.
function topOf(session, path, signal) {
  const [element, status, tests] = [h("div", {}), h("p", { class: "note" }), h("p", { class: "note" })];
  let shown = "";
  const update = (asset) => {
    const both = `Statistic T², × limit: ${multiple(asset.statistic)}; sequential test, × limit: ${multiple(asset.level)}; alarm at 1.`;
    tests.textContent = translate(asset.about.plant === "arm" ? `Evidence of a change, × limit: ${multiple(asset.statistic)}; alarm at 1.` : both);
    status.replaceChildren(badge(asset.ne107, `NE 107: ${STATUS[asset.ne107]}${asset.reasons.length ? `, for ${asset.reasons.map(plain).join(", ")}` : ""}`), ` ${translate("Last sample")}: ${moment(asset.t)}`);
    const now = outline(asset.verdict, [...asset.sections, asset.checks]);
    if (element.querySelector("form :focus")) return false;
    if (now === shown) return refresh(element, asset.sections);
    shown = now;
    element.replaceChildren(verdict(asset.verdict, asset.sections, editor(path, asset.checks, session, signal)), status);
    return true;
  };
  return { element, tests, update };
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
