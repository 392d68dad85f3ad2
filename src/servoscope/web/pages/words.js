// Numbers, times and names as people read them: digits, units, signs, symbols; as the report says them.

export const DASH = "–";
const GREEK = { theta: "θ", beta: "β", rho: "ρ" };
const SUBSCRIPT = "₀₁₂₃₄₅₆₇₈₉";
const SUPERSCRIPT = "⁰¹²³⁴⁵⁶⁷⁸⁹";

const PERCENT = "\u00a0%"; // a number and its unit stay on one line
const minus = (text) => text.replaceAll("-", "−");
// With so many decimals; what they round to zero has no sign.
const fixed = (value, places) => {
  const text = value.toFixed(places);
  return Number(text) === 0 ? text.replace("-", "") : minus(text);
};
const power = (exponent) => ` × 10${exponent < 0 ? "⁻" : ""}${[...String(Math.abs(exponent))].map((c) => SUPERSCRIPT[c]).join("")}`;

// So many significant digits; very small and large ones as powers of ten.
export function number(value, digits = 4) {
  if (value === null || value === undefined || !Number.isFinite(value)) return DASH;
  if (value === 0) return "0";
  const exponent = Math.floor(Math.log10(Math.abs(Number(value.toPrecision(digits))))); // of what is shown: 0.9999 is 1.00
  if (exponent >= -4 && exponent < 6) return minus(value.toFixed(Math.max(digits - 1 - exponent, 0)));
  return minus((value / 10 ** exponent).toFixed(digits - 1)) + power(exponent);
}

// How many decimals show the first digit of an uncertainty, or two where they are below 35.
const decimals = (uncertainty) => (uncertainty > 0 ? Math.min(Math.max(-Math.floor(Math.log10(uncertainty / 3.5)), 0), 7) : 3);

const scaled = (digits, exponent) => (exponent && Number(digits.replace("−", "-")) !== 0 ? digits + power(exponent) : digits);

// A value and its standard deviation, both to the digits that the deviation supports.
export function withStd(value, std, ...others) {
  const values = [value, std, ...others];
  if (!(Number.isFinite(value) && Number.isFinite(std) && std > 0)) return values.map((each) => number(each));
  const top = Math.max(...values.filter(Number.isFinite).map(Math.abs));
  let exponent = top > 0 ? Math.floor(Math.log10(top)) : 0;
  if (exponent >= -3 && exponent < 6) exponent = 0;
  const places = decimals(std / 10 ** exponent);
  return values.map((each) =>
    Number.isFinite(each) ? scaled(fixed(each / 10 ** exponent, places), exponent) : DASH,
  );
}

// With its sign, and so many decimals.
export function signed(value, decimals) {
  const text = fixed(value, decimals);
  return (Number(text) > 0 ? "+" : "") + text;
}

// Marks of an axis: as many decimals as its range asks for.
export function ticks(low, high) {
  const places = Math.max(0, 1 - Math.floor(Math.log10(high - low || 1)));
  const far = Math.max(Math.abs(low), Math.abs(high));
  return places > 6 || far >= 1e6 ? (value) => number(value, 3) : (value) => minus(value.toFixed(places));
}

export function count(value) {
  return String(value ?? 0).replace(/\B(?=(\d{3})+$)/g, "\u2009");
}

export function probability(value) {
  if (value === null || value === undefined) return DASH;
  if (value > 0.999) return `> 99.9${PERCENT}`;
  return value < 0.001 ? `< 0.1${PERCENT}` : `${(100 * value).toFixed(1)}${PERCENT}`;
}

// A fault's size with its interval: +20 %, or a factor where it is large; to the digits that the interval supports.
export function size(fault) {
  const values = [fault.ratio, ...fault.interval];
  const percent = fault.parameter !== "severity" && values.every((each) => each >= 0.2 && each < 3);
  const scale = percent ? 100 : 1;
  const places = decimals((scale * (values[2] - values[1])) / 2);
  return values.map((each) => {
    if (!percent) return minus(`× ${each.toFixed(places)}`);
    const change = (100 * (each - 1)).toFixed(places);
    return minus(`${change.startsWith("-") ? "" : "+"}${change}${PERCENT}`);
  });
}

