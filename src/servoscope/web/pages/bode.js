// The inverse response over frequency, before and now: magnitude and phase with their 95 % bands.
import { axis, legend, line, tooltip } from "./charts.js";
import { translate } from "./dom.js";
import { number, unit } from "./words.js";

const ONE_OF_TWO = 1.959964 / Math.sqrt(5.991465); // of an ellipse that holds 95 % in two directions, the half width in one

// `responses` as the interface tells them; units as of an asset.
export function bode(c, responses, units) {
  const known = responses.filter((one) => one.real !== null);
  const points = known.map((one) => ({ f: one.frequency_hz, ...polar(one) }));
  const [y, gain] = [unit(units?.response), (index, name, rest = {}) => axis(c, name, { type: "log", gridIndex: index, label: { formatter: String }, ...span(known), ...rest })];
  const column = (key) => points.map((one) => [one.f, one[key]]);
  const seen = { showSymbol: true, symbolSize: 6 };
  const band = (index, key) => {
    const hidden = { type: "line", showSymbol: false, silent: true, lineStyle: { opacity: 0 }, stack: `band ${key}`, stackStrategy: "all", xAxisIndex: index, yAxisIndex: index };
    return [
      { ...hidden, name: `${key} low`, data: points.map((one) => [one.f, one[key] - one[`${key}Half`]]) },
      { ...hidden, name: "width", data: points.map((one) => [one.f, 2 * one[`${key}Half`]]), areaStyle: { color: c.measured, opacity: 0.25 } },
    ];
  };
  const both = (index, key) => [
    ...band(index, key),
    line("before", column(`${key}Before`), c.healthy, { ...seen, xAxisIndex: index, yAxisIndex: index, stroke: { type: [5, 3] } }),
    line("now", column(key), c.measured, { ...seen, xAxisIndex: index, yAxisIndex: index }),
  ];
  const short = (value) => number(value, 3);
  return {
    grid: [
      { left: 70, right: "54%", top: 30, bottom: 40 },
      { left: "54%", right: 14, top: 30, bottom: 40 },
    ],
    legend: legend(c, ["before", "now"]),
    tooltip: tooltip(c, { formatter: (drawn) => [`${number(drawn[0].value[0], 4)} Hz`, ...drawn.filter((one) => ["before", "now"].map(translate).includes(one.seriesName)).map((one) => `${one.seriesName} ${number(one.value[1], 4)}`)].join("\n") }),
    xAxis: [gain(0, "frequency [Hz]"), gain(1, "frequency [Hz]")],
    yAxis: [
      axis(c, `magnitude${y}`, { type: "value", scale: true, gridIndex: 0, gap: 52, splitNumber: 4, label: { formatter: short } }),
      axis(c, "phase [°]", { type: "value", scale: true, gridIndex: 1, gap: 44, splitNumber: 4, label: { formatter: short } }),
    ],
    series: [...both(0, "magnitude"), ...both(1, "phase")],
  };
}

function span(known) {
  const all = known.map((one) => one.frequency_hz);
  return all.length ? { min: 0.8 * Math.min(...all), max: 1.25 * Math.max(...all) } : {};
}

// Magnitude and phase [degrees], before and now, and the half widths of their 95 % intervals: the ellipse seen along the
// pointer and across it. The phase before is told within half a turn of that now.
function polar({ real, imag, nominal_real: r, nominal_imag: i, ellipse }) {
  const [magnitude, angle] = [Math.hypot(real, imag), Math.atan2(imag, real)];
  const [a, b, turned] = ellipse ?? [0, 0, 0];
  const along = (phi) => ONE_OF_TWO * Math.hypot(a * Math.cos(phi - turned), b * Math.sin(phi - turned));
  const degrees = 180 / Math.PI;
  const phase = degrees * angle;
  const before = degrees * Math.atan2(i, r);
  return {
    magnitude,
    magnitudeHalf: along(angle),
    magnitudeBefore: Math.hypot(r, i),
    phase,
    phaseHalf: (degrees * along(angle + Math.PI / 2)) / magnitude,
    phaseBefore: before - 360 * Math.round((before - phase) / 360),
  };
}
