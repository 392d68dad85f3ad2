// What an operator can do about an alarm: buttons for what means something now, and questions where an answer is needed.
import { mayChange, part, post } from "./api.js";
import { ask, field, h } from "./dom.js";

const WORDS = {
  acknowledge: "Acknowledge",
  reset: "Reset",
  shelve: "Shelve",
  unshelve: "Unshelve",
  remove_from_service: "Out of service",
  return_to_service: "Back in service",
};
const NEEDS = { shelve: "How long, and why?", remove_from_service: "Why is it taken out of service?" };
const HOURS = { "15 min": 900, "1 h": 3600, "8 h": 28800, "24 h": 86400, "7 d": 604800 };
export const STATES = {
  normal: "normal",
  unacknowledged: "to acknowledge",
  acknowledged: "acknowledged",
  returned_unacknowledged: "gone, to acknowledge",
  latched_unacknowledged: "latched, to acknowledge",
  latched_acknowledged: "latched, to reset",
  shelved: "shelved",
  suppressed_by_design: "suppressed by design",
  out_of_service: "out of service",
};

// Sends a command on an alarm, and returns what is to be said of it, null once it was carried out.
export async function sendCommand(alarm, command, body) {
  const answer = await post(`/assets/${part(alarm.asset)}/alarms/${part(alarm.alarm)}/${command}`, body);
  return answer.outcome === null ? "Asked for: the service carries it out as soon as it runs." : null;
}

// Buttons for an alarm; `said` hears what became of a command, `null` once it was carried out.
export function commands(alarm, session, said) {
  if (!mayChange(session.role, "operator")) return h("small", {}, "operators answer");
  const send = async (command, body) => said(await sendCommand(alarm, command, body));
  const press = async (command) => {
    for (const button of made) button.disabled = true; // the service takes a moment
    try {
      if (command in NEEDS) await question(alarm, command, send);
      else await send(command, {});
    } catch (error) {
      said(error.message);
    } finally {
      for (const button of made) button.disabled = false;
    }
  };
  const made = alarm.commands.map((command) => {
    const label = `${WORDS[command]}: ${alarm.alarm} of ${alarm.asset}`;
    return h("button", { type: "button", "aria-label": label, class: command === "acknowledge" && "first", onclick: () => press(command) }, WORDS[command]);
  });
  return h("div", { class: "actions" }, made);
}

function question(alarm, command, send) {
  const why = h("input", { name: "why", maxlength: "200" });
  const long = h("select", { name: "for" }, Object.entries(HOURS).map(([words, seconds]) => h("option", { value: seconds, selected: words === "8 h" }, words)));
  const fields = [command === "shelve" && field("For", long), field("Why", why)];
  const taken = () => send(command, { why: why.value, ...(command === "shelve" ? { for_s: Number(long.value) } : {}) });
  return ask(`${WORDS[command]}: ${alarm.alarm} of ${alarm.asset}`, WORDS[command], fields, taken, NEEDS[command]);
}
