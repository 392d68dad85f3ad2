// Curves over time: both tests against their limit, and signals; live or of a recording, they look the same.
import { axis, legend, line, tooltip } from "./charts.js";
import { translate } from "./dom.js";
import { moment, multiple, number, unit } from "./words.js";

// Both tests as multiples of their limits, on a logarithmic axis; marks are [time, words] of what happened.
export function tests(c, { t, statistic, level, marks = [], clock = true, range = [null, null] }) {
  const pairs = (values) => t.map((at, i) => [clock ? 1000 * at : at, values[i] > 0 ? values[i] : null]);
  const highest = Math.max(2, ...[...statistic, ...level].filter((value) => value > 0));
  const sequential = level.some((value) => value > 0); // not every loop can be simulated, and so have one
  const lowest = Math.min(0.1, ...statistic.filter((value) => value > 0));
  const limit = {
    silent: true,
    symbol: "none",
    label: { show: false },
    lineStyle: { color: c.alarm, type: [6, 3], width: 1.2 },
    data: [{ yAxis: 1 }, ...marks.map(([at]) => ({ xAxis: clock ? 1000 * at : at, lineStyle: { color: c.ink, type: [2, 3], width: 1 } }))],
  };
  return {
    grid: { left: 62, right: 14, top: 30, bottom: clock ? 28 : 40 },
    legend: legend(c, sequential ? ["statistic T²", "sequential test"] : ["statistic T²"]),
    tooltip: tooltip(c, {
      formatter: (points) => [clock ? moment(points[0].value[0] / 1000) : `${number(points[0].value[0], 5)} s`, ...points.map((one) => `${one.seriesName} ${multiple(one.value[1])} × limit`)].join("\n"),
    }),
    xAxis: axis(c, clock ? "" : "time [s]", { type: clock ? "time" : "value", min: at(range[0], clock), max: at(range[1], clock), splitNumber: 8, label: { showMinLabel: false, ...(clock ? {} : { formatter: short }) } }),
    yAxis: axis(c, "multiple of the limit", { type: "log", min: 10 ** Math.floor(Math.log10(lowest)), max: 10 ** Math.ceil(Math.log10(1.2 * highest)), gap: 44, label: { formatter: String } }),
    series: [
      line("sequential test", pairs(level), c.healthy, { stroke: { width: 1.1 } }),
      line("statistic T²", pairs(statistic), c.measured, { markLine: limit }),
    ],
  };
}

const at = (t, clock) => (t === null ? undefined : clock ? 1000 * t : t);

// Reference and output above, input beneath, on one time axis.
export function signals(c, { t, r, u, y, units, name = "time [s]", marks = [] }) {
  const pairs = (values) => t.map((at, i) => [at, values[i]]);
  const time = { type: "value", min: t[0] ?? 0, max: t.at(-1) ?? 1 };
  const lines = { silent: true, symbol: "none", label: { show: false }, lineStyle: { color: c.alarm, type: [2, 3], width: 1 }, data: marks.map(([at]) => ({ xAxis: at })) };
  const upper = axis(c, "", { ...time, gridIndex: 0, label: { show: false } });
  return {
    grid: [
      { left: 70, right: 14, top: 30, height: "36%" },
      { left: 70, right: 14, bottom: 40, height: "32%" },
    ],
    legend: legend(c, ["output y", "reference r"]),
    tooltip: tooltip(c, { formatter: (points) => [`${number(points[0].value[0], 5)} s`, ...points.map((one) => `${one.seriesName} ${number(one.value[1], 4)} ${one.seriesName === translate("input u") ? (units?.u ?? "") : (units?.y ?? "")}`)].join("\n") }),
    axisPointer: { link: [{ xAxisIndex: "all" }] },
    xAxis: [upper, axis(c, name, { ...time, gridIndex: 1, label: { formatter: short, showMinLabel: false } })],
    yAxis: [axis(c, `r, y${unit(units?.y)}`, { type: "value", scale: true, gridIndex: 0, gap: 52, splitNumber: 3, label: { formatter: short } }), axis(c, `u${unit(units?.u)}`, { type: "value", scale: true, gridIndex: 1, gap: 52, splitNumber: 3, label: { formatter: short } })],
    series: [
      line("output y", pairs(y), c.measured, { xAxisIndex: 0, yAxisIndex: 0, stroke: { width: 2.2 }, markLine: lines }),
      line("reference r", pairs(r), c.reference, { xAxisIndex: 0, yAxisIndex: 0, stroke: { width: 1 } }),
      line("input u", pairs(u), c.measured, { xAxisIndex: 1, yAxisIndex: 1, stroke: { width: 1.2 } }),
    ],
  };
}

// Mean input over position, forward and backward, on the left, and over speed on the right.
export function signature(c, { curves, units }) {
  const colours = { before: c.healthy, after: c.measured, measured: c.measured };
  const pairs = (at, values) => at.map((x, i) => [x, values[i]]);
  const y = (index) => axis(c, index ? "" : `mean u${unit(units?.u)}`, { type: "value", scale: true, gridIndex: index, gap: 52, label: { formatter: short } });
  const x = (index, name) => axis(c, name, { type: "value", scale: true, gridIndex: index, splitNumber: 4, label: { formatter: short } });
  return {
    grid: [
      { left: 70, right: "54%", top: 30, bottom: 40 },
      { left: "54%", right: 14, top: 30, bottom: 40 },
    ],
    legend: legend(c, curves.map((one) => one.words)),
    tooltip: tooltip(c, { formatter: (points) => points.map((one) => `${one.seriesName}: ${number(one.value[1], 4)} ${units?.u ?? ""}`).join("\n") }),
    xAxis: [x(0, `output y${unit(units?.y)}`), x(1, "speed of y")],
    yAxis: [y(0), y(1)],
    series: curves.flatMap((one) => [
      line(one.words, pairs(one.position, one.forward), colours[one.words], { xAxisIndex: 0, yAxisIndex: 0 }),
      line(one.words, pairs(one.position, one.backward), colours[one.words], { xAxisIndex: 0, yAxisIndex: 0, stroke: { type: [5, 3] } }),
      line(one.words, pairs(one.speed, one.by_speed), colours[one.words], { xAxisIndex: 1, yAxisIndex: 1 }),
    ]),
  };
}

