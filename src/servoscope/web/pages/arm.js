// An arm in the middle of a diagnosis, seen from the side and above; its joints are filled by the probability of a change.
import { s, translate } from "./dom.js";

const [WIDTH, HEIGHT, MARGIN, LETTERS] = [640, 300, 24, 120]; // px; the last one for names beside the joints
const [LIKELY, POSSIBLE] = [0.5, 0.05]; // probabilities of a change
const tone = (odds) => (odds >= LIKELY ? "fault" : odds >= POSSIBLE ? "care" : "");

export function drawnArm({ names, parents, places, odds }) {
  const flat = [[0, 0, 0], ...places].map(([x, y, z]) => [0.87 * (y - x), z - 0.35 * (x + y)]);
  const [across, up] = [0, 1].map((i) => flat.map((point) => point[i]));
  const [left, low] = [Math.min(...across), Math.min(...up)];
  const scale = Math.min((WIDTH - 2 * MARGIN - LETTERS) / (Math.max(...across) - left || 1), (HEIGHT - 2 * MARGIN) / (Math.max(...up) - low || 1));
  const [base, ...joints] = flat.map(([x, y]) => [MARGIN + scale * (x - left), HEIGHT - MARGIN - scale * (y - low)]);
  const links = joints.map(([x, y], i) => {
    const [fromX, fromY] = joints[parents[i]] ?? base;
    return s("line", { x1: fromX, y1: fromY, x2: x, y2: y });
  });
  const dots = joints.map(([x, y], i) => s("circle", { cx: x, cy: y, r: 7, class: tone(odds[i]) }, s("title", {}, `${names[i]}: ${Math.round(100 * odds[i])} %`)));
  const labels = joints.map(([x, y], i) => s("text", { x: x + 11, y: y - 6, translate: "no" }, names[i]));
  return s("svg", { class: "arm", viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": translate("The arm and its joints") }, links, dots, labels);
}
