// What the asset is compared with: noted repairs, how far it has learned since, a preview of the next baseline, and one step back.
import { get, job, mayChange, post } from "./api.js";
import { ask, during, field, h, section, table, tell } from "./dom.js";
import { DASH, change, moment, multiple, number, plain } from "./words.js";

const OCCASIONS = { repair: "a repair", tool: "another tool", product: "another product", season: "another season" };
const EVERY_MS = 5000;

export function relearning(path, session, asset, signal) {
  const [said, answer, shown] = [h("p", { class: "summary", role: "status" }), h("p", { class: "working", role: "status" }), h("div", {})];
  const press = (words, act) => h("button", { type: "button", onclick: act }, words);
  const [healthy, repaired, back] = [press("This was healthy", () => stretch()), press("This was repaired", () => repair()), press("One step back", () => undo())];
  const intended = press("The change is intended", () => confirm());
  intended.hidden = true;
  const [off, offered] = [h("p", { class: "note" }), h("ul", { class: "why", translate: "no" })];
  const buttons = [mayChange(session.role, "operator") && [repaired, intended], mayChange(session.role, "engineer") && [healthy, back]];
  const element = section("Baseline", null, said, off, offered, h("div", { class: "actions screen" }, buttons), answer, shown);
  element.hidden = true;
  let state = null;

  async function load() {
    state = await get(`${path}/relearning`, signal);
    if (!state) return clearInterval(timer); // no service file is known
    element.hidden = false;
    back.hidden = !state.can_go_back;
    const minutes = (seconds) => number(seconds / 60, 2);
    const enough = state.learned_s >= state.needed_s;
    const learning = state.after && (enough ? `Learned enough after ${state.after}: look at the new baseline.` : `Learning after ${state.after}: ${minutes(state.learned_s)} of ${minutes(state.needed_s)} min.`);
    tell(said, learning || `Baseline ${state.revision} is in force.`);
    tell(off, state.after ? `Distance from the earlier baseline: ${multiple(Math.max(asset().statistic ?? 0, asset().level ?? 0))} × limit.` : "");
    offered.replaceChildren(...state.offers.map((text) => h("li", {}, text)));
    intended.hidden = asset().learning?.confirmed !== false || asset().verdict !== "fault";
    healthy.classList.toggle("first", Boolean(state.after) && enough);
  }

  const timer = setInterval(() => load().catch(() => {}), EVERY_MS);
  signal.addEventListener("abort", () => clearInterval(timer));

  function repair() {
    const kind = h("select", {}, Object.entries(OCCASIONS).map(([value, words]) => h("option", { value }, words)));
    const text = h("input", { maxlength: "200" });
    ask("What was done", "Learn again", [field("After", kind), field("What was done", text)], async () => {
      await post(`${path}/notes`, { t: asset().t, text: text.value || kind.value, anew: kind.value !== "season", kind: kind.value }, signal);
      await load();
    });
  }

  // What differs from before is no fault: until the next baseline is in force, it is no alarm.
  function confirm() {
    const text = h("input", { maxlength: "200", required: true });
    ask("The change is intended", "No alarm", [field("What was done", text)], async () => {
      await post(`${path}/notes`, { t: asset().t, text: text.value, kind: "confirmed" }, signal);
      await load();
    }, asset().summary);
  }

  function stretch() {
    const since = h("select", {}, state.since && h("option", { value: state.since }, `since ${moment(state.since, { seconds: false })}`), [600, 3600].map((seconds) => h("option", { value: asset().t - seconds }, `the last ${seconds / 60} min`)), h("option", { value: "" }, "all that is kept"));
    const why = h("input", { maxlength: "200" });
    const [first, last] = [0, 1].map(() => h("input", { type: "datetime-local", step: "1" }));
    const time = (input) => (input.value ? new Date(input.value).getTime() / 1000 : null);
    ask("Learn from samples", "Preview", [field("Samples", since), field("Or from", first), field("To", last), field("Why", why)], async () => {
      const body = { from: time(first) ?? (since.value ? Number(since.value) : null), to: time(last), after: state.after, why: why.value };
      during(healthy, answer, async (step) => show(await job(`${path}/relearnings`, body, { signal, step })));
    });
  }

  function show(preview) {
    const share = (value) => (value === null ? DASH : `${number(100 * value, 3)} %`);
    const size = (value) => (value === null ? "never" : share(value));
    const moves = preview.points.flatMap((point) => point.moves).map((one) => [plain(one.name), number(one.before), number(one.after), one.change === null ? DASH : change(1 + one.change), one.certain ? "certain" : "within its scatter"]);
    const sizes = preview.points.flatMap((point) => point.detectable).map((one) => [plain(one.name), size(one.before), size(one.after)]);
    const { values, before, after } = preview.judged;
    const take = press("Put in force", () => during(take, answer, async () => {
      await post(`${path}/baseline`, { learning: preview.learning }, signal);
      shown.replaceChildren();
      await load();
    }));
    shown.replaceChildren(
      table("What moved", ["Parameter", "*Before", "*After", "*Change", "How sure"], moves),
      table("Smallest detectable changes", ["Fault", "*Before", "*After"], sizes),
      h("p", { class: "note" }, `Stored values of the last weeks beyond the limit: ${before} before, ${after} after, of ${values}.`),
      h("ul", { class: "why", translate: "no" }, preview.notes.map((note) => h("li", {}, note))),
      h("div", { class: "actions" }, take, press("Discard", () => shown.replaceChildren())),
    );
  }

  function undo() {
    const why = h("input", { maxlength: "200" });
    ask("One step back", "Go back", [field("Why", why)], async () => {
      await post(`${path}/baseline`, { why: why.value }, signal);
      await load();
    });
  }

  return { element, load };
}
