// Elements without markup in strings: what comes from outside is text, never HTML. What stands in the catalogue is shown in the
// reader's language; what is data, the name of a column for example, goes into an element with translate="no".
import { pieces, topic } from "./help.js";
import { translate } from "./translate.js";

export { translate };

const SPOKEN = ["aria-label", "title", "placeholder", "data-name"];
const SVG = "http://www.w3.org/2000/svg";

// h("p", { class: "note", onclick: f }, "text", element, [more]) -> an element; null and false are left out.
export function h(tag, attributes = {}, ...children) {
  return filled(document.createElement(tag), attributes, children);
}

export function s(tag, attributes = {}, ...children) {
  return filled(document.createElementNS(SVG, tag), attributes, children);
}

function filled(element, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name === "value") element.value = value;
    else element.setAttribute(name, value === true ? "" : SPOKEN.includes(name) ? translate(value) : value);
  }
  const shown = children.flat(Infinity).filter((child) => child !== null && child !== undefined && child !== false);
  if (element.tagName === "OPTION" && attributes.value === undefined) element.value = shown.join(""); // in no language
  element.append(...(attributes.translate === "no" ? shown : shown.map(translate)));
  return element;
}

// Text is only touched where it changes, so that a page at rest costs nothing.
export function tell(element, text) {
  const said = translate(text);
  if (element.textContent !== said) element.textContent = said;
}

export function mark(element, name, value) {
  const said = SPOKEN.includes(name) ? translate(value) : value;
  if (element.getAttribute(name) !== said) element.setAttribute(name, said);
}

// A table: head is a list of names, "*Name" for numbers; rows are lists of cells, elements or text.
export function table(caption, head, rows, attributes = {}) {
  const numeric = head.map((name) => name.startsWith("*"));
  // On a phone rows are cards, and each value says by itself what it is.
  const data = attributes.translate === "no" ? { translate: "no" } : {};
  const named = (element, i) => (element.setAttribute("data-name", data.translate ? head[i] : translate(head[i]?.replace("*", "") ?? "")), element);
  const cell = (content, i) =>
    content instanceof HTMLTableCellElement
      ? named(content, i)
      : i === 0
        ? h("th", { scope: "row" }, content)
        : named(h("td", { class: numeric[i] && "n" }, content instanceof Element ? content : h("span", {}, content)), i);
  return h(
    "div",
    { class: "scroll", tabindex: "0", role: "region", "aria-label": caption },
    h(
      "table",
      attributes,
      h("caption", { class: "hidden" }, caption),
      h("thead", {}, h("tr", {}, head.map((name, i) => (name ? h("th", { scope: "col", class: numeric[i] && "n", ...data }, data.translate ? name : name.replace("*", "")) : h("td", {}))))),
      h("tbody", {}, rows.map((row) => h("tr", {}, row.map(cell)))),
    ),
  );
}

// A labelled field of a form.
export function field(label, control, hint = null) {
  return h("label", { class: "field" }, h("span", {}, label), control, hint && h("small", {}, hint));
}

// A sentence in the reader's language, in which words of the glossary say what they mean.
export const explained = (text) => pieces(text).map(([piece, meaning]) => (meaning ? h("dfn", { title: meaning }, piece) : piece));

// What opens the documentation of a section.
export const help = (title) => h("a", { class: "help screen", href: topic(title), target: "_blank", hreflang: "en", "aria-label": `${translate("Help")}: ${translate(title)}` }, "?");

export function section(title, note, ...children) {
  const words = typeof note === "string" ? explained(translate(note)) : note;
  return h("section", {}, h("h2", {}, title), help(title), note && h("p", { class: "note" }, words), ...children);
}

// The same with controls beside the title.
export function titled(title, controls, ...children) {
  return h("section", {}, h("div", { class: "titled" }, h("h2", {}, title), controls, help(title)), ...children);
}

// What went wrong, said where it matters; screen readers hear it at once.
export function complaint(error) {
  return h("p", { class: "complaint", role: "alert" }, error.message ?? String(error));
}

// Ask in a dialog, which stays until `send` has taken what its fields hold, or is given up; resolves when it is closed.
export function ask(title, words, fields, send, note = null) {
  return new Promise((resolve) => {
    const failed = h("div", {});
    const submit = async (event) => {
      event.preventDefault();
      try {
        await send();
        dialog.close();
      } catch (error) {
        failed.replaceChildren(complaint(error));
      }
    };
    const actions = h("div", { class: "actions" }, h("button", { class: "first" }, words), h("button", { type: "button", onclick: () => dialog.close() }, "Cancel"));
    const form = h("form", { onsubmit: submit }, h("h2", { id: "asked" }, title), note && h("p", { class: "note" }, note), h("div", { class: "fields" }, fields), failed, actions);
    const dialog = h("dialog", { "aria-labelledby": "asked" }, form);
    dialog.addEventListener("close", () => (dialog.remove(), resolve()));
    document.body.append(dialog);
    dialog.showModal();
  });
}

// Does what a button asks for: its steps are told, what goes wrong is said, and at the end it can be pressed again.
export async function during(button, said, work, settle = () => (button.disabled = false)) {
  button.disabled = true;
  try {
    await work((step) => tell(said, `${step} …`));
    said.replaceChildren();
  } catch (error) {
    if (error.name !== "AbortError") said.replaceChildren(complaint(error));
  } finally {
    settle();
  }
}

// Lets the browser save what an address holds.
export function save(address, name) {
  h("a", { href: address, download: name }).click();
}
