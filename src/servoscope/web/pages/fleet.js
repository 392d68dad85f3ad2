// All assets at a glance, worst first: a map of marks by group, and a table beneath it; both live.
import { get } from "./api.js";
import { h, mark as set, translate, tell } from "./dom.js";
import { follow } from "./live.js";
import { mark, say, VERDICTS } from "./marks.js";
import { DASH, duration, moment, multiple, plain, recent, sentence, signed, size } from "./words.js";

const STALE_S = 10; // without a sample for so long, the age is told
const ORDER_MS = 5000; // between two changes of the order: rows must not run away from whoever reads them
const COLUMNS = ["State", "Asset", "Group", "What is known", "Since", "T² / limit", "CUSUM / limit", "Deviation", "Growth / week", "Limit in", "Data", "Alarms", "Sample"];
// Steps of urgency: what the statistics do below their limits moves no row.
const rank = (row) => 2 * Math.floor(row.severity / 4) + (row.severity % 4 >= 1 ? 1 : 0);
const WEEK = 7;
const ORDERS = {
  worst: ["Worst first", (row) => -rank(row)],
  next: ["Limit soonest first", (row) => remaining(row, 0)?.[0] ?? Infinity],
  growth: ["Fastest growth first", (row) => -Math.abs(row.outlook?.rate_per_day?.[1] ?? 0)],
};
// Silent or healthy, what has a fault stands above what has none.
const faulty = (row) => (row.verdict === "fault" ? 0 : 1);
const SOON_S = 90 * 86400; // a limit that may be reached within this time is told by its filter
// Further questions that rows answer, each a filter.
const QUESTIONS = {
  open: ["To acknowledge", (row) => row.alarms.some((alarm) => OPEN.includes(alarm.state))],
  growing: ["Growing", (row) => row.outlook?.rate_per_day && row.outlook.rate_per_day[0] * row.outlook.rate_per_day[2] > 0],
  soon: ["Limit within 90 days", (row) => remaining(row, row.t)?.[0] <= SOON_S],
  unheard: ["Not heard", (row) => !row.heard],
};
const OPEN = ["unacknowledged", "returned_unacknowledged", "latched_unacknowledged"];

