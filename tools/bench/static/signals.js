// What the scope computes from samples: coupling, filters, maths, scales. Plain functions on arrays, no state.

/** Middle of smallest and largest value of each bucket. */
export function mids(low, high) {
  const values = new Float64Array(low.length);
  for (let i = 0; i < low.length; i++) values[i] = low === high ? low[i] : (low[i] + high[i]) / 2;
  return values;
}

export function mean(values) {
  let [sum, n] = [0, 0]; // a recording has gaps: no number is no value
  for (let i = 0; i < values.length; i++) if (values[i] === values[i]) [sum, n] = [sum + values[i], n + 1];
  return n ? sum / n : 0;
}

/** Second-order sections by the bilinear transform (Bristow-Johnson's cookbook): [b0, b1, b2, a1, a2], a0 = 1. */
export function section(kind, hz, q, rateHz) {
  const w = (2 * Math.PI * hz) / rateHz;
  const [c, alpha] = [Math.cos(w), Math.sin(w) / (2 * q)];
  const b = kind === "low" ? [(1 - c) / 2, 1 - c, (1 - c) / 2] : kind === "high" ? [(1 + c) / 2, -1 - c, (1 + c) / 2] : [alpha, 0, -alpha];
  return [...b, -2 * c, 1 - alpha].map((v) => v / (1 + alpha));
}

/** Filter `values`, as if the first one had been there for ever. Where there is no number the result has none; the
 * filter goes on from the number before. */
export function run(values, [b0, b1, b2, a1, a2]) {
  const out = new Float64Array(values.length);
  const x0 = values.find((v) => v === v) ?? 0;
  const y0 = (x0 * (b0 + b1 + b2)) / (1 + a1 + a2);
  let s2 = b2 * x0 - a2 * y0;
  let s1 = b1 * x0 - a1 * y0 + s2;
  let x = x0;
  for (let i = 0; i < values.length; i++) {
    const known = values[i] === values[i];
    if (known) x = values[i];
    const y = b0 * x + s1;
    s1 = b1 * x - a1 * y + s2;
    s2 = b2 * x - a2 * y;
    out[i] = known ? y : NaN;
  }
  return out;
}

/** Filters by name: text, kind, frequency in Hz, Q. Butterworth, but for the band: 3 dB at 8 and 12 Hz. */
export const FILTERS = {
  none: ["no filter"],
  low: ["below 30 Hz", "low", 30, Math.SQRT1_2],
  high: ["above 2 Hz", "high", 2, Math.SQRT1_2],
  band: ["8 to 12 Hz", "band", Math.sqrt(8 * 12), Math.sqrt(8 * 12) / 4],
};

/** `values` at `rateHz` through a filter of the table; null when the rate is too low for it. */
export function filtered(values, name, rateHz) {
  const [, kind, hz, q] = FILTERS[name];
  if (!kind) return values;
  return hz < 0.4 * rateHz ? run(values, section(kind, hz, q, rateHz)) : null;
}

/** Central difference, per second; the ends repeat their neighbours. */
export function derivative(values, rateHz) {
  const out = new Float64Array(values.length);
  for (let i = 1; i + 1 < values.length; i++) out[i] = ((values[i + 1] - values[i - 1]) * rateHz) / 2;
  if (values.length > 2) [out[0], out[out.length - 1]] = [out[1], out[out.length - 2]];
  return out;
}

/** Root of the mean square about the mean of the last `seconds`; fewer samples at the start. */
export function rms(values, seconds, rateHz) {
  const n = Math.max(1, Math.round(seconds * rateHz));
  const out = new Float64Array(values.length);
  const zero = mean(values);
  let [sum, squares, m] = [0, 0, 0];
  const add = (value, sign) => {
    if (value !== value) return; // a recording has gaps: no number is no sample
    [sum, squares, m] = [sum + sign * (value - zero), squares + sign * (value - zero) ** 2, m + sign];
  };
  for (let i = 0; i < values.length; i++) {
    add(values[i], 1);
    if (i >= n) add(values[i - n], -1);
    out[i] = values[i] === values[i] ? Math.sqrt(Math.max(0, squares / m - (sum / m) ** 2)) : NaN;
  }
  return out;
}

/** Maths by name: text of the result, whether it takes two channels, its unit. */
export const MATHS = {
  sum: [(a, b) => `${a} + ${b}`, true, (u) => u],
  difference: [(a, b) => `${a} − ${b}`, true, (u) => u],
  derivative: [(a) => `d/dt ${a}`, false, (u) => (u === "1" ? "1/s" : u.endsWith("/s") ? `${u}²` : u.endsWith("/s²") ? u.replace("²", "³") : `${u}/s`)],
  rms: [(a) => `rms ${a}`, false, (u) => u],
};
const RMS_S = 0.5;

export function calculate(op, a, b, rateHz) {
  if (op === "derivative") return derivative(a, rateHz);
  if (op === "rms") return rms(a, RMS_S, rateHz);
  return a.map((v, i) => (op === "sum" ? v + b[i] : v - b[i]));
}

/** The smallest of 1, 2, 5, 10, ... that is not below `value`. */
export function step125(value) {
  if (!(value > 0) || !Number.isFinite(value)) return 1;
  const power = 10 ** Math.floor(Math.log10(value) + 1e-9);
  return [1, 2, 5, 10].find((s) => s * power >= value * (1 - 1e-9)) * power;
}

const SCALED = new Set(["V", "A", "m", "s", "µm", "W", "V/s", "m/s", "rad/s"]);
const PREFIXES = [[1e-9, "n"], [1e-6, "µ"], [1e-3, "m"], [1, ""], [1e3, "k"]];

/** A value with its unit and a prefix where the unit takes one: 0.02 V is "20 mV". */
export function withUnit(value, unit, places = 3) {
  if (!Number.isFinite(value)) return "–";
  let [v, prefix] = [value, ""];
  if (unit === "m") [v, unit] = [value * 1e6, "µm"];
  else if (SCALED.has(unit) && unit !== "µm" && value !== 0 && Math.abs(value) < 0.1) {
    const found = PREFIXES.findLast(([size]) => Math.abs(value) >= size * (1 - 1e-9)) || PREFIXES[0];
    [v, prefix] = [value / found[0], found[1]];
  }
  const size = Math.abs(v);
  const text = size >= 1e5 || (size < 1e-3 && size > 0) ? v.toExponential(1) : String(Number(v.toPrecision(places)));
  return unit ? `${text} ${prefix}${unit}` : text;
}