// Whether the friction bands before and after the onset are certainly apart, so that the signature shows the change.
export function showsChange(curves) {
  const [before, after] = ["before", "after"].map((words) => curves.find((one) => one.words === words)?.friction_band);
  return Boolean(before && after) && Math.abs(after[0] - before[0]) > 3 * Math.hypot(before[1], after[1]);
}

export const short = (value) => (value === 0 ? "0" : number(Number(value.toPrecision(3)), 3).replace(/(\.\d*?)0+(?=$| )/, "$1").replace(/\.(?=$| )/, ""));

// A size over months as a change in percent, with its 95 % band: dots are full diagnoses, the dashes lead to the limit.
export function growth(c, { t, value, low, high, full, unit: of, limit, forecast, range = [null, null], marks = [] }) {
  const pairs = (values) => t.map((at, i) => [1000 * at, values[i]]);
  const band = { type: "line", showSymbol: false, silent: true, lineStyle: { opacity: 0 }, stack: "band", stackStrategy: "all" };
  const ways = forecast ? forecast.ends.map((end) => line("until the limit", [[1000 * forecast.t, forecast.value], [1000 * end, limit]], c.alarm, { silent: true, stroke: { width: 1.1, type: [4, 4] } })) : [];
  const drawn = {
    silent: true,
    symbol: "none",
    label: { show: true, position: "insideStartTop", color: c.ink, formatter: ({ name }) => name },
    data: [
      ...(limit === null ? [] : [{ yAxis: limit, name: translate("limit"), lineStyle: { color: c.alarm, type: [6, 3], width: 1.2 } }]),
      ...marks.map(([at, words]) => ({ xAxis: 1000 * at, name: words, lineStyle: { color: c.ink, type: [2, 3], width: 1 } })),
    ],
  };
  const said = (at, words, i) => `${moment(at, { seconds: false })}\n${words} ${number(value[i], 3)}${of} (${number(low[i], 3)} ${translate("to")} ${number(high[i], 3)})`;
  return {
    grid: { left: 62, right: 14, top: 30, bottom: 28 },
    legend: legend(c, ["size", "full diagnosis"]),
    tooltip: tooltip(c, {
      formatter: ([{ value: [at] }]) => {
        const i = t.indexOf(at / 1000);
        return i < 0 ? "" : said(t[i], translate(full.has(i) ? "full diagnosis" : "size"), i);
      },
    }),
    xAxis: axis(c, "", { type: "time", min: at(range[0], true), max: at(range[1], true), splitNumber: 6 }),
    yAxis: axis(c, `change${unit(of.trim())}`, { type: "value", scale: true, gap: 44, splitNumber: 4, label: { formatter: short } }),
    series: [
      { ...band, name: "low", data: pairs(low) },
      { ...band, name: "width", data: t.map((at, i) => [1000 * at, high[i] - low[i]]), areaStyle: { color: c.measured, opacity: 0.2 } },
      line("size", pairs(value), c.measured, { markLine: drawn, showSymbol: t.length < 2 }),
      { type: "scatter", name: translate("full diagnosis"), data: [...full].map((i) => [1000 * t[i], value[i]]), symbolSize: 7, color: c.ink },
      ...ways,
    ],
  };
}

// An estimate relative to healthy over time, with its band of two standard deviations.
export function coefficient(c, { t, one }) {
  const usable = one.nominal.map((nominal, i) => nominal && Math.abs(nominal) > one.std[i]);
  const relative = usable.filter(Boolean).length > t.length / 2;
  const scale = (value, i) => (value === null ? null : relative ? (100 * value) / Math.abs(one.nominal[i]) : value);
  const middle = t.map((_, i) => (one.value[i] === null ? null : scale(one.value[i] - one.nominal[i], i)));
  const half = t.map((_, i) => scale(2 * (one.std[i] ?? 0), i));
  const band = { showSymbol: false, silent: true, lineStyle: { opacity: 0 }, stack: "band", stackStrategy: "all", symbol: "none", type: "line" };
  return {
    grid: { left: 62, right: 10, top: 10, bottom: 38 },
    tooltip: tooltip(c, { formatter: (points) => `${number(points[0].value[0], 5)} s\n${number(points.find((p) => p.seriesName === translate("estimate"))?.value[1], 3)} ${relative ? "%" : one.unit}` }),
    xAxis: axis(c, "time [s]", { type: "value", min: t[0], max: t.at(-1), label: { formatter: short, showMinLabel: false, showMaxLabel: false } }),
    yAxis: axis(c, `deviation${unit(relative ? "%" : one.unit)}`, { type: "value", scale: true, gap: 44, splitNumber: 3, label: { formatter: short } }),
    series: [
      { ...band, name: "low", data: t.map((at, i) => [at, middle[i] === null ? null : middle[i] - half[i]]) },
      { ...band, name: "width", data: t.map((at, i) => [at, middle[i] === null ? null : 2 * half[i]]), areaStyle: { color: c.measured, opacity: 0.2 } },
      line("estimate", t.map((at, i) => [at, middle[i]]), c.measured, { markLine: { silent: true, symbol: "none", label: { show: false }, lineStyle: { color: c.healthy, type: [5, 3] }, data: [{ yAxis: 0 }] } }),
    ],
  };
}
