// What every chart can do: zoom and pan by buttons or by hand, save as PNG or CSV, and an address that opens the same view.
import { h, save, translate } from "./dom.js";

const STEP = 0.5; // of what is seen, by one press
const dated = new Set(); // charts over the time of day: they look at the same part of it

// Zoom by Ctrl and the wheel or two fingers, pan by dragging; what is left out of view still shapes the lines. A finger
// that moves up or down scrolls the page (touch-action in the style sheet): charts are as wide as a phone.
export function zoomed({ xAxis, yAxis, tooltip }) {
  const inside = { type: "inside", zoomOnMouseWheel: "ctrl", preventDefaultMouseMove: false, filterMode: "none" };
  const every = (axes) => [axes].flat().map((_, i) => i);
  const plane = tooltip.trigger === "item"; // without a time: both axes move
  return [{ ...inside, xAxisIndex: every(xAxis) }, ...(plane ? [{ ...inside, yAxisIndex: every(yAxis) }] : [])];
}

export function tools(chart, label, { image, csv, moved, clock, signal }) {
  const key = `view-${label.toLowerCase().replace(/[^a-z0-9]+/g, "-")}`;
  const all = () => chart.getOption().dataZoom.map(({ start, end }) => [start, end]);
  const go = (spans) => spans.forEach(([start, end], dataZoomIndex) => chart.dispatchAction({ type: "dataZoom", dataZoomIndex, start, end }));
  const seen = ([start, end], width, shift) => {
    const half = Math.min(width * (end - start), 100) / 2;
    const middle = Math.min(Math.max((start + end) / 2 + shift * (end - start), half), 100 - half);
    return [middle - half, middle + half];
  };
  const step = (width, shift = 0) => () => go(all().map((span, i) => seen(span, width, i ? 0 : shift)));
  const button = (words, title, press) => h("button", { type: "button", class: "filter", "aria-label": `${translate(title)}: ${translate(label)}`, title, onclick: press }, words);
  const text = () => (csv ? csv() : drawn(chart));
  const name = label.replace(/[^\w.-]+/g, " ").trim();

  // The address keeps the view as shares of the axes in percent, so that it holds for live data too.
  function remember() {
    const told = new URLSearchParams(location.search);
    const spans = all();
    const whole = spans.every(([start, end]) => start <= 0 && end >= 100);
    whole ? told.delete(key) : told.set(key, spans.flat().map((each) => Number(each.toFixed(3))).join());
    history.replaceState(null, "", told.size ? `${location.pathname}?${told}` : location.pathname);
    const { startValue, endValue } = chart.getOption().dataZoom[0];
    const seen = whole ? null : [startValue, endValue];
    moved?.(seen);
    if (clock) for (const other of dated) if (other !== follow) other(seen);
  }

  // What another chart looks at, as far as there is something of it here; only that chart's view goes into the address.
  let led = false;
  function follow(seen) {
    const { min, max } = chart.getOption().xAxis[0];
    const [start, end] = seen ? [Math.max(seen[0], min ?? seen[0]), Math.min(seen[1], max ?? seen[1])] : [];
    if (seen && !(start < end)) return;
    led = true;
    chart.dispatchAction({ type: "dataZoom", dataZoomIndex: 0, ...(seen ? { startValue: start, endValue: end } : { start: 0, end: 100 }) });
    led = false;
    moved?.(seen && [start, end]);
  }
  if (clock) dated.add(follow);

  let waiting = 0;
  chart.on("datazoom", () => led || (clearTimeout(waiting), (waiting = setTimeout(remember, 200))));
  signal.addEventListener("abort", () => (clearTimeout(waiting), dated.delete(follow)));
  const before = new URLSearchParams(location.search).get(key)?.split(",").map(Number);
  if (before?.length && before.length % 2 === 0 && before.every(Number.isFinite)) go(Array.from({ length: Math.min(before.length / 2, all().length) }, (_, i) => before.slice(2 * i, 2 * i + 2)));
  return h(
    "details",
    { class: "tools screen" },
    h("summary", { "aria-label": `${translate("View and save")}: ${translate(label)}` }, "View, save"),
    h(
      "div",
      {},
      button("+", "Zoom in", step(STEP)),
      button("−", "Zoom out", step(1 / STEP)),
      button("◀", "Earlier", step(1, -STEP)),
      button("▶", "Later", step(1, STEP)),
      button("All", "Show all", () => go(all().map(() => [0, 100]))),
      button("PNG", "Save the picture", () => save(image(), `${name}.png`)),
      button("CSV", "Save the values", () => save(URL.createObjectURL(new Blob([text()], { type: "text/csv" })), `${name}.csv`)),
      button("Link", "Copy the address of this view", () => (remember(), navigator.clipboard?.writeText(location.href))),
    ),
  );
}

// All lines and dots of a chart, one value a row; of a band its upper edge, not its width.
function drawn(chart) {
  const { series, xAxis } = chart.getOption();
  const rows = series.flatMap((one, i) => {
    const dated = xAxis[one.xAxisIndex ?? 0].type === "time";
    const base = one.name === "width" ? series[i - 1].data : null;
    const cells = ([x, y], k) => [`"${(base ? "high" : one.name).replaceAll('"', '""')}"`, dated ? new Date(x).toISOString() : x, y === null ? "" : base ? y + base[k][1] : y].join();
    return one.data.map(cells);
  });
  return ["what,x,y", ...rows, ""].join("\n");
}
