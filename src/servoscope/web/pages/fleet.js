// All assets at a glance, worst first: a map of marks by group, and a table beneath it; both live.
import { get } from "./api.js";
import { h, mark as set, translate, tell } from "./dom.js";
import { follow } from "./live.js";
import { mark, say, VERDICTS } from "./marks.js";
import { DASH, duration, moment, multiple, plain, sentence, signed, size } from "./words.js";

const PAGE = 200; // assets that are asked for, and shown in the table, at a time
const STALE_S = 10; // without a sample for so long, the age is told
const ORDER_MS = 5000; // between two changes of the order: rows must not run away from whoever reads them
// Name, width, and the rows that have something in it, if it goes where no row has.
const COLUMNS = [
  ["State", "7.2rem"],
  ["Asset", "minmax(5rem, 9rem)"],
  ["Group", "minmax(3.6rem, 6.5rem)", (row) => row.group],
  ["What is known", "minmax(12rem, 1fr)"],
  ["Lasting", "4.2rem"],
  ["Distance / limit", "7rem"],
  ["Deviation", "4.6rem", (row) => row.deviation !== null],
  ["Growth / week", "5.8rem", (row) => row.outlook?.rate_per_day],
  ["Limit in", "6.6rem", (row) => row.outlook],
  ["Data", "minmax(3.4rem, 7rem)"],
  ["Alarms", "5.4rem", (row) => row.alarms.length],
  ["Sample", "4.4rem"],
];
const NUMERIC = ["Lasting", "Distance / limit", "Deviation", "Growth / week", "Limit in", "Sample"];
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
  const assets = new Map(); // name -> { row, tile, shown, line }; a line from when it is in the table on
  const filter = { verdict: values.get("verdict") ?? "", search: values.get("search") ?? "", group: values.get("group") ?? "", order: values.get("order") ?? "worst", source: values.get("source") ?? "", question: values.get("show") ?? "" };
  const map = h("div", { class: "map" });
  const body = h("div", { role: "rowgroup", class: "rows" });
  const none = h("div", { class: "empty" }, "Loading");
  const counts = filters();
  const sources = overview((name) => ((filter.source = filter.source === name ? "" : name), chosen(), recount()));
  const search = h("input", { type: "search", placeholder: "Search", "aria-label": "Search assets", value: filter.search });
  const groups = h("select", { "aria-label": "Group" }, h("option", { value: "" }, "All groups"));
  const orders = h("select", { "aria-label": "Order" }, Object.entries(ORDERS).map(([key, [words]]) => h("option", { value: key }, words)));
  orders.value = filter.order in ORDERS ? filter.order : "worst";
  const grid = h("div", { class: "grid fleet", tabindex: "0", role: "table", "aria-label": "Assets, worst first" });
  let [now, configured, most, loading] = [0, 0, PAGE, false];
  const more = h("button", { type: "button", class: "filter", hidden: true, onclick: () => ((most += PAGE), order(true)) }, "Show more");
  // A phone shows machines first, and the rest when it is asked for.
  const unfold = () => set(sheet, "aria-expanded", String(main.classList.toggle("unfolded")));
  const sheet = h("button", { type: "button", class: "filter sheet", "aria-expanded": "false", onclick: unfold }, "Filters and map");
  main.classList.add("fleet-page");

  main.replaceChildren(
    h("div", { class: "head" }, h("h1", {}, "Fleet"), counts.element, h("span", { class: "gap" }), orders, groups, search, sheet),
    sources.element,
    map,
    grid,
    more,
    none,
  );
  grid.append(
    h("div", { role: "rowgroup" }, h("div", { role: "row", class: "line titles" }, COLUMNS.map(([name]) => h("span", { role: "columnheader", class: NUMERIC.includes(name) && "n" }, name)))),
    body,
  );
  orders.addEventListener("change", () => ((filter.order = orders.value), chosen(), order(true)));
  search.addEventListener("input", () => ((filter.search = search.value), chosen()));
  groups.addEventListener("change", () => ((filter.group = groups.value), chosen()));
  search.addEventListener("keydown", (event) => event.key === "Enter" && body.querySelector(".line:not([hidden]) .name a")?.click());
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
    const found = { "": assets.size, fault: 0, suspect: 0, undetermined: 0, healthy: 0 };
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
    if (one.shown === shown) return shown;
    one.shown = shown;
    one.tile.classList.toggle("off", !shown);
    if (one.line) one.line.element.hidden = !shown;
    return shown;
  }

  function sift() {
    const shown = [...assets.values()].filter(showIfWanted);
    none.hidden = shown.length > 0;
    grid.hidden = !assets.size;
    if (assets.size) tell(none, "No asset is like this.");
    else if (configured) tell(none, `${configured} assets are configured, waiting for the first samples.`);
    else none.replaceChildren(beginning());
  }

  function chosen() {
    for (const [key, button] of counts.made) set(button, "aria-pressed", String(key in QUESTIONS ? filter.question === key : !filter.question && filter.verdict === key));
    const told = new URLSearchParams(Object.entries({ verdict: filter.verdict, search: filter.search, group: filter.group, source: filter.source, show: filter.question, order: filter.order === "worst" ? "" : filter.order }).filter(([, value]) => value));
    history.replaceState(null, "", told.size ? `/?${told}` : "/");
    most = PAGE;
    sift();
    order(true);
  }

  // Rows are put where they belong, but not under somebody's hands.
  function order(forced = false) {
    if (!forced && (body.matches(":hover") || body.contains(document.activeElement))) return;
    const [words, key] = ORDERS[orders.value];
    set(grid, "aria-label", `Assets, ${words[0].toLowerCase()}${words.slice(1)}`);
    const by = (a, b) => (key(a.row) < key(b.row) ? -1 : key(a.row) > key(b.row) ? 1 : 0);
    const worst = [...assets.values()].filter((one) => one.shown).sort((a, b) => faulty(a.row) - faulty(b.row) || by(a, b) || rank(b.row) - rank(a.row) || (a.row.asset < b.row.asset ? -1 : 1));
    worst.slice(0, most).forEach((one, i) => {
      if (!one.line) (one.line = lineOf(one.row)).update(one.row, now);
      const { element } = one.line;
      if (body.children[i] !== element) body.insertBefore(element, body.children[i] ?? null);
    });
    while (body.children.length > Math.min(worst.length, most)) body.lastChild.remove();
    more.hidden = worst.length <= most;
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
        const one = { row, tile: h("a", { class: "tile", href: `/assets/${encodeURIComponent(row.asset)}` }) };
        assets.set(row.asset, one);
        dress(one);
        fresh = true;
      } else if (row.at >= known.row.at) {
        fresh ||= known.row.group !== row.group;
        const changed = known.row.verdict !== row.verdict || known.row.summary !== row.summary || known.row.alarms.length || row.alarms.length;
        known.row = row;
        if (changed) dress(known);
      }
      const one = assets.get(row.asset);
      one.line?.update(one.row, now);
    }
    recount();
    fold();
    sift();
    if (fresh && !loading) draw();
  }

  function draw() {
    chart();
    order(true);
  }

  // What is empty for all takes no room.
  function fold() {
    const rows = [...assets.values()].map((one) => one.row);
    const empty = COLUMNS.map(([, , holds]) => Boolean(holds) && !rows.some(holds));
    if (grid.dataset.empty === String(empty)) return;
    grid.dataset.empty = String(empty);
    empty.forEach((gone, i) => grid.classList.toggle(`without-${i}`, gone));
    grid.style.setProperty("--columns", COLUMNS.filter((_, i) => !empty[i]).map(([, width]) => width).join(" "));
  }

  const first = await get(`/assets?limit=${PAGE}`, signal);
  now = first.now;
  configured = first.configured;
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
    first.mark,
  );
  const timer = setInterval(() => order(), ORDER_MS);
  const clock = setInterval(() => {
    now += 1;
    for (const { row, line } of assets.values()) line?.age(row, now);
  }, 1000);
  signal.addEventListener("abort", () => [timer, clock].forEach(clearInterval));
  loading = true;
  for (let offset = PAGE; offset < first.total; offset += PAGE) take((await get(`/assets?limit=${PAGE}&offset=${offset}`, signal)).assets);
  loading = false;
  if (first.total > PAGE) draw();
}

