// The samples that the store keeps of an asset as a file, so that a new baseline can be learned from them.
import { get, query } from "./api.js";

const POINTS = 20000; // in one answer: as many are told without thinning

// All samples after `since` [UTC s] (null: all), as a CSV file; null if there are none.
export async function storedSamples(path, asset, since, signal) {
  const seconds = Math.min(POINTS / (2 * asset.about.sample_rate_hz), 3600);
  const parts = [];
  for (let to = asset.t; since === null || to > since; to -= seconds) {
    const found = await get(query(`${path}/signals`, { seconds, to, points: POINTS }), signal);
    if (!found.samples) break;
    parts.unshift(found);
  }
  const rows = parts.flatMap(({ t, r, u, y }) => t.map((at, i) => [at, r[i] ?? "", u[i] ?? "", y[i] ?? ""])).filter(([at]) => since === null || at > since);
  if (!rows.length) return null;
  const day = new Date(1000 * rows[0][0]).toISOString().slice(0, 19).replaceAll(":", "");
  const name = `${asset.asset.replace(/[^\w.-]/g, "_")} ${day}.csv`;
  return new File([["t,r,u,y", ...rows.map(String), ""].join("\n")], name, { type: "text/csv" });
}
