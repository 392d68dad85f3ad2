// What the pages say, in the reader's language: looked up by its English in the server's catalogue, as it is where nobody translated it.
import { LANGUAGE, WORDS } from "./language.js";

const EXACT = new Map(Object.entries(WORDS));
// Of "{0#} rows of {1}" the text around its values: {0} anything, {0#} a number with its unit, {0!w} words that are looked up themselves.
const VALUE = /\{(\d)(#|!w)?\}/g;
const NUMERIC = "([^\\p{L}]*(?:[\\p{L}/²·°]{1,5})?[^\\p{L}]*)";
const shapeOf = (english) => new RegExp(`^${english.replace(/[.*+?^$()|[\]\\/]/g, "\\$&").replace(VALUE, (_, i, kind) => (kind === "#" ? NUMERIC : "(.*?)"))}$`, "su");
const PATTERNS = [...EXACT].filter(([english]) => /\{\d/.test(english)).map(([english, text]) => ({ shape: shapeOf(english), text }));
const SEEN = new Map(); // what patterns had to be tried for
const MANY = 2000;

export function translate(text) {
  if (LANGUAGE === "en" || typeof text !== "string" || !/\p{L}{2}/u.test(text)) return text;
  const bare = text.trim();
  const known = EXACT.get(bare) ?? SEEN.get(bare) ?? composed(bare);
  return known === bare ? text : text.replace(bare, () => known);
}

function composed(text) {
  const small = EXACT.get(text.charAt(0).toLowerCase() + text.slice(1)); // a heading of a fault's words
  let found = small ? small.charAt(0).toUpperCase() + small.slice(1) : text;
  for (const { shape, text: translated } of small ? [] : PATTERNS) {
    const values = shape.exec(text);
    if (!values) continue;
    found = translated.replace(VALUE, (_, i, kind) => (kind === "!w" ? translate(values[Number(i) + 1]) : values[Number(i) + 1]));
    break;
  }
  if (SEEN.size > MANY) SEEN.clear(); // numbers that come and go
  SEEN.set(text, found);
  return found;
}
