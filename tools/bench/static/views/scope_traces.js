// What is set for a single trace: coupling, scale, offset, filter, thresholds; and traces that are computed.
import { h, unitText } from "../dom.js";
import { FILTERS, MATHS, calculate, filtered, mean, mids, step125 } from "../signals.js";

export const TRACE = { coupling: "ac", div: "auto", offset: 0, filter: "none", low: "", high: "" };
const DIVS = 4; // divisions of a lane, from its lower to its upper edge
const CALM = 90; // pictures for which a trace must be small before its lane is scaled up

/** Traces of the scope: channels and maths, with what the lane of each needs. */
export function listTraces(settings, known) {
  const own = (name, otherwise = {}) => ({ ...TRACE, ...otherwise, ...settings.traces[name] });
  const channels = settings.channels.filter((name) => known.has(name)).map((name) => {
    const { unit, group } = known.get(name);
    return { name, unit: unitText(unit), group: ["V", "1"].includes(unit) ? `${unit} ${group}` : unit, sources: [name], set: own(name) };
  });
  const maths = settings.maths.filter((m) => known.has(m.a) && (!MATHS[m.op][1] || known.has(m.b))).map((m) => {
    const [text, two, unitOf] = MATHS[m.op];
    const unit = unitOf(unitText(known.get(m.a).unit));
    return { name: text(m.a, m.b), unit, group: `maths ${unit}`, sources: two ? [m.a, m.b] : [m.a], op: m.op, set: own(text(m.a, m.b), m.op === "rms" ? { coupling: "dc" } : {}) };
  });
  return [...channels, ...maths].map((trace) => ({ ...trace, lane: { div: 0, small: 0 } }));
}

/** Low and high of each bucket of a trace, filtered and less its mean where it is AC-coupled. */
export function samplesOf(trace, buckets, columns, rateHz) {
  const at = trace.sources.map((name) => columns.indexOf(name));
  let low = buckets.lows(at[0]);
  let high = buckets.perBucket === 1 ? low : buckets.highs(at[0]);
  let note = "";
  if (trace.op) low = high = calculate(trace.op, mids(low, high), at.length > 1 ? mids(buckets.lows(at[1]), buckets.highs(at[1])) : null, rateHz);
  if (trace.set.filter !== "none") {
    const out = filtered(mids(low, high), trace.set.filter, rateHz);
    if (out) low = high = out;
    else note = "not filtered: window too long";
  }
  const base = trace.set.coupling === "ac" ? mean(mids(low, high)) : 0;
  return { low, high, base, note };
}

/** Size of a division: as set, or of 1, 2, 5, ... so that the trace fits its lane; grows at once and shrinks late. */
export function divisionOf(trace, { low, high, base }) {
  if (trace.set.div !== "auto") return Number(trace.set.div);
  let most = 0;
  for (let i = 0; i < low.length; i++) {
    if (base - low[i] > most) most = base - low[i];
    if (high[i] - base > most) most = high[i] - base;
  }
  const wanted = step125(most / (DIVS / 2 - 0.1));
  const { lane } = trace;
  if (!most && lane.div) return lane.div;
  lane.small = wanted < lane.div ? lane.small + 1 : 0;
  if (wanted > lane.div || lane.small > CALM) [lane.div, lane.small] = [wanted, 0];
  return lane.div;
}

/** A value (less its base) of a trace to its place in the strip: lane `i` of `n`, each 1 high, from above. */
export const placeIn = (i, n, div, offset) => (value) => n - 0.5 - i + (value / div + offset) / DIVS;

/** Positions and texts of the vertical axis of a strip with lanes. A lane that is too low for its divisions has its unit at zero. */
export function laneTicks(n, divs, units, offsets, lanePx, text) {
  const steps = lanePx >= 56 ? [-1, 0, 1] : lanePx >= 30 ? [-1, 1] : [0];
  const ticks = divs.flatMap((div, i) => steps.map((s) => ({
    at: n - 0.5 - i + (s + Number(offsets[i])) / DIVS, text: s ? text(s * div, units[i]) : steps.length > 1 ? "0" : text(0, units[i]),
  })));
  return ticks.sort((p, q) => p.at - q.at);
}

export function tracePanel(settings, traces, changed) {
  const boxes = traces.map((trace) => {
    const put = (key, value) => {
      settings.traces[trace.name] = { ...trace.set, [key]: value };
      changed();
    };
    const choice = (key, label, options) => h("label", {}, label, h("select", { "aria-label": `${label} of ${trace.name}`, onchange: (e) => put(key, e.target.value) },
      options.map(([value, title]) => h("option", { value, selected: String(trace.set[key]) === String(value) }, title))));
    const number = (key, label) => h("label", {}, label, h("input", { type: "number", step: "any", value: trace.set[key], "aria-label": `${label} of ${trace.name}`, onchange: (e) => put(key, e.target.value) }));
    const unit = trace.unit === "m" ? "µm" : trace.unit;
    const scale = trace.unit === "m" ? 1e-6 : 1;
    const steps = [];
    for (let power = -3; power <= 4; power++) for (const s of [1, 2, 5]) steps.push(Number((s * 10 ** power).toPrecision(1)));
    return h("details", {}, h("summary", {}, trace.name),
      h("div.set", {},
        choice("coupling", "coupling", [["ac", "AC"], ["dc", "DC"]]),
        choice("div", `${unit || "1"}/div`, [["auto", "auto"], ...steps.map((s) => [Number((s * scale).toPrecision(1)), String(s)])]),
        number("offset", "offset, div"),
        choice("filter", "filter", Object.entries(FILTERS).map(([key, [title]]) => [key, title])),
        number("low", `low limit, ${unit || "1"}`), number("high", `high limit, ${unit || "1"}`)),
      trace.op ? h("button.quiet", { onclick: () => { settings.maths = settings.maths.filter((m) => MATHS[m.op][0](m.a, m.b) !== trace.name); changed(); } }, "Remove") : null);
  });
  return h("div.panel.traces", {}, h("h2", {}, "Traces"), boxes,
    h("p.note", {}, "AC: less the mean of what is shown. Offsets in divisions of the trace's own scale. Outside its limits a trace is red."));
}

export function mathsPanel(settings, catalogue, changed) {
  const options = () => catalogue.map((c) => h("option", { value: c.name }, c.name));
  const op = h("select", { "aria-label": "What to compute", onchange: () => show() }, [["sum", "a + b"], ["difference", "a − b"], ["derivative", "d/dt a"], ["rms", "rms of a, 0.5 s"]].map(([value, title]) => h("option", { value }, title)));
  const a = h("select", { "aria-label": "Channel a" }, options());
  const b = h("select", { "aria-label": "Channel b" }, options());
  [a.value, b.value] = ["tip_displacement_x", "tip_displacement_y"];
  const second = h("label", {}, "b", b);
  const problem = h("p.bad", { role: "alert" });
  const show = () => { second.hidden = !MATHS[op.value][1]; };
  show();
  const unit = (name) => catalogue.find((c) => c.name === name)?.unit;
  const add = h("button", { onclick: () => {
    const two = MATHS[op.value][1];
    problem.textContent = two && unit(a.value) !== unit(b.value) ? `${a.value} is in ${unit(a.value)}, ${b.value} in ${unit(b.value)}: they do not add up.` : "";
    if (problem.textContent || settings.maths.length >= 8) return;
    settings.maths.push({ op: op.value, a: a.value, b: two ? b.value : "" });
    changed();
  } }, "Add trace");
  return h("div.panel", {}, h("h2", {}, "Maths"), h("div.set", {}, op, h("label", {}, "a", a), second, add), problem);
}
