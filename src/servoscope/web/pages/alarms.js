// Alarms that are not normal, the most urgent first, with what to do about them; and what has happened to alarms.
import { get, mayChange, part, query } from "./api.js";
import { commands, sendCommand, STATES } from "./commands.js";
import { h, section, table, tell, translate } from "./dom.js";
import { follow } from "./live.js";
import { outlets } from "./notifications.js";
import { priority, prose } from "./marks.js";
import { DASH, duration, moment, plain } from "./words.js";

const OFTEN_MS = 1000; // between two looks at all alarms while they change

export async function show(main, { session, signal, linked, values }) {
  const asset = values.get("asset") ?? "";
  const standing = h("div", {});
  const past = h("div", {});
  const said = h("p", { class: "working", role: "status" });
  const flood = h("p", { class: "complaint", hidden: true, role: "status" });
  const state = h("select", {}, h("option", { value: "" }, "All"), h("option", { value: "open" }, "To acknowledge"), h("option", { value: "aside" }, "Shelved, suppressed, out of service"));
  const search = h("input", { type: "search", value: asset, placeholder: "Search", "aria-label": "Search alarms" });
  state.setAttribute("aria-label", translate("Show"));
  let waiting = []; // of those shown: search and choice say which
  const all = h("button", { type: "button", hidden: true, onclick: () => answerAll() });
  let alarms = [];
  let now = 0;
  let mark = "";

  main.replaceChildren(
    h("div", { class: "head" }, h("h1", {}, "Alarms"), h("span", { class: "gap" }), all, state, search),
    flood,
    standing,
    said,
    ...[await outlets(session, signal)].filter(Boolean),
    section("What has happened", "Every step of every alarm, with its cause and who wanted it.", past),
  );
  state.addEventListener("change", draw);
  search.addEventListener("input", draw);

  const heard = (words) => {
    tell(said, words ?? "Done.");
    look().catch(() => {}); // what went wrong with the command is said already
  };

  async function answerAll() {
    all.disabled = true;
    const answers = Promise.all(waiting.map((one) => sendCommand(one, "acknowledge", {})));
    await answers.then((said) => heard(said.find(Boolean) ?? null), (error) => heard(error.message));
    all.disabled = false;
  }

  function draw() {
    const wanted = search.value.trim().toLowerCase();
    const shown = alarms.filter((one) => {
      const aside = ["shelved", "suppressed_by_design", "out_of_service"].includes(one.state);
      const open = one.commands.includes("acknowledge");
      const text = `${one.asset} ${one.alarm} ${one.cause} ${one.priority}`.toLowerCase();
      return (!state.value || (state.value === "open" ? open : aside)) && text.includes(wanted);
    });
    waiting = mayChange(session.role, "operator") ? shown.filter((one) => one.commands.includes("acknowledge")) : [];
    all.hidden = waiting.length < 2;
    tell(all, `Acknowledge these ${waiting.length}`);
    const focused = document.activeElement?.getAttribute?.("aria-label");
    standing.replaceChildren(
      shown.length
        ? table(
            "Alarms, the most urgent first",
            ["Alarm", "Priority", "State", "Since", "Cause", "What to do", "Answer"],
            shown.map((one) => row(one)),
            { class: "stacked" },
          )
        : h("p", { class: "empty" }, alarms.length ? "No alarm is like this." : "Nothing asks for an answer."),
    );
    if (focused) standing.querySelector(`[aria-label="${CSS.escape(focused)}"]`)?.focus(); // it was redrawn under the user's hands
  }

  function row(one) {
    const answer = one.response_time_s ? `answer within ${duration(one.response_time_s)}` : "";
    const todo = [one.operator_action, one.consequence && `else: ${one.consequence}`].filter(Boolean).join("; ");
    const until = one.state === "shelved" && one.until ? ` until ${moment(one.until, { seconds: false })}` : "";
    return [
      h("span", { class: "t" }, h("a", { href: `/assets/${part(one.asset)}` }, one.asset), ` ${plain(one.alarm)}`),
      one.priority ? priority(one.priority) : DASH,
      `${STATES[one.state]}${until}`,
      h("span", { class: "t", title: `${duration(now - one.since)} ago` }, moment(one.since)),
      h("span", {}, one.cause ? prose(one.cause) : DASH, one.diagnosis && [" ", h("a", { class: "t", href: `/diagnoses/${part(one.diagnosis.id)}` }, "reasons")]),
      one.checks.length ? h("ul", { class: "why" }, one.checks.flatMap((check) => check.texts.map((text) => h("li", {}, prose(text)))), answer && h("li", {}, h("small", {}, answer))) : h("span", {}, todo || DASH, answer && h("small", {}, ` ${answer}`)),
      commands(one, session, heard),
    ];
  }

  async function look() {
    const [found, steps] = await Promise.all([get("/alarms", signal), get(query("/alarms/history", { asset, last: 100 }), signal)]);
    ({ alarms, now, mark } = found);
    flood.hidden = !found.flood;
    if (found.flood) tell(flood, `Alarm flood since ${moment(found.flood.since)}: ${found.flood.counted} new alarms, ${found.flood.held} held back.`);
    draw();
    past.replaceChildren(history(steps.transitions));
  }

  await look();
  let timer = 0;
  const soon = () => {
    timer ||= setTimeout(() => {
      timer = 0;
      look().catch(() => {}); // the stream says that the service is gone
    }, OFTEN_MS);
  };
  follow("", ["alarm", "services"], soon, linked, signal, mark);
  signal.addEventListener("abort", () => clearTimeout(timer));
}

// Steps of alarms, the newest first.
function history(transitions) {
  if (!transitions.length) return h("p", { class: "empty" }, "No alarm has ever occurred.");
  return table(
    "Steps of alarms, the newest first",
    ["When", "Asset", "Alarm", "Step", "Cause", "Who"],
    [...transitions]
      .reverse()
      .map((one) => [
        h("span", { class: "t" }, moment(one.t)),
        h("a", { class: "t", href: `/assets/${part(one.asset)}` }, one.asset),
        h("span", {}, plain(one.alarm), one.priority && h("small", {}, ` ${one.priority}`)),
        `${STATES[one.before]} → ${STATES[one.after]}`,
        one.cause ? h("span", {}, prose(one.cause)) : DASH,
        one.who || DASH,
      ]),
  );
}
