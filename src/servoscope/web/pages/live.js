// Live updates: one stream per page, joined to at most one call per drawn frame; silent while the page is hidden.

// Calls `heard({ event: [data, ...] })`. `state` hears "live" or "lost"; the browser itself connects again.
export function follow(path, events, heard, state, signal) {
  let waiting = {};
  let wanted = 0;
  let source = null;
  const flush = () => {
    wanted = 0;
    const told = waiting;
    waiting = {};
    heard(told);
    // When the newest of what is shown was told [UTC s]: an attribute, for whoever wants to know whether the page keeps up.
    const last = told.assets?.at(-1)?.now ?? told.asset?.at(-1)?.at;
    if (last) document.documentElement.dataset.told = last;
  };
  const open = () => {
    source = new EventSource(`/api/v1/live${path}`);
    source.onopen = () => state("live");
    source.onerror = () => {
      state("lost");
      if (source.readyState === EventSource.CLOSED) retry();
    };
    for (const name of events) {
      source.addEventListener(name, (event) => {
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
  signal.addEventListener("abort", close);
  seen();
}
