// ECharts in the look of the report: its colours, its axes, no animation; drawn anew when the theme changes.
import "./vendor/echarts.common.min.js";
import { tools, zoomed } from "./chart_tools.js";
import { translate } from "./dom.js";

const NAMES = ["paper", "panel", "ink", "muted", "rule", "measured", "healthy", "alarm", "reference", "care", "check"];
const LETTERS = getComputedStyle(document.documentElement).getPropertyValue("--letters");
const plots = new Set();

// The colours that hold now: custom properties with light-dark() are only resolved where they are used.
export function colours() {
  const probe = document.body.appendChild(document.createElement("i"));
  const found = {};
  for (const name of NAMES) {
    probe.style.color = `var(--${name})`;
    found[name] = getComputedStyle(probe).color;
  }
  probe.remove();
  return found;
}

// A plot in an element of fixed height. `describe(colours)` returns an option; call `draw` when its data have changed.
// Beneath it stand zoom, pan and export; `csv` returns the values as text, else those that are drawn are saved, and
// `moved` hears what part of the first axis is looked at: [from, to], null for all of it. With `clock`, charts zoom together.
export function plot(element, label, describe, signal, { csv = null, moved = null, clock = false } = {}) {
  const chart = globalThis.echarts.init(element, null, { renderer: "canvas" });
  let wanted = 0;
  const now = () => {
    wanted = 0;
    const c = colours();
    const option = { ...base(c), ...describe(c) };
    chart.setOption({ ...option, dataZoom: zoomed(option) }, { replaceMerge: ["series"] });
  };
  const draw = () => {
    wanted ||= requestAnimationFrame(now);
  };
  // On paper the style sheet scales what was drawn: a plot whose height follows its picture must not shape that picture.
  const watcher = new ResizeObserver(() => matchMedia("print").matches || chart.resize());
  watcher.observe(element);
  element.setAttribute("role", "img");
  element.setAttribute("aria-label", translate(label));
  const image = () => (now(), chart.getZr().flush(), chart.getDataURL({ pixelRatio: 2, backgroundColor: colours().paper }));
  const one = { draw, print: () => (now(), chart.getZr().flush()) };
  plots.add(one);
  signal.addEventListener("abort", () => {
    cancelAnimationFrame(wanted);
    watcher.disconnect();
    plots.delete(one);
    chart.dispose();
  });
  now();
  element.after(tools(chart, label, { image, csv, moved, clock, signal }));
  return one;
}

export function redraw() {
  for (const one of plots) one.draw();
}
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
addEventListener("themechange", redraw);

// Paper is light, and does not wait for the next frame.
let chosen = null;
addEventListener("beforeprint", () => {
  chosen = document.documentElement.dataset.theme ?? null;
  document.documentElement.dataset.theme = "light";
  for (const one of plots) one.print();
});
addEventListener("afterprint", () => {
  if (chosen) document.documentElement.dataset.theme = chosen;
  else delete document.documentElement.dataset.theme;
  redraw();
});

function base(c) {
  return {
    animation: false,
    textStyle: { fontFamily: LETTERS, fontSize: 12, color: c.ink },
    grid: { left: 62, right: 14, top: 30, bottom: 40 },
    tooltip: tooltip(c),
  };
}

// Drawn in the canvas: HTML would need inline styles, which the policy forbids.
export function tooltip(c, rest = {}) {
  return {
    trigger: "axis",
    renderMode: "richText",
    backgroundColor: c.panel,
    borderColor: c.rule,
    textStyle: { color: c.ink, fontFamily: LETTERS, fontSize: 12 },
    axisPointer: { lineStyle: { color: c.muted } },
    confine: true,
    ...rest,
  };
}

export function legend(c, data) {
  return { data: data.map(translate), top: 0, left: 0, itemWidth: 18, itemHeight: 8, icon: "roundRect", textStyle: { color: c.ink, fontSize: 12 }, inactiveColor: c.muted };
}

export function axis(c, name, rest = {}) {
  return {
    name: translate(name),
    nameLocation: "middle",
    nameGap: rest.gap ?? 26,
    nameTextStyle: { color: c.ink, fontSize: 12 },
    axisLine: { show: true, onZero: false, lineStyle: { color: c.muted } },
    axisTick: { lineStyle: { color: c.muted } },
    axisLabel: { color: c.ink, fontSize: 11, hideOverlap: true, ...rest.label },
    splitLine: { show: true, lineStyle: { color: c.rule, width: 0.6 } },
    ...rest,
  };
}

export function line(name, data, colour, rest = {}) {
  return { type: "line", name: translate(name), data, color: colour, showSymbol: false, lineStyle: { width: 1.4, color: colour, ...rest.stroke }, ...rest };
}

// The outline of an ellipse around a point: half axes, and the angle of the first of them.
export function outline(x, y, a, b, angle, steps = 64) {
  return Array.from({ length: steps + 1 }, (_, i) => {
    const phi = (2 * Math.PI * i) / steps;
    const p = a * Math.cos(phi);
    const q = b * Math.sin(phi);
    return [x + p * Math.cos(angle) - q * Math.sin(angle), y + p * Math.sin(angle) + q * Math.cos(angle)];
  });
}
