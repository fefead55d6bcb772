// What the scope shows instead of time: one trace over another, spectra, and a spectrum over time.
import { canvas, colours, css, h } from "../dom.js";
import { spectrum } from "../fourier.js";
import { drawSpans, spanText } from "../holds.js";
import { mids, step125, withUnit } from "../signals.js";

export const TOPS = [30, 100, 500];
const COLD = [[13, 22, 38], [31, 73, 110], [24, 130, 130], [120, 190, 90], [250, 230, 90]];

/** Colour of `share` from 0 to 1, dark to bright, as [r, g, b]. */
export function heat(share) {
  const at = Math.max(0, Math.min(1, share)) * (COLD.length - 1);
  const i = Math.min(COLD.length - 2, Math.floor(at));
  return COLD[i].map((v, k) => Math.round(v + (COLD[i + 1][k] - v) * (at - i)));
}

/** Spectra of overlapping pieces of `seconds`: {columns: [amplitude arrays], step, centres in samples}. */
export function pieces(values, rateHz, seconds = 0.5, most = 240) {
  const n = 2 ** Math.round(Math.log2(Math.max(8, seconds * rateHz)));
  if (values.length < n) return null;
  const hop = Math.max(1, Math.round(n / 8), Math.ceil((values.length - n) / most));
  const columns = [];
  const centres = [];
  let step = 0;
  for (let i = 0; i + n <= values.length; i += hop) {
    const s = spectrum(values.subarray(i, i + n), rateHz);
    columns.push(s.amplitude);
    centres.push(i + n / 2);
    step = s.step;
  }
  return { columns, centres, step, hop };
}

/** Value of a spectrum at `hz`: the bin that holds it. */
export const amplitudeAt = ({ values, step }, hz) => values[Math.max(0, Math.min(values.length - 1, Math.round(hz / step)))];