export async function show(main, { signal, linked, values }) {
  const assets = new Map(); // name -> { row, tile, line }
  const filter = { verdict: values.get("verdict") ?? "", search: values.get("search") ?? "", group: values.get("group") ?? "", order: values.get("order") ?? "worst", source: values.get("source") ?? "", question: values.get("show") ?? "" };
  const map = h("div", { class: "map" });
  const body = h("div", { role: "rowgroup", class: "rows" });
  const none = h("p", { class: "empty" }, "Loading");
  const first = h("p", { class: "empty", hidden: true }, h("a", { href: "/begin" }, "Begin with a log"), ". ", "The log of a healthy machine becomes settings and a baseline. `servoscope add` writes the machine into a service file, and `servoscope run` follows it.");
  const counts = filters();
  const sources = overview((name) => ((filter.source = filter.source === name ? "" : name), chosen(), recount()));
  const search = h("input", { type: "search", placeholder: "Search", "aria-label": "Search assets", value: filter.search });
  const groups = h("select", { "aria-label": "Group" }, h("option", { value: "" }, "All groups"));
  const orders = h("select", { "aria-label": "Order" }, Object.entries(ORDERS).map(([key, [words]]) => h("option", { value: key }, words)));
  orders.value = filter.order in ORDERS ? filter.order : "worst";
  const grid = h("div", { class: "grid fleet", tabindex: "0", role: "table", "aria-label": "Assets, worst first" });
  let now = 0;

  main.replaceChildren(
    h("div", { class: "head" }, h("h1", {}, "Fleet"), counts.element, h("span", { class: "gap" }), orders, groups, search),
    sources.element,
    map,
    grid,
    none,
    first,
  );
  grid.append(
    h("div", { role: "rowgroup" }, h("div", { role: "row", class: "line titles" }, COLUMNS.map((name, i) => h("span", { role: "columnheader", class: ((i > 4 && i < 10) || i === 12) && "n" }, name)))),
    body,
  );
  orders.addEventListener("change", () => ((filter.order = orders.value), chosen(), order(true)));
  search.addEventListener("input", () => ((filter.search = search.value), chosen()));
  groups.addEventListener("change", () => ((filter.group = groups.value), chosen()));
  search.addEventListener("keydown", (event) => event.key === "Enter" && [...assets.values()].find((one) => !one.line.element.hidden)?.line.name.click());
  map.addEventListener("keydown", walk);

  function filters() {
    const element = h("div", { class: "filters", role: "group", "aria-label": "Show" });
    const made = [["", "All"], ...Object.entries(VERDICTS), ...Object.entries(QUESTIONS).map(([key, [words]]) => [key, words])].map(([key, words]) => {
      const amount = h("b", {}, "0");
      const press = () => {
        filter.question = key in QUESTIONS && filter.question !== key ? key : "";
        filter.verdict = key in VERDICTS && filter.verdict !== key ? key : "";
        chosen();
      };
      const button = h("button", { type: "button", onclick: press, class: `filter ${key}` }, key in VERDICTS && mark(key), words, amount);
      element.append(button);
      return [key, button, amount];
    });
    return { element, made };
  }

  function recount() {
    const found = { "": assets.size, fault: 0, undetermined: 0, healthy: 0 };
    for (const key of Object.keys(QUESTIONS)) found[key] = 0;
    for (const { row } of assets.values()) {
      found[row.verdict] += 1;
      for (const [key, [, holds]] of Object.entries(QUESTIONS)) found[key] += holds(row) ? 1 : 0;
    }
    sources.recount([...assets.values()].map(({ row }) => row), filter.source);
    for (const [key, , amount] of counts.made) tell(amount, String(found[key]));
  }

  function wanted({ row }) {
    if (filter.verdict && row.verdict !== filter.verdict) return false;
    if (filter.group && row.group !== filter.group) return false;
    if (filter.source && row.source !== filter.source) return false;
    if (filter.question in QUESTIONS && !QUESTIONS[filter.question][1](row)) return false;
    const text = filter.search && `${row.asset} ${row.group} ${row.summary} ${row.alarms.map((alarm) => alarm.alarm).join(" ")}`;
    return !filter.search || text.toLowerCase().includes(filter.search.trim().toLowerCase());
  }

  function showIfWanted(one) {
    const shown = wanted(one);
    if (one.line.element.hidden !== shown) return shown;
    one.tile.classList.toggle("off", !shown);
    one.line.element.hidden = !shown;
    return shown;
  }

  function sift() {
    const shown = [...assets.values()].filter(showIfWanted);
    none.hidden = shown.length > 0;
    first.hidden = assets.size > 0;
    tell(none, assets.size ? "No asset is like this." : "No machine yet.");
  }

  function chosen() {
    for (const [key, button] of counts.made) set(button, "aria-pressed", String(key in QUESTIONS ? filter.question === key : !filter.question && filter.verdict === key));
    const told = new URLSearchParams(Object.entries({ verdict: filter.verdict, search: filter.search, group: filter.group, source: filter.source, show: filter.question, order: filter.order === "worst" ? "" : filter.order }).filter(([, value]) => value));
    history.replaceState(null, "", told.size ? `/?${told}` : "/");
    sift();
  }

  // Rows are put where they belong, but not under somebody's hands.
  function order(forced = false) {
    if (!forced && (body.matches(":hover") || body.contains(document.activeElement))) return;
    const [words, key] = ORDERS[orders.value];
    set(grid, "aria-label", `Assets, ${words[0].toLowerCase()}${words.slice(1)}`);
    const by = (a, b) => (key(a.row) < key(b.row) ? -1 : key(a.row) > key(b.row) ? 1 : 0);
    const worst = [...assets.values()].sort((a, b) => faulty(a.row) - faulty(b.row) || by(a, b) || rank(b.row) - rank(a.row) || (a.row.asset < b.row.asset ? -1 : 1));
    worst.forEach(({ line }, i) => body.children[i] !== line.element && body.insertBefore(line.element, body.children[i] ?? null));
  }

  function chart() {
    const named = [...new Set([...assets.values()].map(({ row }) => row.group))].sort();
    groups.replaceChildren(h("option", { value: "" }, "All groups"), ...named.filter(Boolean).map((name) => h("option", { value: name, translate: "no" }, name)));
    groups.value = filter.group;
    groups.hidden = named.filter(Boolean).length < 2;
    map.replaceChildren(
      ...named.map((name) => {
        const tiles = [...assets.values()].filter(({ row }) => row.group === name).sort((a, b) => (a.row.asset < b.row.asset ? -1 : 1));
        return h("div", { class: "group" }, name && h("h2", { translate: "no" }, name), h("div", { class: "tiles" }, tiles.map(({ tile }) => tile)));
      }),
    );
    const first = map.querySelector("a");
    for (const tile of map.querySelectorAll("a")) tile.tabIndex = tile === first ? 0 : -1; // one stop; arrows walk
  }

  function walk(event) {
    const tiles = [...map.querySelectorAll("a:not(.off)")];
    const at = tiles.indexOf(document.activeElement);
    const across = tiles.filter((tile) => tile.offsetTop === tiles[at]?.offsetTop).length;
    const steps = { ArrowRight: 1, ArrowLeft: -1, ArrowDown: across, ArrowUp: -across, Home: -at, End: tiles.length - 1 - at };
    const next = tiles[at + steps[event.key]];
    if (at < 0 || !next) return;
    event.preventDefault();
    document.activeElement.tabIndex = -1;
    next.tabIndex = 0;
    next.focus();
  }

  function take(rows) {
    let fresh = false;
    for (const row of rows) {
      const known = assets.get(row.asset);
      if (!known) {
        const one = { row, tile: h("a", { class: "tile", href: `/assets/${encodeURIComponent(row.asset)}` }), line: lineOf(row) };
        assets.set(row.asset, one);
        dress(one);
        fresh = true;
      } else {
        fresh ||= known.row.group !== row.group;
        const changed = known.row.verdict !== row.verdict || known.row.summary !== row.summary || known.row.alarms.length || row.alarms.length;
        known.row = row;
        if (changed) dress(known);
      }
      assets.get(row.asset).line.update(row, now);
    }
    if (fresh) {
      chart();
      order(true);
    }
    recount();
    sift();
  }

  const first = await get("/assets", signal);
  now = first.now;
  take(first.assets);
  chosen();
  follow(
    "",
    ["assets"],
    ({ assets: told = [] }) => {
      now = told.at(-1)?.now ?? now;
      take([...new Map(told.flatMap((each) => each.assets).map((row) => [row.asset, row])).values()]);
    },
    linked,
    signal,
  );
  const timer = setInterval(() => order(), ORDER_MS);
  const clock = setInterval(() => {
    now += 1;
    for (const { row, line } of assets.values()) line.age(row, now);
  }, 1000);
  signal.addEventListener("abort", () => [timer, clock].forEach(clearInterval));
}

