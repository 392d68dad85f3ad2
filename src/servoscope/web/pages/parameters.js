// Estimated coefficients with their intervals, as a table whose numbers move without the page moving.
import { h, mark, tell } from "./dom.js";
import { prose } from "./marks.js";
import { DASH, signed, withStd } from "./words.js";

const HEADS = ["Name", "Estimate ± 2σ", "Unit", "Healthy", "Change", "In σ", "95 % interval"];
const WIDTH = 160; // px of the picture of an interval

export function parameters(first) {
  const rows = first.map((one) => {
    const cells = { value: h("td", { class: "n" }), nominal: h("td", { class: "n" }), change: h("td", { class: "n" }), sigma: h("td", { class: "n" }) };
    const band = h("i");
    const dot = h("b");
    const picture = h("td", {}, h("span", { class: "interval", "aria-hidden": "true" }, band, dot));
    const unit = h("td", { class: "unit" }, one.unit || DASH);
    [cells.value, unit, cells.nominal, cells.change, cells.sigma, picture].forEach((cell, i) => mark(cell, "data-name", HEADS[i + 1]));
    return { name: one.name, cells, band, dot, element: h("tr", {}, h("th", { scope: "row" }, prose(one.name)), cells.value, unit, cells.nominal, cells.change, cells.sigma, picture) };
  });
  const element = h(
    "div",
    { class: "scroll", tabindex: "0", role: "region", "aria-label": "Coefficients" },
    h("table", {}, h("thead", {}, h("tr", {}, HEADS.map((name, i) => h("th", { scope: "col", class: i > 0 && i < 6 && i !== 2 && "n" }, name)))), h("tbody", {}, rows.map((row) => row.element))),
  );

  function update(all) {
    const widest = Math.max(3, ...all.map((one) => Math.max(Math.abs(one.low - one.nominal), Math.abs(one.high - one.nominal)) / (one.std || Infinity)).filter(Number.isFinite));
    const scale = 2 ** Math.ceil(Math.log2(widest)); // in standard deviations; in steps, so that it rests
    rows.forEach((row, i) => {
      const one = all[i];
      if (!one || one.value === null) return;
      const [value, spread, nominal] = withStd(one.value, 2 * one.std, one.nominal);
      const share = one.nominal ? (100 * (one.value - one.nominal)) / Math.abs(one.nominal) : null;
      const sigma = one.std > 0 ? (one.value - one.nominal) / one.std : null;
      tell(row.cells.value, `${value} ± ${spread}`);
      tell(row.cells.nominal, nominal);
      tell(row.cells.change, share === null ? DASH : `${signed(share, Math.abs(share) < 10 ? 2 : 1)} %`);
      tell(row.cells.sigma, sigma === null ? DASH : signed(sigma, Math.abs(sigma) < 100 ? 1 : 0));
      row.element.classList.toggle("first", Math.abs(sigma) > 5);
      const place = (x) => WIDTH * Math.min(Math.max(0.5 + (x - one.nominal) / one.std / scale / 2, 0), 1);
      row.band.style.left = `${place(one.low).toFixed(1)}px`;
      row.band.style.width = `${Math.max(place(one.high) - place(one.low), 2).toFixed(1)}px`;
      row.dot.style.left = `${place(one.value).toFixed(1)}px`;
    });
  }
  update(first);
  return { element, update };
}
