// A document as the server makes it of a result: the verdict with what to check, sections, and folded what experts ask for.
import { h, help, section, table } from "./dom.js";
import { mark, prose } from "./marks.js";

const [HEADLINE, EVIDENCE, DETAILS] = [0, 1, 2];

// The verdict in one sentence, below it what to do (`action` adds to that), then the facts.
export function verdict(kind, sections, action = null) {
  const [first, ...others] = sections;
  const of = (wanted) => first.body.filter((it) => (it.kind === "notes") === wanted);
  const todo = others.filter((one) => one.level === HEADLINE);
  return h(
    "div",
    { class: `verdict ${kind}`, role: "region", "aria-label": "Verdict" },
    h("h2", {}, mark(kind), " ", h("span", {}, prose(first.title.charAt(0).toUpperCase() + first.title.slice(1)))),
    help("Verdict"),
    of(true).flatMap((it) => it.texts.map((text) => h("p", { class: "summary" }, prose(text)))),
    todo.map((one) => [h("h3", {}, one.title), one.body.map((it) => part(it, one.title))]),
    action,
    of(false).map((it) => part(it, first.title)),
  );
}

// What a verdict says but for its values, which change every second: "for 212 s".
export const outline = (kind, sections) => JSON.stringify([kind, sections], (key, value) => (key === "facts" ? value.map((fact) => fact.name) : value));

// Draw the values of a verdict of the same outline anew; what a reader has unfolded or writes in stays.
export function refresh(element, sections) {
  const facts = verdict("", sections).querySelectorAll("dl.facts");
  element.querySelectorAll("dl.facts").forEach((old, i) => old.isEqualNode(facts[i]) || old.replaceWith(facts[i]));
}

// The sections of a level; `pictures` draws one by name into an element, or has none of it.
export function drawn(sections, level, pictures = {}) {
  return sections
    .filter((one) => one.level === level)
    .map((one) => [one, one.body.map((it) => (it.kind === "picture" ? pictures[it.name]?.() : part(it, one.title))).filter(Boolean)])
    .filter(([, body]) => body.length)
    .map(([one, body]) => section(one.title, one.lead && prose(one.lead), ...body));
}

export const evidence = (sections, pictures) => drawn(sections, EVIDENCE, pictures);

// What is folded away is made when somebody unfolds it: a picture needs its size.
export function experts(make, attached = () => {}) {
  const inside = h("div", { class: "columns" });
  const element = h("details", { class: "experts" }, h("summary", {}, "For experts"), inside);
  const unfold = () => {
    if (element.open && !inside.childElementCount) (inside.append(...make()), attached());
  };
  element.addEventListener("toggle", unfold);
  // on paper nobody unfolds anything
  addEventListener("beforeprint", () => ((element.open = true), unfold()));
  return element;
}

export const details = (sections, pictures) => drawn(sections, DETAILS, pictures);

function part(it, title) {
  if (it.kind === "facts") return h("dl", { class: "facts" }, it.facts.map(({ name, value, lines }) => h("div", {}, h("dt", {}, name), h("dd", {}, h("b", {}, prose(value)), lines.map((line) => h("small", {}, prose(line)))))));
  if (it.kind === "notes") return h(it.ordered ? "ol" : "ul", { class: "why" }, it.texts.map((text) => h("li", {}, prose(text))));
  const head = it.head.map((name, i) => (i < it.words ? name : `*${name}`));
  return table(`${title}: ${it.head[0]}`, head, it.rows.map((row) => row.map(cell)));
}

const cell = (text) => h("span", {}, text.split("\n").map((line, i) => [i > 0 && h("br"), prose(line)]));
