// Where alarms are sent, and a test of each outlet.
import { get, mayChange, part, post } from "./api.js";
import { during, h, section, table } from "./dom.js";
import { moment } from "./words.js";

const EVERY_MS = 500;
const PATIENCE_MS = 20000; // then the service does not run, or its outlet does not answer

// A section, null where nothing is sent.
export async function outlets(session, signal) {
  const { outlets: all } = await get("/notifications", signal);
  if (!all.length) return null;
  const data = (words) => h("span", { translate: "no" }, words);
  return section(
    "Notifications",
    "Where alarms are sent. A test goes the same way as they do.",
    table("Notifications", ["Outlet", "Kind", "Sent to", "Last delivery", "Test"], all.map((one) => [data(one.name), one.kind, data(one.target), ...test(one, session, signal)])),
  );
}

function test(one, session, signal) {
  const said = h("span", { role: "status" }, delivered(one.last));
  if (!one.may_test || !mayChange(session.role, "engineer")) return [said, one.may_test ? "" : h("small", {}, "changes a machine: not tested")];
  const button = h("button", { type: "button", "aria-label": `Test: ${one.name}` }, "Test");
  const send = async () => {
    const before = (await post(`/notifications/${part(one.name)}/test`, undefined, signal)).last?.t ?? 0;
    said.replaceChildren(h("span", {}, "Asked for: the service carries it out as soon as it runs."));
    for (const end = Date.now() + PATIENCE_MS; Date.now() < end; await new Promise((then) => setTimeout(then, EVERY_MS))) {
      const { last } = (await get("/notifications", signal)).outlets.find((each) => each.name === one.name);
      if (last && last.t > before && last.event === "test") said.replaceChildren(...delivered(last));
      if (last?.outcome && last.t > before && last.event === "test") return;
    }
  };
  button.addEventListener("click", () => during(button, h("span", {}), send));
  return [said, button];
}

const delivered = (last) => (last ? [h("span", { class: "t" }, moment(last.t)), " ", h("span", {}, last.outcome ? h("span", { translate: "no" }, last.outcome) : "on its way")] : [h("span", {}, "none yet")]);
