// Settings of the scope from outside (a layout, another version of the page): what makes no sense is left out.
import { FILTERS, MATHS } from "../signals.js";
import { MAX_CHANNELS } from "./scope_channels.js";

const isObject = (v) => v !== null && typeof v === "object" && !Array.isArray(v);
const isNumberText = (v) => (typeof v === "number" || (typeof v === "string" && v.trim() !== "")) && Number.isFinite(Number(v));

/** Correct `settings` in place by `defaults`; `lists` has the values allowed: windows, modes, tops. Answers the channels
 * that this bench does not have. */
export function tidy(settings, defaults, known, lists) {
  const one = (key, allowed) => { if (!allowed.includes(settings[key])) settings[key] = defaults[key]; };
  one("rows", lists.windows);
  one("mode", lists.modes);
  one("top", lists.tops);
  one("display", ["lanes", "shared"]);
  one("side", [true, false]);
  for (const key of ["first", "second"]) if (typeof settings[key] !== "string") settings[key] = "";
  if (!Array.isArray(settings.channels)) settings.channels = defaults.channels;
  const unknown = settings.channels.filter((name) => !known.has(name)).map(String);
  settings.channels = [...new Set(settings.channels.filter((name) => known.has(name)))].slice(0, MAX_CHANNELS);
  if (unknown.length && !settings.channels.length) settings.channels = defaults.channels; // what another instrument showed
  settings.maths = (Array.isArray(settings.maths) ? settings.maths : [])
    .filter((m) => isObject(m) && Object.hasOwn(MATHS, m.op) && typeof m.a === "string" && typeof m.b === "string").slice(0, 8);
  const traces = isObject(settings.traces) ? settings.traces : {};
  settings.traces = Object.fromEntries(Object.entries(traces).filter(([, set]) => isObject(set)).map(([name, set]) => [name, tidyTrace(set)]));
  const trigger = isObject(settings.trigger) ? settings.trigger : {};
  const allowed = { on: [true, false], slope: ["up", "down", "event"], mode: ["auto", "normal", "single"] };
  settings.trigger = { ...defaults.trigger };
  for (const [key, values] of Object.entries(allowed)) if (values.includes(trigger[key])) settings.trigger[key] = trigger[key];
  if (known.has(trigger.channel)) settings.trigger.channel = trigger.channel;
  if (typeof trigger.level === "number" && Number.isFinite(trigger.level)) settings.trigger.level = trigger.level;
  return unknown;
}

function tidyTrace(set) {
  const kept = {};
  if (["ac", "dc"].includes(set.coupling)) kept.coupling = set.coupling;
  if (Object.hasOwn(FILTERS, set.filter)) kept.filter = set.filter;
  if (set.div === "auto" || (isNumberText(set.div) && Number(set.div) > 0)) kept.div = set.div;
  if (isNumberText(set.offset)) kept.offset = set.offset;
  for (const key of ["low", "high"]) if (set[key] === "" || isNumberText(set[key])) kept[key] = set[key];
  return kept;
}
