// The inverse frequency response in the complex plane, a panel per frequency: healthy, where it is now with its ellipse, and its trail.
import { axis, outline, plot, tooltip } from "./charts.js";
import { h } from "./dom.js";
import { number } from "./words.js";

const TRAIL = 400; // points of a trail

// `responses` as the interface tells them; `take` moves on to newer ones, `past` puts a trail before them.
export function planes(responses, unit, signal) {
  const panels = responses.map((first, i) => {
    const element = h("div", { class: "plot" });
    return { element, title: h("h3", {}, `${number(first.frequency_hz, 3)} Hz`), i, now: first, trail: [], x: null, y: null };
  });
  const element = h("div", { class: "planes" }, panels.map((one) => h("div", {}, one.title, one.element)));
  let faulty = false;

  const start = (fault = false) => {
    faulty = fault;
    for (const one of panels) {
      const label = `Inverse response at ${number(one.now.frequency_hz, 3)} Hz in the complex plane`;
      one.plot = plot(one.element, label, (c) => described(one, c, unit, faulty), signal);
    }
  };
  const past = (history) => {
    for (const one of panels) {
      const of = history.residuals[one.i];
      if (!of) continue;
      one.trail = of.real.map((real, k) => (real === null ? null : [one.now.nominal_real + real, one.now.nominal_imag + of.imag[k]])).filter(Boolean);
    }
  };
  const trails = (paths) => {
    for (const one of panels) {
      const of = paths[one.i];
      if (of) one.trail = of.real.map((real, k) => (real === null ? null : [real, of.imag[k]])).filter(Boolean);
    }
  };
  const take = (responses, fault) => {
    faulty = fault;
    for (const one of panels) {
      const next = responses[one.i];
      if (!next || next.real === null) continue;
      if (next.real !== one.now.real || next.imag !== one.now.imag) {
        one.trail.push([next.real, next.imag]);
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

function described(one, c, unit, faulty) {
  const { now } = one;
  const here = [now.real, now.imag];
  const healthy = [now.nominal_real, now.nominal_imag];
  const around = now.ellipse && now.real !== null ? outline(...here, ...now.ellipse) : [];
  const seen = [...one.trail, healthy, ...around, ...(now.real === null ? [] : [here])];
  one.x = steady(one.x, seen.map(([x]) => x));
  one.y = steady(one.y, seen.map(([, y]) => y));
  const tone = faulty ? c.alarm : c.measured;
  return {
    grid: { left: 66, right: 12, top: 8, bottom: 40 },
    tooltip: tooltip(c, { trigger: "item", formatter: ({ seriesName, value }) => `${seriesName}\nreal ${number(value[0], 5)}\nimaginary ${number(value[1], 5)}` }),
    xAxis: axis(c, `real part${unit && ` [${unit}]`}`, { type: "value", min: one.x[0], max: one.x[1], splitNumber: 3, label: { formatter: tidy, showMinLabel: false, showMaxLabel: false } }),
    yAxis: axis(c, `imaginary part${unit && ` [${unit}]`}`, { type: "value", min: one.y[0], max: one.y[1], splitNumber: 4, gap: 50, label: { formatter: tidy, showMinLabel: false, showMaxLabel: false } }),
    series: [
      { type: "line", name: "trail", data: one.trail, showSymbol: false, silent: true, lineStyle: { color: tone, width: 1, opacity: 0.45 } },
      { type: "line", name: "95 % ellipse", data: around, showSymbol: false, silent: true, lineStyle: { color: tone, width: 1.2 } },
      { type: "scatter", name: "healthy", data: [healthy], symbol: "diamond", symbolSize: 12, itemStyle: { color: c.paper, borderColor: c.ink, borderWidth: 1.3 } },
      { type: "scatter", name: "now", data: now.real === null ? [] : [here], symbolSize: 9, itemStyle: { color: tone, borderColor: c.paper, borderWidth: 1 } },
    ],
  };
}

const tidy = (value) => number(Number(value.toPrecision(4)), 3).replace(/(\.\d*?)0+$/, "$1").replace(/\.$/, "");