// What a mark on the map says: verdict by shape and colour, an alarm to answer by its frame.
function dress({ row, tile }) {
  const open = row.alarms.some((alarm) => OPEN.includes(alarm.state));
  const look = `tile ${row.verdict} ${open ? "open" : ""}`;
  const words = `${row.asset}: ${VERDICTS[row.verdict]}${open ? ", alarm to acknowledge" : ""}`;
  if (tile.dataset.look !== look) {
    tile.dataset.look = look;
    for (const name of ["fault", "healthy", "undetermined"]) tile.classList.toggle(name, name === row.verdict);
    tile.classList.toggle("open", open);
    tile.replaceChildren(mark(row.verdict));
  }
  set(tile, "aria-label", words);
  set(tile, "title", `${row.asset}\n${sentence(row.summary)}`);
}

// What samples come from: how many assets of each source are heard; a press shows those of one.
function overview(press) {
  const element = h("div", { class: "filters sources", role: "group", "aria-label": "Sources" });
  const made = new Map(); // name -> { button, words }
  const recount = (rows, chosen) => {
    for (const name of [...new Set(rows.map((row) => row.source))].filter(Boolean).sort()) {
      if (!made.has(name)) {
        const words = h("span", {});
        const button = h("button", { type: "button", class: "filter", onclick: () => press(name) }, `${name}: `, words);
        made.set(name, { button, words });
        element.append(button);
      }
      const { button, words } = made.get(name);
      const own = rows.filter((row) => row.source === name);
      const heard = own.filter((row) => row.heard).length;
      tell(words, heard === own.length ? `all ${heard} heard` : `${heard} of ${own.length} heard`);
      words.classList.toggle("bad", heard === 0);
      set(button, "aria-pressed", String(chosen === name));
    }
  };
  return { element, recount };
}

