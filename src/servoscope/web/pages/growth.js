// How a fault grows: one curve of its size over months, a limit that may be tried, and when it will be reached.
import { get, mayChange, post, query, upload } from "./api.js";
import { plot } from "./charts.js";
import { growth as drawn } from "./curves.js";
import { during, field, h, translate, tell, titled } from "./dom.js";
import { say } from "./marks.js";
import { storedSamples } from "./stored_samples.js";
import { change, count, moment, number, plain } from "./words.js";

const DAY_S = 86400;
const SPANS = { "7 d": 7 * DAY_S, "60 d": 60 * DAY_S, "1 y": 366 * DAY_S, all: null };
const WEEK = 7;

export function growth(path, name, asset, { session, values, signal }) {
  const canvas = h("div", { class: "plot tall" });
  const picture = h("div", { hidden: true }, canvas);
  const said = h("p", { class: "summary", role: "status" });
  const why = h("p", { class: "note" });
  const which = h("select", { "aria-label": "What is followed" });
  const limit = h("input", { type: "number", step: "any", "aria-label": "Limit, as a ratio to healthy", placeholder: "limit, such as 1.5", value: values.get("limit") ?? "" });
  const buttons = Object.keys(SPANS).map((words) => h("button", { type: "button", class: "filter", "aria-pressed": "false", onclick: () => chosen(words) }, words));
  const advised = h("p", { class: "note" });
  const noted = h("ul", { class: "why" });
  const element = titled("How it grows", [which, limit, ...buttons], said, advised, picture, why, noted, mayChange(session.role, "operator") && noting());
  let span = SPANS[values.get("span")] === undefined ? "60 d" : values.get("span");
  let [curves, forecast, notes, limits] = [[], null, [], []];
  const chart = plot(canvas, "Size over time, with its 95 % interval", (c) => drawn(c, shown()), signal, { clock: true, csv: table });

  // All curves of what is chosen as one, in the order of time.
  function rows() {
    const own = curves.filter((curve) => curve.name === which.value);
    const all = own.flatMap(({ kind, t, value, low, high, healthy }) => t.map((at, i) => ({ t: at, value: value[i], low: low[i], high: high[i], healthy: healthy[i], full: kind === "full" })));
    return all.sort((a, b) => a.t - b.t);
  }

  // What was done to the machine: told in the curve, and where the trend may begin anew.
  function noting() {
    const [text, when, anew] = [h("input", { maxlength: "200", required: true }), h("input", { type: "datetime-local" }), h("input", { type: "checkbox" })];
    const [answer, button] = [h("p", { class: "working", role: "status" }), h("button", {}, "Note it")];
    const submit = (event) => {
      event.preventDefault();
      return during(button, answer, async () => {
        await post(`${path}/notes`, { t: when.value ? new Date(when.value).getTime() / 1000 : asset().t, text: text.value, anew: anew.checked }, signal);
        event.target.reset();
        await load();
      });
    };
    const form = h("form", { onsubmit: submit }, h("div", { class: "fields" }, field("What was done", text), field("When (else: now)", when), h("label", {}, anew, " The trend begins anew")), h("div", { class: "actions" }, button), answer);
    return h("details", { class: "screen" }, h("summary", {}, "Note what was done, such as: pump replaced"), form, renewing());
  }

  // Another machine needs another baseline: what the store keeps since then becomes a recording to learn from.
  function renewing() {
    const [button, answer] = [h("button", { type: "button" }, "Keep samples for a new baseline"), h("p", { class: "working", role: "status" })];
    const keep = async () => {
      const since = Math.max(...notes.filter((note) => note.anew).map((note) => note.t));
      const file = await storedSamples(path, asset(), Number.isFinite(since) ? since : null, signal);
      if (!file) return ["There are no samples since the machine was renewed."];
      const kept = await upload(file, signal);
      return [`${kept.name}: ${count(kept.rows)} samples are kept as a recording. `, h("a", { href: "/learn" }, "Learn a baseline from it"), ", and name its file in the service file."];
    };
    button.addEventListener("click", async () => {
      let told = [];
      await during(button, answer, async () => (told = await keep()));
      if (told.length) answer.replaceChildren(...told.map(translate));
    });
    return h("div", {}, h("div", { class: "actions" }, button), answer);
  }

  // The values as `servoscope trend` reads them.
  function table() {
    const lines = rows().map((one) => [new Date(1000 * one.t).toISOString(), one.value, one.low, one.high, one.healthy, one.full ? "full" : ""].join());
    return [`time,${which.value},low,high,healthy,diagnosis`, ...lines, ""].join("\n");
  }

  function shown() {
    const all = rows();
    const ratio = all.every((one) => Math.abs(one.healthy) > one.high - one.low);
    const scale = (one, key) => (ratio ? 100 * ((one[key] - one.healthy) / Math.abs(one.healthy)) : one[key]);
    const column = (key) => all.map((one) => scale(one, key));
    const percent = (value) => (value === null ? null : 100 * (value - 1));
    const goal = ratio && limit.value !== "" ? percent(Number(limit.value)) : null;
    const reach = forecast?.outlook === "forecast" && goal !== null;
    const ends = reach ? forecast.remaining_s.filter((each) => each !== null).map((each) => forecast.to_t + each) : [];
    const until = Math.max(asset().t, ...ends);
    return {
      t: all.map((one) => one.t),
      value: column("value"),
      low: column("low"),
      high: column("high"),
      full: new Set(all.flatMap((one, i) => (one.full ? [i] : []))),
      unit: ratio ? " %" : "",
      limit: goal,
      forecast: reach ? { t: forecast.to_t, value: percent(forecast.value[1]), ends } : null,
      marks: notes.map((note) => [note.t, note.text]),
      range: [all[0]?.t ?? null, until], // where there are values, not the whole span
    };
  }

  async function chosen(words) {
    span = words;
    buttons.forEach((button) => button.setAttribute("aria-pressed", String(button.textContent === words)));
    remember();
    await load();
  }

  function remember() {
    const told = new URLSearchParams(location.search);
    for (const [key, value] of Object.entries({ span, limit: limit.value, of: which.value })) value ? told.set(key, value) : told.delete(key);
    history.replaceState(null, "", `${location.pathname}?${told}`);
  }

  async function load() {
    const from = SPANS[span] === null ? null : asset().t - SPANS[span];
    const found = await Promise.all(["faults", "coefficients"].map((of) => get(query(`${path}/sizes`, { of, from, points: 600 }), signal)));
    notes = (await get(`${path}/notes`, signal)).notes;
    noted.replaceChildren(...notes.map((note) => h("li", {}, h("span", { translate: "no" }, `${moment(note.t, { seconds: false })}: ${note.text} (${note.who})`), note.anew && "; the trend begins here")));
    curves = found.flatMap((one) => one.curves);
    const names = [...new Set(curves.map((curve) => curve.name))];
    if (String(names) !== [...which.options].map((one) => one.value).join()) {
      const before = which.value || values.get("of");
      which.replaceChildren(...names.map((name) => h("option", { value: name }, plain(name))));
      which.value = names.includes(before) ? before : (asset().sizes[0]?.name ?? names[0] ?? "");
    }
    await foresee();
  }

  // Where the loop itself would fail: one press takes it as the limit.
  function advise(last) {
    const side = last && last.value < last.healthy ? "down" : "up";
    const own = limits.filter((one) => one.fault === which.value && one[side] !== null);
    const take = (value) => () => ((limit.value = value), limit.dispatchEvent(new Event("change")));
    const words = { tracking: "bandwidth below 0.7 of healthy", stability: "margin of stability halved" };
    advised.replaceChildren(...(own.length ? ["The loop itself suggests as limit: ", ...own.map((one) => h("button", { type: "button", class: "filter", onclick: take(one[side].toPrecision(3)) }, `${one[side].toPrecision(3)}, ${words[one.kind]}`))] : []));
  }

  // Without a limit only the rate is told: it is the same for every limit.
  async function foresee() {
    const all = rows();
    const last = all.at(-1);
    forecast = null;
    advise(last);
    if (last) {
      const goal = limit.value !== "" ? Number(limit.value) : last.value < last.healthy ? 0.5 : 2;
      // a size that nothing has been found of since the last repair is no error: its trend is empty
      forecast = await get(query(`${path}/trend`, { name: which.value, limit: goal }), signal).catch((error) => {
        if (error.status !== 404) throw error;
        return null;
      });
    }
    say(said, words(forecast, limit.value !== ""));
    const shown = all.length === 1 ? "One value is shown" : `${count(all.length)} values are shown, the last one`;
    const because = forecast?.rate_per_day ? forecast.explanation.join(" ") : "";
    tell(why, last ? `${shown} of ${moment(last.t)}. ${because}`.trim() : "");
    picture.hidden = !last; // where there are no values there is no chart
    if (last) chart.draw();
  }

  const known = get(`${path}/limits`, signal).then((found) => ((limits = found.limits), advise(rows().at(-1))));
  known.catch(() => {}); // a hint less
  which.addEventListener("change", () => (remember(), foresee().catch(() => {})));
  limit.addEventListener("change", () => (remember(), foresee().catch(() => {})));
  buttons.forEach((button) => button.setAttribute("aria-pressed", String(button.textContent === span)));
  return { element, load };
}

// Whether it grows, and until when, in words.
function words(forecast, asked) {
  if (!forecast) return "Nothing has been followed yet: sizes are stored every ten minutes, and by each diagnosis.";
  if (!forecast.rate_per_day) return asked ? forecast.summary : "Too few values for a trend.";
  const week = forecast.rate_per_day.map((each) => 100 * WEEK * each);
  const grows = week[0] > 0 || week[2] < 0;
  const rate = grows ? `It changes by ${change(1 + week[1] / 100)} of healthy per week (${number(week[0], 2)} to ${number(week[2], 2)}).` : "No lasting change can be shown.";
  return asked ? `${forecast.summary} ${rate}` : rate;
}
