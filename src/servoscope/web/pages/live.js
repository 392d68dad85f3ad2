// Live updates: one stream per page, joined to at most one call per drawn frame; silent while the page is hidden.
import { query } from "./api.js";

const QUIET_S = 60.0; // without news, beyond what sources pause: the server is there, the service perhaps not

// Calls `heard({ event: [data, ...] })`. `state` hears "live", "quiet" or "lost"; the browser itself connects again.
// `mark`: of what is known already, which is not sent once more.
export function follow(path, events, heard, state, signal, mark = "") {
  let waiting = {};
  let wanted = 0;
  let source = null;
  let news = performance.now() / 1000; // when the newest of what is shown was stored [s]
  let pause = 0; // of the source that pauses longest [s]
  const dated = events.includes("assets") || events.includes("asset"); // others tell what is rare
  const judge = () => source?.readyState === EventSource.OPEN && state(dated && performance.now() / 1000 - news > QUIET_S + pause ? "quiet" : "live");
  const flush = () => {
    wanted = 0;
    const told = waiting;
    waiting = {};
    const rows = [...(told.assets ?? []).flatMap((each) => each.assets), ...(told.asset ?? [])];
    const latest = Math.max(...rows.map((row) => row.at));
    pause = Math.max(pause, ...rows.map((row) => row.pause_s));
    if (latest > -Infinity) news = performance.now() / 1000 - ((told.assets ?? told.asset).at(-1).now - latest);
    judge();
    heard(told);
    // When the newest of what is shown was told [UTC s]: an attribute, for whoever wants to know whether the page keeps up.
    const last = told.assets?.at(-1)?.now ?? told.asset?.at(-1)?.at;
    if (last) document.documentElement.dataset.told = last;
  };
  const open = () => {
    source = new EventSource(`/api/v1/live${query(path, { since: mark })}`);
    source.onopen = judge;
    source.onerror = () => {
      state("lost");
      if (source.readyState === EventSource.CLOSED) retry();
    };
    for (const name of events) {
      source.addEventListener(name, (event) => {
        mark = event.lastEventId || mark;
        (waiting[name] ??= []).push(JSON.parse(event.data));
        wanted ||= requestAnimationFrame(flush);
      });
    }
  };
  const close = () => {
    source?.close();
    source = null;
    cancelAnimationFrame(wanted);
    wanted = 0;
    waiting = {};
  };
  // Refused for good, say because the session is over: ask again, the session first.
  const retry = () => setTimeout(() => (document.hidden || signal.aborted ? null : dispatchEvent(new Event("streamclosed")) && open()), 3000);
  const seen = () => (document.hidden ? close() : source || open());
  document.addEventListener("visibilitychange", seen, { signal });
  const timer = setInterval(judge, 5000);
  signal.addEventListener("abort", () => (close(), clearInterval(timer)));
  seen();
}