// How long until the limit, [earliest, latest] in s; null: no forecast.
function remaining({ outlook }, now) {
  if (outlook?.outlook === "reached") return [0, 0];
  if (outlook?.outlook !== "forecast") return null;
  return [outlook.reach_t[0] - now, outlook.reach_t[2] === null ? Infinity : outlook.reach_t[2] - now];
}

function limitIn(row, now) {
  const left = remaining(row, now);
  if (!left) return row.outlook ? "not in sight" : DASH;
  if (left[1] <= 0) return "reached";
  return left[1] === Infinity ? `from ${duration(left[0])}` : `${duration(left[0])} – ${duration(left[1])}`;
}

// What is known, without the verdict, which stands beside it.
function known(row) {
  const named = (row.sizes ?? []).map((one) => `${one.words.replace(/ \(.*/, "")}, ${one.parameter} ${size({ ...one, interval: [one.low, one.high] })[0]}`);
  return row.verdict === "fault" && named.length ? named.join("; ") : withoutVerdict(sentence(row.summary));
}

function withoutVerdict(words) {
  const verdict = ["Fault", "Healthy", "Undetermined", ...Object.values(VERDICTS)].find((one) => words.startsWith(`${one}: `)); // a service may speak another language
  return verdict ? words.slice(verdict.length + 2) : words;
}

function gauge() {
  const bar = h("i");
  const value = h("span");
  return { bar, value, element: h("span", { role: "cell", class: "n gauge" }, h("span", { class: "bar", "aria-hidden": "true" }, bar), value) };
}

// One asset's row; only what has changed is touched.
function lineOf(first) {
  const cell = (kind = "") => h("span", { role: "cell", class: kind });
  const name = h("a", { href: `/assets/${encodeURIComponent(first.asset)}`, translate: "no" }, first.asset);
  const state = cell("state");
  const [group, what, since, deviation, growth, limit, data, alarms, last] = [cell(), cell("what"), cell(), cell("n"), cell("n"), cell("n"), cell(), cell(), cell("n")];
  const statistic = gauge();
  const level = gauge();
  const element = h("div", { role: "row", class: "line" }, state, h("span", { role: "cell", class: "name" }, name), group, what, since, statistic.element, level.element, deviation, growth, limit, data, alarms, last);
  [...element.children].forEach((one, i) => set(one, "data-name", COLUMNS[i]));
  const drawn = (one, value) => {
    tell(one.value, multiple(value));
    const share = Math.round(Math.min((value ?? 0) / 1.5, 1) * 48); // px; the limit is at 32
    if (one.share !== share) one.bar.style.width = `${(one.share = share)}px`;
    one.element.classList.toggle("over", value >= 1);
  };
  let verdict = null;
  const age = (row, now) => tell(last, row.at === null ? DASH : now - row.at < STALE_S ? "now" : `${duration(now - row.at)} ago`);
  const update = (row, now) => {
    if (verdict !== row.verdict) {
      verdict = row.verdict;
      element.classList.remove("fault", "healthy", "undetermined");
      element.classList.add(verdict);
      state.replaceChildren(mark(verdict), VERDICTS[verdict]);
    }
    const open = row.alarms.filter((alarm) => OPEN.includes(alarm.state)).length;
    const told = known(row);
    tell(group, row.group || DASH);
    say(what, told);
    set(what, "title", told);
    const from = row.verdict === "fault" ? (row.onset ?? row.since) : row.since;
    tell(since, recent(from, now));
    set(since, "title", moment(from));
    drawn(statistic, row.statistic);
    drawn(level, row.level);
    tell(deviation, row.deviation === null ? DASH : `${(100 * row.deviation).toFixed(1)} %`);
    tell(growth, row.outlook?.rate_per_day ? `${signed(100 * WEEK * row.outlook.rate_per_day[1], 2)} %` : DASH);
    tell(limit, limitIn(row, row.t));
    set(limit, "title", row.outlook?.summary ?? "no limit is set, or no fault is named");
    tell(data, row.quality.map(plain).map(translate).join(", ") || "sound");
    data.classList.toggle("bad", row.quality.length > 0);
    tell(alarms, open ? `${open} to answer` : row.alarms.length ? `${row.alarms.length} answered` : DASH);
    alarms.classList.toggle("bad", open > 0);
    age(row, now);
  };
  return { element, name, update, age };
}
