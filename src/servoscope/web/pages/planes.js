// The inverse frequency response in the complex plane, a panel per frequency: healthy, where it is now with its ellipse, and its trail.
import { axis, outline, plot, tooltip } from "./charts.js";
import { h, translate } from "./dom.js";
import { general, number, ticks } from "./words.js";

const TRAIL = 400; // points of a trail

// `responses` as the interface tells them; `take` moves on to newer ones, `past` puts a trail before them.
export function planes(responses, unit, signal) {
  const panels = responses.map((first, i) => {
    const element = h("div", { class: "plot" });
    return { element, title: h("h3", {}, `${general(first.frequency_hz)} Hz`), i, now: first, trail: [], x: null, y: null };
  });
  const element = h("div", { class: "planes" }, panels.map((one) => h("div", {}, one.title, one.element)));
  let onset = null; // of a fault; what was before it is drawn as measured

  const start = (since = null) => {
    onset = since;
    for (const one of panels) {
      const label = `Inverse response at ${general(one.now.frequency_hz)} Hz in the complex plane`;
      one.plot = plot(one.element, label, (c) => described(one, c, unit, onset), signal);
    }
  };
  const past = (history) => {
    for (const one of panels) {
      const of = history.residuals[one.i];
      if (!of) continue;
      one.trail = of.real.map((real, k) => (real === null ? null : [one.now.nominal_real + real, one.now.nominal_imag + of.imag[k], history.t[k]])).filter(Boolean);
    }
  };
  const trails = (paths, t) => {
    for (const one of panels) {
      const of = paths[one.i];
      if (of) one.trail = of.real.map((real, k) => (real === null ? null : [real, of.imag[k], t[k]])).filter(Boolean);
    }
  };
  const take = (responses, t, since) => {
    onset = since;
    for (const one of panels) {
      const next = responses[one.i];
      if (!next || next.real === null) continue;
      if (next.real !== one.now.real || next.imag !== one.now.imag) {
        one.trail.push([next.real, next.imag, t]);
        if (one.trail.length > TRAIL) one.trail.splice(0, one.trail.length - TRAIL);
      }
      one.now = next;
      one.plot?.draw();
    }
  };
  return { element, start, past, trails, take };
}

// Limits that hold what must be seen, and move only when it leaves them or fills too little of them.
function steady(before, values) {
  const low = Math.min(...values);
  const high = Math.max(...values);
  const room = 0.18 * (high - low) || 0.05 * Math.abs(high) || 1;
  if (before && low >= before[0] && high <= before[1] && high - low > 0.45 * (before[1] - before[0])) return before;
  return [low - room, high + room];
}

function described(one, c, unit, onset) {
  const { now } = one;
  const here = [now.real, now.imag];
  const healthy = [now.nominal_real, now.nominal_imag];
  const around = now.ellipse && now.real !== null ? outline(...here, ...now.ellipse) : [];
  const seen = [...one.trail, healthy, ...around, ...(now.real === null ? [] : [here])];
  one.x = steady(one.x, seen.map(([x]) => x));
  one.y = steady(one.y, seen.map(([, y]) => y));
  const tone = onset === null ? c.measured : c.alarm;
  const cut = onset === null ? one.trail.length : one.trail.filter(([, , t]) => t <= onset).length;
  const path = (name, data, colour) => ({ type: "line", name, data, showSymbol: false, silent: true, lineStyle: { color: colour, width: 0.8, opacity: 0.45 } });
  return {
    grid: { left: 66, right: 12, top: 8, bottom: 40 },
    tooltip: tooltip(c, { trigger: "item", formatter: ({ seriesName, value }) => `${seriesName}\n${translate("real part")} ${number(value[0], 5)}\n${translate("imaginary part")} ${number(value[1], 5)}` }),
    xAxis: axis(c, `real part${unit && ` [${unit}]`}`, { type: "value", min: one.x[0], max: one.x[1], splitNumber: 3, label: { formatter: ticks(...one.x), showMinLabel: false, showMaxLabel: false } }),
    yAxis: axis(c, `imaginary part${unit && ` [${unit}]`}`, { type: "value", min: one.y[0], max: one.y[1], splitNumber: 4, gap: 50, label: { formatter: ticks(...one.y), showMinLabel: false, showMaxLabel: false } }),
    series: [
      path("trail", one.trail.slice(0, cut + 1), c.measured),
      path("trail since the onset", one.trail.slice(cut), tone),
      { type: "line", name: "ellipse", data: around, showSymbol: false, silent: true, lineStyle: { color: tone, width: 1.2 } },
      { type: "scatter", name: translate("healthy"), data: [healthy], z: 6, symbol: "diamond", symbolSize: 12, itemStyle: { opacity: 1, color: c.paper, borderColor: c.ink, borderWidth: 1.3 } },
      { type: "scatter", name: translate("now"), data: now.real === null ? [] : [here], z: 7, symbolSize: 9, itemStyle: { opacity: 1, color: tone, borderColor: c.paper, borderWidth: 1 } },
    ],
  };
}
