// States as shapes: colour is never the only thing that tells them apart.
import { explained, h, s, translate } from "./dom.js";
import { sentence } from "./words.js";

const SHAPES = {
  fault: ["M12 2 23 21.5H1Z", "M12 9v6M12 17.4v1.6"],
  suspect: ["M12 2 23 21.5H1Z", "M12 9v6M12 17.4v1.6"],
  healthy: ["M12 1a11 11 0 1 0 0 22a11 11 0 1 0 0-22Z", "m6.5 12.5 3.8 3.8 7.2-8"],
  undetermined: ["M12 1a11 11 0 1 0 0 22a11 11 0 1 0 0-22Z", "M6 12h12"],
  failure: ["M7.4 1.5h9.2l6 6v9l-6 6H7.4l-6-6v-9Z", "M8 8l8 8M16 8l-8 8"],
  maintenance_required: ["M12 1 23 12 12 23 1 12Z", "M12 7v6M12 15.6v1.6"],
  out_of_specification: ["M12 2 23 21.5H1Z", "M9.4 10.2c.3-3.4 5.4-3 4.8.3-.3 1.8-2.2 1.7-2.2 4M12 17.4v1.6"],
  function_check: ["M2.5 2.5h19v19h-19Z", "M8 12h8M12 8v8"],
  good: ["M12 1a11 11 0 1 0 0 22a11 11 0 1 0 0-22Z", "m6.5 12.5 3.8 3.8 7.2-8"],
  stop: ["M7.4 1.5h9.2l6 6v9l-6 6H7.4l-6-6v-9Z", "M8 8l8 8M16 8l-8 8"],
  care: ["M12 2 23 21.5H1Z", "M12 9v6M12 17.4v1.6"],
  note: ["M12 1a11 11 0 1 0 0 22a11 11 0 1 0 0-22Z", "M12 10.5v7M12 6.500v1.6"],
};
export const VERDICTS = { fault: translate("Fault"), suspect: translate("Suspect"), undetermined: translate("Undetermined"), healthy: translate("Healthy") };
export const STATUS = {
  failure: translate("Failure"),
  function_check: translate("Function check"),
  out_of_specification: translate("Out of specification"),
  maintenance_required: translate("Maintenance required"),
  good: translate("Good"),
};
export const PRIORITIES = ["critical", "high", "medium", "low"];

// The shape alone; what it means must stand beside it, or in `words`.
export function mark(kind, words = null) {
  const [body, cut] = SHAPES[kind] ?? SHAPES.undetermined;
  const named = words ? { role: "img", "aria-label": words } : { "aria-hidden": "true" };
  return s("svg", { class: `mark ${kind}`, viewBox: "0 0 24 24", ...named }, s("path", { d: body }), s("path", { d: cut, class: "cut" }));
}

// Shape and words together.
export function badge(kind, words) {
  return h("span", { class: `badge ${kind}` }, mark(kind), h("span", {}, words));
}

export function priority(name) {
  const bars = PRIORITIES.length - Math.max(PRIORITIES.indexOf(name), 0);
  return h("span", { class: `priority ${name}` }, h("span", { class: "bars", "aria-hidden": "true" }, "▮".repeat(bars) + "▯".repeat(4 - bars)), " ", name);
}

// A sentence, or a name, with its parameters as symbols: C_ie with a subscript.
export function prose(text) {
  return sentence(translate(text))
    .split(/\b([A-Za-z]{1,2}_[A-Za-z]\w{0,2})\b/)
    .flatMap((part, i) => {
      if (i % 2 === 0) return explained(part);
      const [letter, index] = part.split("_");
      return h("span", {}, h("i", {}, letter), h("sub", {}, index));
    });
}

// The same in place, where it changes.
export function say(element, text) {
  if (element.dataset.text === text) return;
  element.dataset.text = text;
  element.replaceChildren(...prose(text));
}