export function analysis(settings, changed) {
  let cursors = [null, null]; // [x, y] in what the axes show, for the way to look that is on
  let place = null; // of the picture drawn last: {box, x: [low, high], y: [low, high], titles, say(point)}
  let data = null; // {traces, samples, rateHz, seconds}
  const top = h("select", { "aria-label": "Highest frequency", onchange: () => { settings.top = Number(top.value); changed(); } }, TOPS.map((hz) => h("option", { value: hz, selected: hz === settings.top }, `to ${hz} Hz`)));
  const first = h("select", { "aria-label": "Trace", onchange: () => { settings.first = first.value; changed(); } });
  const second = h("select", { "aria-label": "Trace over it", onchange: () => { settings.second = second.value; changed(); } });
  const picture = canvas(draw, "Analysis of the traces shown");
  const controls = h("div.row");
  const readout = h("div.row.num.marks", { role: "status" });
  const element = h("section.panel.fig.analysis", {}, controls, h("div.chart", {}, picture), readout);
  picture.addEventListener("click", (event) => {
    if (!place) return;
    const { box, x, y } = place;
    const [u, v] = [(event.offsetX - box.left) / (box.right - box.left), (box.bottom - event.offsetY) / (box.bottom - box.top)];
    if (u < 0 || u > 1 || v < 0 || v > 1) return;
    setCursor([x[0] + u * (x[1] - x[0]), y[0] + v * (y[1] - y[0])], event.shiftKey);
  });

  /** The first click sets A, the next one B; with both, a click moves A and one with Shift moves B, as over time. */
  function setCursor(point, shift) {
    cursors[shift || (cursors[0] && !cursors[1]) ? 1 : 0] = point;
    picture.redraw();
  }

  function drawCursors(g) {
    if (!place) { readout.replaceChildren(); return; }
    const { box, x, y, say } = place;
    cursors.forEach((point, i) => {
      if (!point) return;
      const [px, py] = [box.left + ((point[0] - x[0]) / (x[1] - x[0])) * (box.right - box.left), box.bottom - ((point[1] - y[0]) / (y[1] - y[0])) * (box.bottom - box.top)];
      g.save();
      g.strokeStyle = g.fillStyle = css(i ? "--c2" : "--accent");
      g.setLineDash([4, 3]);
      g.beginPath();
      if (px >= box.left && px <= box.right) { g.moveTo(px, box.top); g.lineTo(px, box.bottom); }
      if (settings.mode !== "fft" && py >= box.top && py <= box.bottom) { g.moveTo(box.left, py); g.lineTo(box.right, py); }
      g.stroke();
      g.font = `600 11px ${css("--mono")}`;
      if (px >= box.left && px <= box.right) g.fillText("AB"[i], px + 3, box.top + 11);
      g.restore();
    });
    const words = cursors[0] ? say(...cursors) : ["Click sets cursor A, click again cursor B; then a click moves A, with Shift B"];
    readout.replaceChildren(...words.map((text) => h("span", { className: cursors[0] ? "" : "faint" }, text)),
      cursors[0] ? h("button.quiet", { onclick: () => { cursors = [null, null]; picture.redraw(); } }, "clear cursors") : "");
  }

  function choices(names) {
    for (const [select, key, otherwise] of [[first, "first", 0], [second, "second", 1]]) {
      if (!names.includes(settings[key])) settings[key] = names[Math.min(otherwise, names.length - 1)];
      const now = [...select.options].map((o) => o.value).join();
      if (now !== names.join()) select.replaceChildren(...names.map((name) => h("option", { value: name }, name)));
      select.value = settings[key];
    }
  }

  function mode() {
    cursors = [null, null];
    place = null;
    controls.replaceChildren(...{ xy: [second, h("span.soft", {}, "over"), first], fft: [top], spectrogram: [first, top] }[settings.mode]);
  }

  function frame(g, w, hgt, xTitle, yTitle) {
    const box = { left: 64, top: 18, right: w - 10, bottom: hgt - 34 };
    g.font = `10px ${css("--mono")}`;
    g.fillStyle = css("--soft");
    g.textAlign = "center";
    g.fillText(xTitle, (box.left + box.right) / 2, hgt - 4);
    g.textAlign = "left";
    g.fillText(yTitle, 4, 10);
    return box;
  }

  function grid(g, box, ticks, vertical) {
    g.strokeStyle = css("--grid");
    g.fillStyle = css("--faint");
    g.lineWidth = 1;
    for (const [share, text] of ticks) {
      const at = vertical ? box.left + share * (box.right - box.left) : box.bottom - share * (box.bottom - box.top);
      g.beginPath();
      if (vertical) { g.moveTo(at, box.top); g.lineTo(at, box.bottom); } else { g.moveTo(box.left, at); g.lineTo(box.right, at); }
      g.stroke();
      g.textAlign = vertical ? "center" : "right";
      g.fillText(text, vertical ? at : box.left - 4, vertical ? box.bottom + 12 : at + 3);
    }
    g.textAlign = "left";
  }

  const frequencies = (most) => [0, 0.2, 0.4, 0.6, 0.8, 1].map((s) => [s, String(s * most)]);

  function drawXY(g, w, hgt) {
    const [a, b] = [settings.first, settings.second].map((name) => data.traces.findIndex((t) => t.name === name));
    if (a < 0 || b < 0) return;
    const box = frame(g, w, hgt, `${settings.first}, ${data.traces[a].unit === "m" ? "µm" : data.traces[a].unit}`, `${settings.second}, ${data.traces[b].unit === "m" ? "µm" : data.traces[b].unit}`);
    const [x, y] = [a, b].map((i) => mids(data.samples[i].low, data.samples[i].high).map((v) => v - data.samples[i].base));
    const span = (values) => values.reduce(([low, high], v) => [Math.min(low, v), Math.max(high, v)], [Infinity, -Infinity]);
    const ranges = [span(x), span(y)].map(([low, high]) => ({ middle: (low + high) / 2, half: Math.max((high - low) / 2, 1e-12) * 1.1 }));
    const [wide, tall] = [box.right - box.left, box.bottom - box.top];
    if (data.traces[a].unit === data.traces[b].unit) { // one scale for both: a circle is a circle
      const perPx = Math.max((2 * ranges[0].half) / wide, (2 * ranges[1].half) / tall);
      [ranges[0].half, ranges[1].half] = [(perPx * wide) / 2, (perPx * tall) / 2];
    }
    const ticks = ({ middle, half }, unit) => {
      const by = step125(half / 2.5);
      const from = Math.ceil((middle - half) / by);
      return Array.from({ length: Math.floor((middle + half) / by) - from + 1 }, (_, k) => (from + k) * by)
        .map((v) => [0.5 + (v - middle) / (2 * half), withUnit(v, unit)]);
    };
    const units = [a, b].map((i) => data.traces[i].unit);
    const both = (p, name) => `${name} ${withUnit(p[0], units[0], 4)}, ${withUnit(p[1], units[1], 4)}`;
    place = { box, x: [ranges[0].middle - ranges[0].half, ranges[0].middle + ranges[0].half], y: [ranges[1].middle - ranges[1].half, ranges[1].middle + ranges[1].half],
      say: (p, q) => (q ? [both(p, "A"), both(q, "B"), both([q[0] - p[0], q[1] - p[1]], "Δ"),
        ...(units[0] === units[1] ? [`distance ${withUnit(Math.hypot(q[0] - p[0], q[1] - p[1]), units[0], 4)}`] : [])] : [both(p, "A")]) };
    grid(g, box, ticks(ranges[0], data.traces[a].unit), true);
    grid(g, box, ticks(ranges[1], data.traces[b].unit), false);
    g.strokeStyle = css("--accent");
    g.lineWidth = 1.2;
    g.beginPath();
    for (let i = 0; i < x.length; i++) {
      g.lineTo(box.left + (0.5 + (x[i] - ranges[0].middle) / (2 * ranges[0].half)) * wide, box.bottom - (0.5 + (y[i] - ranges[1].middle) / (2 * ranges[1].half)) * tall);
    }
    g.stroke();
  }

  function drawFFT(g, w, hgt) {
    const most = Math.min(settings.top, data.rateHz / 2);
    const units = [...new Set(data.traces.map((t) => (t.unit === "m" ? "µm" : t.unit || "no unit")))];
    const box = frame(g, w, hgt, "frequency, Hz", `amplitude, ${units.join(" and ")}, logarithmic`);
    const palette = colours();
    const lines = data.traces.map((t, i) => {
      const s = spectrum(mids(data.samples[i].low, data.samples[i].high), data.rateHz);
      return { values: s.amplitude.map((v) => v * (t.unit === "m" ? 1e6 : 1)), step: s.step, name: t.name };
    });
    const peak = Math.max(1e-9, ...lines.map(({ values, step }) => values.reduce((m, v, i) => (i * step > 0.3 && i * step <= most ? Math.max(m, v) : m), 0)));
    const high = Math.ceil(Math.log10(peak) + 0.1);
    const decades = 5;
    place = { box, x: [0, most], y: [0, 1], say: (p, q) => [`A ${withUnit(p[0], "Hz", 4)}`, ...(q ? [`B ${withUnit(q[0], "Hz", 4)}`, `Δ ${withUnit(q[0] - p[0], "Hz", 4)}`] : []),
      ...lines.map((line, i) => {
        const unit = data.traces[i].unit === "m" ? "µm" : data.traces[i].unit;
        const [va, vb] = [p, q].map((c) => (c ? amplitudeAt(line, c[0]) : NaN));
        return `${line.name} ${withUnit(va, unit)}${q ? `, ${withUnit(vb, unit)}${va ? ` (× ${Number((vb / va).toPrecision(3))})` : ""}` : ""}`;
      })] };
    grid(g, box, frequencies(most), true);
    grid(g, box, Array.from({ length: decades + 1 }, (_, i) => [i / decades, String(Number(`1e${high - decades + i}`))]), false);
    g.save();
    g.beginPath();
    g.rect(box.left, box.top, box.right - box.left, box.bottom - box.top);
    g.clip();
    lines.forEach(({ values, step }, k) => {
      g.strokeStyle = palette[k % palette.length];
      g.lineWidth = 1.3;
      g.beginPath();
      for (let i = 1; i * step <= most; i++) {
        const share = (Math.log10(Math.max(values[i], 1e-15)) - high + decades) / decades;
        g.lineTo(box.left + ((i * step) / most) * (box.right - box.left), box.bottom - share * (box.bottom - box.top));
      }
      g.stroke();
    });
    g.restore();
    lines.forEach(({ name }, k) => {
      g.fillStyle = palette[k % palette.length];
      g.textAlign = "right";
      g.fillText(name, box.right - 4, box.top + 12 + 13 * k);
    });
    g.textAlign = "left";
  }

  function drawSpectrogram(g, w, hgt) {
    const i = Math.max(0, data.traces.findIndex((t) => t.name === settings.first));
    const found = pieces(mids(data.samples[i].low, data.samples[i].high), data.rateHz);
    const most = Math.min(settings.top, data.rateHz / 2);
    const box = frame(g, w, hgt, "time, s", "frequency, Hz");
    if (!found) { g.fillText("The window is too short: choose 1 s or more.", box.left + 8, box.top + 20); return; }
    const { columns, centres, step, hop } = found;
    const bins = Math.max(2, Math.floor(most / step));
    let peak = 0;
    for (const column of columns) for (let k = 1; k < bins; k++) peak = Math.max(peak, column[k]);
    const total = data.samples[i].low.length;
    const [wide, tall] = [box.right - box.left, box.bottom - box.top];
    const cell = (p) => columns[centres.reduce((best, c, k) => (Math.abs(c - (1 + p[0] / data.seconds) * total) < Math.abs(centres[best] - (1 + p[0] / data.seconds) * total) ? k : best), 0)][Math.min(bins - 1, Math.max(0, Math.round(p[1] / step)))];
    const point = (p, name) => `${name} ${withUnit(p[0], "s", 4)}, ${withUnit(p[1], "Hz", 4)}: ${withUnit(cell(p), data.traces[i].unit)}`;
    place = { box, x: [-data.seconds, 0], y: [0, bins * step], say: (p, q) => (q ? [point(p, "A"), point(q, "B"), `Δ ${withUnit(q[0] - p[0], "s", 4)}, ${withUnit(q[1] - p[1], "Hz", 4)}`] : [point(p, "A")]) };
    columns.forEach((column, c) => {
      const x = box.left + (wide * (centres[c] - hop / 2)) / total;
      for (let k = 1; k < bins; k++) {
        const share = peak ? 1 + Math.log10(Math.max(column[k] / peak, 1e-4)) / 4 : 0; // 80 dB from dark to bright
        g.fillStyle = `rgb(${heat(share).join(",")})`;
        g.fillRect(x, box.bottom - (tall * (k + 0.5)) / bins, Math.max(1, (wide * hop) / total + 0.5), tall / bins + 0.5);
      }
    });
    grid(g, box, frequencies(most), false);
    grid(g, box, [0, 0.25, 0.5, 0.75, 1].map((s) => [s, String(Number(((s - 1) * data.seconds).toPrecision(3)))]), true);
    const spans = data.spans || [];
    drawSpans(g, spans, { left: box.left, right: box.right, top: box.top, bottom: box.bottom }, (x) => box.right + (x / data.seconds) * wide, css("--warn"));
    g.fillStyle = css("--warn");
    g.font = `10px ${css("--mono")}`;
    g.fillText(spanText(spans).slice(0, 60), box.left + 120, 10);
    g.fillStyle = css("--soft");
    g.textAlign = "right";
    g.fillText(`bright: ${withUnit(peak, data.traces[i].unit)}, dark: 80 dB less`, box.right, 10);
    g.textAlign = "left";
  }

  function draw(g, w, hgt) {
    place = null;
    if (!data?.traces.length) return;
    ({ xy: drawXY, fft: drawFFT, spectrogram: drawSpectrogram })[settings.mode](g, w, hgt);
    drawCursors(g);
  }

  return { element, mode, setCursor, get cursors() { return cursors; }, show(now) { data = now; choices(now.traces.map((t) => t.name)); picture.redraw(); } };
}
