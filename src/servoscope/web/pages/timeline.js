// What has happened to an asset on one axis: its fault and gaps in its data as bars, and what people and diagnoses did as marks.
import { get, query } from "./api.js";
import { axis, plot, tooltip } from "./charts.js";
import { STATES } from "./commands.js";
import { h, section, translate } from "./dom.js";
import { VERDICTS } from "./marks.js";
import { moment, plain, sentence } from "./words.js";

const ROWS = ["Fault", "Data", "Other alarms", "Answers", "Repairs", "Baselines", "Notes", "Diagnoses"]; // from above
const STEPS = 200;
const ACTIVE = ["unacknowledged", "acknowledged"];
const GONE = ["normal", "returned_unacknowledged", "latched_unacknowledged", "latched_acknowledged"];
const PEOPLE = ["acknowledge", "reset", "shelve", "unshelve", "remove_from_service", "return_to_service"];
const rowOfNote = ({ kind, anew }) => (kind === "baseline" ? "Baselines" : anew || kind !== "note" ? "Repairs" : "Notes");
const rowOf = (alarm) => (alarm === "fault" ? "Fault" : ["data_quality", "reception"].includes(alarm.split(":")[0]) ? "Data" : "Other alarms");

export function timeline(path, asset, signal) {
  const canvas = h("div", { class: "plot" });
  const element = section("Timeline", "Bars: how long something lasted. Marks: what was done, noted and found.", canvas);
  let entries = []; // { row, from, to, words }; a mark has no `to`, what still lasts has null
  const chart = plot(canvas, "What has happened to this asset over time", (c) => drawn(c, entries, asset()), signal, { clock: true, csv: () => table(entries, asset()) });

  async function load(diagnoses) {
    const [alarms, { notes }] = await Promise.all([get(query(`${path}/alarms`, { last: STEPS }), signal), get(`${path}/notes`, signal)]);
    entries = [
      ...bars(alarms.transitions, asset(), diagnoses),
      ...alarms.transitions.filter((one) => PEOPLE.includes(one.event)).map((one) => ({ row: "Answers", from: one.t, words: `${plain(one.alarm)}: ${translate(STATES[one.after])}${one.who ? ` (${one.who})` : ""}` })),
      ...notes.map((one) => ({ row: rowOfNote(one), from: one.t, words: `${one.text} (${one.who})` })),
      ...diagnoses.filter((one) => one.grounds === "full").map((one) => ({ row: "Diagnoses", from: one.t, words: `${VERDICTS[one.verdict]}: ${sentence(one.summary)}` })),
    ];
    element.hidden = !entries.length;
    chart.draw();
  }

  return { element, load };
}

// From when until when each alarm was there; a fault begins at the onset that its diagnoses found.
function bars(transitions, { onset, since, verdict }, diagnoses) {
  const open = new Map();
  const ended = [];
  for (const { t, alarm, after, cause } of transitions) {
    const bar = open.get(alarm);
    if (ACTIVE.includes(after) && !bar) open.set(alarm, { row: rowOf(alarm), from: t, to: null, words: alarm === "fault" ? sentence(translate(cause)) : plain(alarm) });
    else if (bar && GONE.includes(after)) {
      bar.to = t;
      ended.push(bar);
      open.delete(alarm);
    }
  }
  const found = [...ended, ...open.values()];
  for (const bar of found.filter((one) => one.row === "Fault")) {
    const onsets = diagnoses.filter((one) => one.onset !== null && one.t >= bar.from && (bar.to === null || one.t <= bar.to)).map((one) => one.onset);
    const known = bar.to === null && verdict === "fault" ? (onset ?? since) : null; // as the headline says
    const before = Math.max(...found.filter((one) => one.row === "Fault" && one.to !== null && one.to < bar.from).map((one) => one.to));
    bar.from = Math.max(known ?? Math.min(bar.from, ...onsets), before);
  }
  return found;
}

const told = ({ from, to, words }, end) => `${moment(from)}${to === undefined ? "" : ` – ${to === null ? translate("now") : moment(to)}`}${end ? "\n" : " "}${words}`;

function drawn(c, entries, { t }) {
  const rows = ROWS.filter((row) => entries.some((one) => one.row === row));
  const names = [...rows].reverse().map(translate);
  const colour = { Fault: c.alarm, Data: c.care, "Other alarms": c.care, Answers: c.healthy, Repairs: c.ink, Baselines: c.check, Notes: c.ink, Diagnoses: c.measured };
  const series = rows.flatMap((row) => {
    const own = entries.filter((one) => one.row === row);
    const at = (time) => [1000 * time, translate(row)];
    const lasting = own.filter((one) => one.to !== undefined).flatMap((one) => [[...at(one.from), told(one, true)], [...at(one.to ?? t), told(one, true)], [null, null]]);
    const marks = own.filter((one) => one.to === undefined).map((one) => [...at(one.from), told(one, true)]);
    return [
      ...(lasting.length ? [{ type: "line", name: translate(row), data: lasting, color: colour[row], symbol: "rect", symbolSize: 10, lineStyle: { width: 10, color: colour[row] } }] : []),
      ...(marks.length ? [{ type: "scatter", name: translate(row), data: marks, color: colour[row], symbol: "diamond", symbolSize: 12 }] : []),
    ];
  });
  return {
    grid: { left: 110, right: 18, top: 10, bottom: 28 },
    tooltip: tooltip(c, { formatter: (points) => [points].flat().map((one) => one.value[2]).filter(Boolean).join("\n\n") }),
    xAxis: axis(c, "", { type: "time", min: 1000 * Math.min(t, ...entries.map((one) => one.from)), max: 1000 * t, splitNumber: 6 }),
    yAxis: axis(c, "", { type: "category", data: names, gap: 44 }),
    series,
  };
}

// Each entry as a row: what, from when, until when, in words.
function table(entries, { t }) {
  const iso = (time) => new Date(1000 * time).toISOString();
  const quoted = (text) => `"${text.replaceAll('"', '""')}"`;
  const lines = [...entries].sort((a, b) => a.from - b.from).map((one) => [quoted(translate(one.row)), iso(one.from), one.to === undefined ? "" : iso(one.to ?? t), quoted(one.words)].join());
  return ["what,from,to,words", ...lines, ""].join("\n");
}
