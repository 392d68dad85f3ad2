// Before deployment: which faults of a loop can be seen and told apart, and from which size on.
import { get, job, mayChange, part, query } from "./api.js";
import { axis, legend, plot, tooltip } from "./charts.js";
import { short } from "./curves.js";
import { complaint, field, h, section, table, tell, translate } from "./dom.js";
import { loopChoice } from "./loops.js";
import { prose } from "./marks.js";
import { capital, change, DASH, moment, number, general, plain, unit } from "./words.js";

const REFERENCES = ["profile", "multisine", "trapezoid", "steps", "chirp"];

export async function show(main, { session, signal, values, entitle }) {
  const id = values.get("id");
  const past = h("div", {});
  const { designs } = await get("/designs", signal);
  past.replaceChildren(studies(designs));
  if (id) {
    const found = await get(`/designs/${part(id)}`, signal);
    entitle(`Before deployment: ${found.loop}`);
    const drawn = [];
    const report = h("a", { class: "button", href: `/api/v1/designs/${part(id)}/report`, target: "_blank", rel: "noopener" }, "Report as one file");
    main.replaceChildren(
      h("div", { class: "head" }, h("h1", {}, `Before deployment: ${found.loop}`), h("span", { class: "note" }, `${moment(found.at)}, reference ${found.reference}, ${general(found.study.after_s)} s after the onset`), h("span", { class: "gap" }), h("div", { class: "actions" }, h("a", { class: "button", href: "/design" }, "Another study"), h("button", { type: "button", onclick: () => print() }, "Print"), report)),
      ...studied(found.study, drawn, signal),
    );
    drawn.forEach((draw) => draw());
    return;
  }
  const work = h("div", {});
  main.replaceChildren(h("div", { class: "head" }, h("h1", {}, "Before deployment")), work, section("Studies", null, past));
  if (!mayChange(session.role, "engineer")) return work.replaceChildren(h("p", { class: "note" }, "Studies are made by engineers; these are known."));
  const loop = await loopChoice("design", signal, values.get("baseline"));
  const reference = h("select", {}, REFERENCES.map((name) => h("option", {}, name)));
  const after = h("input", { type: "number", min: "1", step: "any", value: "30" });
  const [u, y] = [1, 2].map(() => h("input", { type: "number", min: "0", step: "any", placeholder: "as the baseline knows" }));
  const noise = [["u", u], ["y", y]].map(([name, control]) => [name, field("", control)]);
  const label = () => noise.forEach(([name, element]) => tell(element.firstChild, `Noise of ${name}, standard deviation${unit(loop.units()?.[name])}`));
  loop.changed(label);
  label();
  const said = h("div", { role: "status", class: "working" });
  const run = h("button", { class: "first" }, "Study");
  const submit = async (event) => {
    event.preventDefault();
    run.disabled = true;
    try {
      const body = { loop: loop.read(), reference: reference.value, after_s: Number(after.value), ...(u.value && { noise_u_std: Number(u.value) }), ...(y.value && { noise_y_std: Number(y.value) }) };
      const { design } = await job("/designs", body, { signal, step: (step) => tell(said, `${step} …`) });
      location.assign(query("/design", { id: design }));
    } catch (error) {
      if (error.name !== "AbortError") said.replaceChildren(complaint(error));
      run.disabled = false;
    }
  };
  work.append(
    section(
      "What can be told apart",
      "Under the reference that will run and the noise that is there, for a loop whose controller is known.",
      h("form", { onsubmit: submit }, loop.element, h("div", { class: "fields" }, field("Reference", reference), field("Seconds after the onset [s]", after), noise.map(([, element]) => element)), h("div", { class: "actions" }, run, said)),
    ),
  );
}

function studies(designs) {
  if (!designs.length) return h("p", { class: "empty" }, "No study yet.");
  return table("Studies, the newest first", ["Loop", "Reference", "When", "Who"], [...designs].reverse().map((one) => [h("a", { href: query("/design", { id: one.id }) }, one.loop), one.reference, moment(one.at), one.who ?? DASH]));
}