// From which ratio on something holds: as +2.5 %, as a factor where it is far from one; null: never.
export function change(ratio) {
  if (ratio === null || ratio === undefined) return "never";
  if (ratio <= 0.5 || ratio >= 2) return `× ${number(ratio, 3)}`;
  const percent = Number((100 * (ratio - 1)).toPrecision(3));
  return minus(`${percent > 0 ? "+" : ""}${percent}${PERCENT}`);
}

// A multiple of a limit, at a width that does not jump.
export function multiple(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return DASH;
  if (value >= 1000) return "> 999";
  return value >= 100 ? value.toFixed(0) : value >= 10 ? value.toFixed(1) : value.toFixed(2);
}

// A number as it was set: no more digits than it has.
export function general(value) {
  return value === null || value === undefined ? DASH : minus(String(Number(value.toPrecision(6))));
}

export function plain(name) {
  return String(name).replaceAll("_", " ");
}

// With a capital at its beginning, unless that is a symbol: p_s is not P_s.
export function capital(text) {
  return /^[a-z]{1,2}_/.test(text) ? text : text.slice(0, 1).toUpperCase() + text.slice(1);
}

// A sentence of the service as these pages say it: symbols, true signs, numbers as elsewhere, no unit on the next line. Names
// become words, but for those of settings, which must be copied as they are.
export function sentence(text) {
  return (text ?? "")
    .replace(/\b(theta|beta|rho)(?:_(\d+))?\b/g, (_, name, index) => GREEK[name] + [...(index ?? "")].map((c) => SUBSCRIPT[c]).join(""))
    .replace(/\bx (?=\d)/g, "× ")
    .replaceAll("T^2", "T²")
    .replace(/(?<![\w.])(\d(?:\.\d+)?)e[+-]\d+\b/g, (told, digits) => number(Number(told), digits.replace(".", "").length))
    .replace(/(?<![\w.-])-(?=0(?:\.0*)?(?![\d.]))/g, "")
    .replace(/(?<![\w.-])-(?=\d)/g, "−")
    .replace(/(?<=\d) ?%/g, PERCENT)
    .replace(/(?<=\d) (?=(?:m?s|min|h|d|k?Hz|m?m|m?A|m?V|k?N)(?!\w))/g, "\u00a0")
    .replace(/\b(?!model_error\b)[a-z]{3,}(?:_[a-z]+)+\b(?! =)/g, plain);
}

const pad = (value) => String(value).padStart(2, "0");

// A moment [UTC s] in the reader's own time zone.
export function moment(t, { seconds = true, fraction = 0 } = {}) {
  if (t === null || t === undefined) return DASH;
  const at = new Date(1000 * t);
  const day = `${at.getFullYear()}-${pad(at.getMonth() + 1)}-${pad(at.getDate())}`;
  const rest = fraction ? (at.getMilliseconds() / 1000).toFixed(fraction).slice(1) : "";
  return `${day} ${pad(at.getHours())}:${pad(at.getMinutes())}${seconds ? `:${pad(at.getSeconds())}${rest}` : ""}`;
}

export function duration(seconds) {
  if (seconds === null || seconds === undefined || !Number.isFinite(seconds)) return DASH;
  if (seconds < 0) return "0 s";
  if (seconds < 100) return `${Math.round(seconds)} s`;
  if (seconds < 5400) return `${Math.round(seconds / 60)} min`;
  return seconds < 172800 ? `${Math.round(seconds / 3600)} h` : `${Math.round(seconds / 86400)} d`;
}

export function unit(name) {
  return name ? ` [${name}]` : "";
}