// What a mark on the map says: verdict by shape and colour, an alarm to answer by its frame.
function dress({ row, tile }) {
  const open = row.alarms.some((alarm) => OPEN.includes(alarm.state));
  const look = `tile ${row.verdict} ${open ? "open" : ""}`;
  const words = `${row.asset}: ${VERDICTS[row.verdict]}${open ? ", alarm to acknowledge" : ""}`;
  if (tile.dataset.look !== look) {
    tile.dataset.look = look;
    for (const name of ["fault", "suspect", "healthy", "undetermined"]) tile.classList.toggle(name, name === row.verdict);
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

// What is known, without the verdict, which stands beside it: numbers first, as what is long is cut off at its end.
function known(row) {
  if (row.verdict !== "fault" || !row.sizes?.length) return withoutVerdict(sentence(row.summary));
  const sizes = row.sizes.map((one) => `${one.parameter} ${size({ ...one, interval: [one.low, one.high] })[0]}`);
  return `${sizes.join(", ")}: ${row.sizes.map((one) => translate(one.words).replace(/ \(.*/, "")).join("; ")}`;
}

// The first steps of somebody who follows nothing yet.
function beginning() {
  const step = (words, address, link) => h("li", {}, words, " ", address ? h("a", { href: address }, link) : h("code", { translate: "no" }, link));
  return h(
    "section",
    {},
    h("h2", {}, "Add a machine"),
    h(
      "ol",
      { class: "why" },
      step("Drop a log of the healthy machine, and get the settings of its loop:", "/begin", "Begin with a log"),
      step("Learn from healthy recordings what the loop looks like:", "/learn", "Learn a baseline"),
      step("Name the baseline and the source of the samples in a service file, and follow them:", null, "servoscope run hall.toml"),
    ),
    h("p", {}, "No assets yet: `servoscope run` follows them, and writes what it finds to this store."),
  );
}

function withoutVerdict(words) {
  const verdict = ["Fault", "Suspect", "Healthy", "Undetermined", ...Object.values(VERDICTS)].find((one) => words.startsWith(`${one}: `)); // a service may speak another language
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
  const [group, what, lasting, deviation, growth, limit, data, alarms, last] = [cell(), cell("what"), cell("n"), cell("n"), cell("n"), cell("n"), cell(), cell(), cell("n")];
  const distance = gauge();
  const element = h("div", { role: "row", class: "line" }, state, h("span", { role: "cell", class: "name" }, name), group, what, lasting, distance.element, deviation, growth, limit, data, alarms, last);
  [...element.children].forEach((one, i) => set(one, "data-name", COLUMNS[i][0]));
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
      element.classList.remove("fault", "suspect", "healthy", "undetermined");
      element.classList.add(verdict);
      state.replaceChildren(mark(verdict), VERDICTS[verdict]);
    }
    const open = row.alarms.filter((alarm) => OPEN.includes(alarm.state)).length;
    const told = known(row);
    tell(group, row.group || DASH);
    say(what, told);
    set(what, "title", told);
    const from = row.verdict === "fault" ? (row.onset ?? row.since) : row.since;
    tell(lasting, duration(Math.max(row.t - from, 0)));
    set(lasting, "title", moment(from));
    drawn(distance, row.statistic === null ? null : Math.max(row.statistic, row.level ?? 0));
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