function studied(study, drawn, signal) {
  const faults = Object.values(study.faults);
  const names = faults.map((fault) => fault.name);
  const picture = (label, describe) => {
    const element = h("div", { class: "plot" });
    drawn.push(() => plot(element, label, describe, signal));
    return element;
  };
  const sides = faults.flatMap((fault) => [["up", fault.up], ["down", fault.down]].map(([way, side]) => [fault, way, side]));
  const amount = (value, unit) => (value === null ? "never" : unit === "ratio" || unit === "relative" || !unit ? `${number(100 * value, 3)} %` : `${number(value, 3)} ${unit}`);
  const heat = (value) => {
    const cell = h("td", { class: "n" }, number(value, 3));
    cell.style.backgroundColor = `color-mix(in srgb, var(--measured) ${Math.round(40 * value * value)}%, transparent)`;
    return cell;
  };
  return [
    section(
      "Which faults, from which size on",
      "Detected: announced in time with 90 % probability. Named: called by its own name with 99.5 % probability. Linear bound: what sensitivities and the Cramér-Rao bound allow.",
      table(
        "Radii of faults",
        ["Change", "*Detected from", "*Named from", "*Linear bound", "Else taken for"],
        sides.map(([fault, way, side]) => [h("span", {}, `${capital(translate(plain(fault.name)))} ${translate(way)} `, h("small", {}, prose(fault.parameter))), change(side.detectable), change(named(side)), change(side.bound), side.nearest || DASH]),
      ),
    ),
    section("How sure a size becomes", "Cramér-Rao bound, with the healthy parameters as well known as they are.", picture("Standard deviation of the size over time", (c) => sizes(c, faults))),
    section(
      "When the loop fails",
      "Tracking lost: its bandwidth falls to 0.7 of the healthy one. Stability lost: its distance to instability is halved. Such a size is a limit for the trend of an asset.",
      table("Limits of faults", ["Change, as a ratio to healthy", "*Tracking lost at", "*Stability lost at"], sides.map(([fault, way, side]) => [`${capital(translate(plain(fault.name)))} ${translate(way)}`, ...[side.tracking, side.stability].map((at) => (at ? general(at) : "never"))])),
    ),
    names.length > 1 && section("How alike they look", "Cosine between what small changes do: 1 or −1 cannot be told apart, 0 is as different as can be.", table("Cosines between faults", ["Change", ...names.map((name) => `*${plain(name)}`)], names.map((one) => [plain(one), ...names.map((other) => heat(study.cosines[one][other]))]))),
    study.mimics?.length > 0 && section("What else it could be", "Changes that are no fault of the list, the fault that each looks like, and from where on they are told apart.", table("Mimics", ["Change", "Is most like", "*Cosine", "*So much", "*Looks like", "*Told apart from"], study.mimics.map((one) => [h("span", {}, one.words, !/ |^delay$/.test(one.name) && h("small", {}, " ", prose(one.name))), one.imitates, number(one.cosines[one.imitates], 3), amount(one.amount, one.unit), change(one.looks_like), amount(one.told_apart, one.unit)]))),
  ].filter(Boolean);
}

const named = (side) => (side.unclear.length ? side.unclear[0][1] : 1);

// Colours that every common kind of colour vision tells apart, with dashes beside them.
const tones = (c) => [c.measured, c.alarm, c.healthy, c.check, c.care, c.ink];
const DASHES = ["solid", [6, 3], [2, 2], [8, 3, 2, 3], [4, 4], [1, 3]];

function several(c, named, x, y) {
  return {
    grid: { left: 66, right: 16, top: 30, bottom: 40 },
    legend: legend(c, named.map(([name]) => name)),
    tooltip: tooltip(c, { trigger: "item", formatter: ({ seriesName, value }) => `${seriesName}\n${x} ${short(value[0])}\n${y} ${short(value[1])}` }),
    xAxis: axis(c, x, { type: "log", label: { formatter: short } }),
    yAxis: axis(c, y, { type: "log", gap: 48, label: { formatter: short } }),
    series: named.map(([name, data], i) => ({ type: "line", name, data, symbolSize: 6, color: tones(c)[i % 6], lineStyle: { width: 1.5, type: DASHES[i % 6], color: tones(c)[i % 6] } })),
  };
}

function sizes(c, faults) {
  const lines = faults.map((fault) => [plain(fault.name), fault.sizes.map((one) => [one.seconds, 100 * (one.std ?? one.alone_learned)]).filter(([, std]) => std > 0)]);
  return several(c, lines, "time after the onset [s]", "standard deviation [%]");
}
