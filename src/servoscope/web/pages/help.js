// Where the documentation explains a section, and what words of the glossary mean.
import { translate } from "./translate.js";

const USUAL = "how-to/read-a-verdict"; // of what a document says
const PAGES = {
  "alarms#life-cycle": ["Alarms", "Events", "What has happened"],
  "how-to/actions": ["Notifications"],
  "how-to/before-deployment": ["Studies", "How sure a size becomes", "How alike they look", "What else it could be"],
  "how-to/assess": ["What is wrong, without a baseline"],
  "how-to/dashboard#pages": ["Timeline", "Signals", "Stream", "Two periods side by side"],
  "how-to/own-log#1-what-has-to-be-in-the-log": ["Log", "Recording"],
  "how-to/own-log#2-a-loop-file": ["Proposed settings", "Loop"],
  "how-to/own-log#3-columns-and-units": ["What is what"],
  "how-to/own-log#4-inspect": ["Is the log usable?", "Is it usable?"],
  "how-to/own-log#5-learn": ["Healthy recordings", "What was learned"],
  "how-to/read-a-verdict#the-motion-signature": ["Motion signature"],
  "how-to/read-a-verdict#the-four-verdicts": ["Verdict", "Diagnoses", "Diagnoses of recordings"],
  "how-to/relearn": ["Baseline", "Baselines"],
  "how-to/robot-arm#in-a-service": ["The arm and its joints"],
  "how-to/trend": ["How it grows"],
  "explanation/how-it-works#6-detection-and-isolation": ["Distance from healthy", "Inverse frequency response", "Inverse response over frequency", "Coefficients"],
};
const TOPICS = Object.fromEntries(Object.entries(PAGES).flatMap(([page, titles]) => titles.map((title) => [title, page])));
// As docs/glossary.md has it.
const GLOSSARY = {
  "95 % interval": "holds the true value in 95 of 100 cases, if the model is right",
  baseline: "what healthy looks like: learned from recordings, or computed from the plant's nominal parameters",
  coherence: "how much of a signal at one frequency follows another signal; 1: all of it, 0: nothing",
  cutoff: "the frequency up to which a filter lets signals through",
  excitation: "motion that is rich enough to determine a parameter: without acceleration no mass",
  iFRF: "inverse frequency response, u over y, at the monitored frequencies",
  onset: "when a change began; the alarm comes later",
  recursion: "the estimator that runs along with the recording; its answer is printed with the refit's",
  refit: "maximum-likelihood fit of the seconds around an onset on the exact sampled plant; the headline of a diagnosis where there is one",
  "sequential test": "adds up small deviations of one kind until the sum passes a limit: finds small changes that last",
};
const MEANINGS = new Map(Object.entries(GLOSSARY).map(([term, meaning]) => [translate(term).toLowerCase(), meaning]));
const TERMS = new RegExp(`(?<![\\p{L}\\d])(${[...MEANINGS.keys()].join("|").replaceAll(" ", "[ \\u00a0]")})(?![\\p{L}\\d])`, "giu");

export function topic(title) {
  const [page, part] = (TOPICS[title] ?? USUAL).split("#");
  return `/help/${page}.html${part ? `#${part}` : ""}`;
}

// A text in the reader's language as pieces, each with its meaning, null for what needs none.
export const pieces = (text) => text.split(TERMS).map((piece, i) => [piece, i % 2 ? MEANINGS.get(piece.toLowerCase().replaceAll("\u00a0", " ")) : null]);
