// The HTTP interface: session, requests, jobs, uploads; errors are problems whose message can be shown as it is.

const ROOT = "/api/v1";
let known = null;
let logInAgain = async () => false;

export class Problem extends Error {
  constructor(status, problem) {
    const details = (problem.errors ?? []).map((each) => `${each.where}: ${each.what}`).join("; ");
    super(details ? `${problem.detail ?? problem.title} (${details})` : (problem.detail ?? problem.title));
    this.status = status;
  }
}

async function ask(method, path, { body, raw, signal } = {}) {
  const headers = {};
  if (method !== "GET") {
    headers["Content-Type"] = raw ? "application/octet-stream" : "application/json";
    if (known?.csrf) headers["X-CSRF-Token"] = known.csrf;
  }
  let answer;
  try {
    answer = await fetch(ROOT + path, { method, headers, signal, body: raw ?? (body === undefined ? undefined : JSON.stringify(body)) });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Problem(0, { detail: "The service does not answer." });
  }
  if (answer.status === 204) return null;
  const plain = await answer.json().catch(() => ({}));
  if (answer.ok) return plain;
  if (path !== "/session" && (await renewed(answer.status, method))) return ask(method, path, { body, raw, signal });
  throw new Problem(answer.status, { title: answer.statusText, ...plain });
}

// Whether it is worth asking again: the session was over and another has begun, here or on another page with a token of its own.
async function renewed(status, method) {
  if (status === 401) return logInAgain();
  const before = known?.csrf;
  return status === 403 && method !== "GET" && (await session()).csrf !== before;
}

// What asks for a login over the page, so that the work on it stays; it returns whether somebody has logged in.
export function whenSessionEnds(asks) {
  logInAgain = asks;
}

export const get = (path, signal) => ask("GET", path, { signal });
export const post = (path, body, signal) => ask("POST", path, { body, signal });
export const remove = (path) => ask("DELETE", path);
export const part = encodeURIComponent;

// An address with a query; parts that are empty are left out.
export function query(path, values) {
  const told = Object.entries(values).filter(([, value]) => value !== null && value !== undefined && value !== "");
  return told.length ? `${path}?${new URLSearchParams(told)}` : path;
}

export async function session() {
  known = await get("/session");
  return known;
}

export async function login(user, password) {
  known = await post("/session", { user, password });
  return known;
}

export async function logout() {
  await remove("/session");
}

export function upload(file, signal) {
  return ask("POST", query("/uploads", { name: file.name }), { raw: file, signal });
}

// Ask for work that takes seconds, and wait for its result; `step` hears how far it is.
export async function job(path, body, { signal, step = () => {} } = {}) {
  let one = await post(path, body, signal);
  while (one.state === "queued" || one.state === "running") {
    step(one.step ?? (one.state === "queued" ? "waiting for its turn" : "working"));
    one = await get(`/jobs/${part(one.id)}?wait=1`, signal);
  }
  if (one.state === "failed") throw new Problem(one.problem?.status ?? 500, one.problem ?? { detail: "It failed." });
  return one.result;
}

export function mayChange(role, needed) {
  const ranks = ["viewer", "operator", "engineer"];
  return ranks.indexOf(role) >= ranks.indexOf(needed);
}
