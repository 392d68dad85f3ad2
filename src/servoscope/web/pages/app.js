// Around every page: navigation, theme, person, the state of the live link; then the page itself.
import * as api from "./api.js";
import { complaint, h, mark, translate, tell } from "./dom.js";
import { LANGUAGE, LANGUAGES } from "./language.js";

const PAGES = {
  "": ["Fleet", () => import("./fleet.js")],
  assets: ["Asset", () => import("./asset.js")],
  alarms: ["Alarms", () => import("./alarms.js")],
  begin: ["Begin with a log", () => import("./begin.js")],
  diagnose: ["Diagnose a recording", () => import("./diagnose.js")],
  diagnoses: ["Diagnosis", () => import("./diagnosis.js")],
  learn: ["Learn a baseline", () => import("./learn.js")],
  design: ["Before deployment", () => import("./design.js")],
  login: ["Log in", () => import("./login.js")],
};
const NAVIGATION = [
  ["/", "Fleet", ["", "assets"]],
  ["/alarms", "Alarms", ["alarms"]],
  ["/begin", "Begin", ["begin"]],
  ["/diagnose", "Diagnose", ["diagnose", "diagnoses"]],
  ["/learn", "Learn", ["learn"]],
  ["/design", "Design", ["design"]],
];
const ZONE = Intl.DateTimeFormat().resolvedOptions().timeZone;
document.cookie = `clock=${ZONE}; path=/; max-age=31536000; samesite=strict`; // dates in sentences are of this clock too
const [name, ...rest] = location.pathname.slice(1).split("/").map(decodeURIComponent);
const left = new AbortController();
const theme = h("button", { type: "button", class: "quiet theme", onclick: change });
const person = h("span", { class: "person" });
const link = h("span", { class: "link", role: "status" });
let asking = null; // a login that is under way

function dark() {
  const chosen = document.documentElement.dataset.theme;
  return chosen ? chosen === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
}

function named() {
  tell(theme, dark() ? "Light" : "Dark");
  mark(theme, "aria-label", `Switch to ${dark() ? "light" : "dark"} colours`);
}

function change() {
  const chosen = dark() ? "light" : "dark";
  document.documentElement.dataset.theme = chosen;
  try {
    localStorage.setItem("theme", chosen);
  } catch {
    // it holds until the page is left
  }
  named();
  dispatchEvent(new Event("themechange"));
}

// Of its own, so that somebody at a foreign computer finds it.
function languageSwitch() {
  const name = (code) => new Intl.DisplayNames([code], { type: "language" }).of(code);
  const select = h("select", { class: "quiet", "aria-label": "Language", translate: "no" }, LANGUAGES.map((code) => h("option", { value: code, lang: code, selected: code === LANGUAGE, translate: "no" }, name(code))));
  select.addEventListener("change", () => {
    document.cookie = `language=${select.value}; path=/; max-age=31536000; samesite=strict`;
    location.reload();
  });
  return select;
}

function surround() {
  document.documentElement.lang = LANGUAGE;
  tell(document.querySelector(".skip"), "Skip to content");
  named();
  const pages = name === "login" ? [] : NAVIGATION.map(([address, words, of]) => h("a", { href: address, "aria-current": of.includes(name) && "page" }, words));
  document
    .querySelector("header.top")
    .append(
      h("a", { class: "brand", href: "/" }, h("img", { src: "/static/icon.svg", alt: "", width: "22", height: "22" }), "servoscope"),
      h("nav", { "aria-label": "Pages" }, pages),
      link,
      h("span", { class: "person", title: "All times are of this time zone", translate: "no" }, ZONE),
      person,
      LANGUAGES.length > 1 && languageSwitch(),
      h("a", { class: "person", href: "/help", target: "_blank", hreflang: "en" }, "Help"),
      theme,
    );
}

function introduce(session) {
  if (!session.login_required) {
    person.replaceChildren(h("span", { title: "Only this machine reaches the pages, and it may do everything" }, "no login: this machine only"));
  } else if (session.user) {
    const out = h("button", { type: "button", class: "quiet", onclick: async () => (await api.logout(), logIn()) }, "Log out");
    // whom a proxy has signed in has no session to end here
    person.replaceChildren(h("span", {}, `${session.user}, ${session.role}`), ...(session.csrf ? [out] : []));
  }
}

function logIn() {
  location.assign(`/login?next=${encodeURIComponent(location.pathname + location.search)}`);
}

// Over the page, once however many ask; whoever gives up finds the page as it was.
function logInAgain() {
  asking ??= import("./login.js")
    .then(({ again }) => again())
    .then((session) => session && (introduce(session), true))
    .finally(() => (asking = null));
  return asking;
}

const LINK = { live: "Live", quiet: "Nothing new: does the service run?", lost: "Connection lost, trying again" };

// Whether what is on the page is still being told: words, beside the navigation.
function linked(state) {
  mark(link, "data-state", state);
  tell(link, LINK[state]);
  mark(link, "title", LINK[state]);
}

function entitle(title) {
  document.title = `${translate(title)} · servoscope`;
}

async function start() {
  surround();
  const main = document.getElementById("main");
  addEventListener("pagehide", (event) => event.persisted || left.abort());
  addEventListener("pageshow", (event) => event.persisted && location.reload());
  try {
    const [title, load] = PAGES[name] ?? ["No such page", () => import("./missing.js")];
    entitle(title);
    const [session, page] = await Promise.all([api.session(), load()]);
    introduce(session);
    if (session.login_required && !session.user && name !== "login") return logIn();
    api.whenSessionEnds(logInAgain);
    addEventListener("streamclosed", async () => {
      const again = await api.session().catch(() => session); // no answer: not a matter of who is asking
      if (!again.user) logInAgain();
    });
    await page.show(main, { session, entitle, linked, signal: left.signal, part: rest.join("/"), values: new URLSearchParams(location.search) });
  } catch (error) {
    if (left.signal.aborted) return;
    if (error.status === 401) return logIn();
    if (!(error instanceof api.Problem)) console.error(error);
    main.append(complaint(error));
  }
}

start();
