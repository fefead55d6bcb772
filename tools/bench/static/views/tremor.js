// The tremor as the firmware sees it: path of the tip before and after, size and pace over time, reduction; the tip's spectrum.
import { canvas, css, digits, h, persistent, segments } from "../dom.js";
import { bandRms, spectrum } from "../fourier.js";
import { figure } from "../figures.js";
import { holdSpans } from "../holds.js";
import { Strip, interleave, times } from "../plot.js";

const AXES = ["x", "y", "z"];
const FAST = [...AXES.map((a) => `tremor_${a}`), ...AXES.map((a) => `tremor_ahead_${a}`), ...AXES.map((a) => `confidence_${a}`), "status", ...AXES.map((a) => `tip_displacement_${a}`)];
const BANDS = [[0, 2], [2, 8], [8, 12], [20, 500]];
const SLOW = [...AXES.map((a) => `tremor_amplitude_${a}`), ...AXES.map((a) => `tremor_frequency_${a}`)];
const UM = 1e6;
const DECADES = 5; // of the spectrum, below its highest line
const PATH = 700;
const COMMANDED = 128;
const MANUAL = 256;

export function mount(root, { link }) {
  const settings = persistent("tremor", { plane: "xy" }, { plane: ["xy", "xz", "yz"] });
  const HZ = link.rateHz;
  const fast = link.subscribe(FAST, 4.2 * HZ, 4.2 * HZ);
  const slow = link.subscribe(SLOW, 60 * HZ, 900);
  let before = null;
  let after = null;
  let tip = null; // [without, with]: motion of the tip along x, y, z
  let size = 60;

  const path = canvas(drawPath, "Path of the tip before and after");
  const spectra = canvas(drawSpectrum, "Spectrum of the tip");
  const reduction = h("div.big");
  const bar = h("i", { style: "width:0" });
  const table = h("table");
  const rows = [];
  const bandCells = BANDS.map(() => [h("td.num"), h("td.num"), h("td.num")]);
  const bandTable = h("table.bands", {}, h("tr", {}, h("th", {}, figure("band", "Hz")), ["without", "with", "change"].map((t) => h("th.num", {}, figure(t)))),
    BANDS.map(([low, high], i) => h("tr", {}, h("td.num", { style: "text-align:left" }, `${low}–${high}`), bandCells[i])));
  const amplitude = new Strip(AXES.map((a) => ({ label: `amplitude ${a}`, unit: "µm" })), { noTimeAxis: true, least: 5, yTitle: "µm" });
  const frequency = new Strip(AXES.map((a) => ({ label: `frequency ${a}`, unit: "Hz" })), { least: 2, xTitle: "time, s", yTitle: "Hz" });
  const gain = h("input", { type: "range", min: 0, max: 1.2, step: 0.05, value: 1, "aria-label": "Gain of the compensation", style: "flex:1" });
  const gainText = h("b.num");
  const setGain = (value) => { link.order("gain", { value }); gain.value = value; };
  gain.oninput = () => setGain(Number(gain.value));
  const onOff = segments([["0", "off"], ["1", "on"]], "1", (v) => setGain(Number(v)), "Compensation");

  root.append(h("div.cols.tremor", {},
    h("section.panel.fig.path", {},
      h("h2", {}, "Tip, last 0.7 s ", h("span", { style: "color:var(--c2)" }, "before"), h("span", { style: "color:var(--accent)" }, "after"),
        h("span.grow"), segments([["xy", "x y"], ["xz", "x z"], ["yz", "y z"]], settings.plane, (v) => { settings.plane = v; settings.save(); }, "Plane")),
      h("div.chart.square", {}, path)),
    h("section.panel.fig", {}, h("h2", {}, "Spectrum of the tip, 4 s ", h("small", {}, "all axes together; lines at the edges of the four bands, 8 to 12 Hz shaded")), h("div.chart", {}, spectra)),
    h("div.stack.side", {},
      h("section.panel", {}, h("h2", {}, figure("gain", "Compensation"), gainText), h("div.row", { style: "flex-wrap:nowrap" }, onOff, gain)),
      h("section.panel", {}, h("h2", {}, figure("bands", "Four bands, 4 s"), h("small", {}, "tip, µm rms")), bandTable),
      h("section.panel", {}, h("h2", {}, figure("reduction", "Reduction, 4 s")), h("div.row", { style: "align-items:baseline" }, reduction), h("div.meter", { style: "margin:8px 0" }, bar), table,
        h("p.note", {}, "The firmware's estimate against its own prediction; errors of the stacks are not in it (micron run has them)."))),
    h("div.strips.plots", {}, amplitude.element, frequency.element)));

  /** Tremor now and what is left of it: what was commanded acts `delay` later. */
  function split() {
    const b = fast.buckets;
    if (b.perBucket !== 1 || b.n < 200) return;
    const delay = 2; // loop delay of the bench file, in ticks
    const status = b.lows(9);
    const g = link.replay ? 1 : link.state?.status?.gain ?? 1;
    before = AXES.map((_, c) => b.lows(c));
    const driven = AXES.map((_, c) => {
      const now = b.lows(c);
      const ahead = b.lows(3 + c);
      const sure = b.lows(6 + c);
      const rest = new Float32Array(now.length);
      let held = 0; // a skipped tick leaves the outputs where they are
      for (let i = 0; i < now.length; i++) {
        const j = Math.max(0, i - delay);
        if (status[j] & MANUAL) held = 0;
        else if (status[j] & COMMANDED) held = sure[j] > 0 ? g * ahead[j] : 0;
        rest[i] = held;
      }
      return rest;
    });
    const less = (values, c) => values.map((v, i) => v - driven[c][i]);
    after = before.map(less);
    const motion = AXES.map((_, c) => b.lows(10 + c));
    tip = [motion, motion.map(less)];
  }

  const rms = (parts) => Math.sqrt(parts.reduce((sum, p) => sum + p.reduce((s, v) => s + v * v, 0) / Math.max(1, p.length), 0)) * UM;

  function drawPath(g, w, hgt) {
    if (!before) return;
    const [a, b] = [...settings.plane].map((axis) => AXES.indexOf(axis));
    const most = Math.max(...[a, b].map((c) => before[c].slice(-PATH).reduce((m, v) => Math.max(m, Math.abs(v)), 0))) * UM;
    const wanted = Math.max(10, 1.25 * most);
    size += (wanted - size) * (wanted > size ? 0.3 : 0.02);
    const scale = Math.min(w, hgt) / 2 / size;
    const step = [5, 10, 20, 50, 100, 200, 500].find((s) => size / s <= 4) || 1000;
    g.font = `10px ${css("--mono")}`;
    g.strokeStyle = css("--grid");
    const rings = Array.from({ length: Math.floor((1.4 * size) / step) }, (_, i) => step * (i + 1));
    for (const r of rings) {
      g.beginPath();
      g.arc(w / 2, hgt / 2, r * scale, 0, 7);
      g.stroke();
    }
    for (const [data, colour, width] of [[before, css("--c2"), 1.1], [after, css("--accent"), 1.8]]) {
      const x = data[a].slice(-PATH);
      const y = data[b].slice(-PATH);
      g.strokeStyle = colour;
      g.lineWidth = width;
      g.lineJoin = "round";
      g.beginPath();
      for (let i = 0; i < x.length; i++) g.lineTo(w / 2 + x[i] * UM * scale, hgt / 2 - y[i] * UM * scale);
      g.stroke();
    }
    for (const r of rings) { // over the path, so that they can be read
      const text = `${r} µm`;
      const [x, y] = [w / 2 + 4, hgt / 2 - r * scale - 3];
      if (y < 20) continue; // the name of the axis is there
      g.fillStyle = css("--panel");
      g.fillRect(x - 2, y - 9, g.measureText(text).width + 4, 12);
      g.fillStyle = css("--faint");
      g.fillText(text, x, y);
    }
    g.fillStyle = css("--soft");
    g.fillText(settings.plane[0], w - 12, hgt / 2 - 5);
    g.fillText(settings.plane[1], w / 2 + 6, 10);
  }

  let lines = null;
  function drawSpectrum(g, w, hgt) {
    if (!lines) return;
    const [left, bottom, top, least, most] = [46, 20, 6, 0.5, HZ / 2];
    const high = Math.ceil(Math.log10(Math.max(1e-3, ...lines[0].values)));
    const low = high - DECADES;
    const x = (hz) => left + ((w - left - 6) * Math.log(hz / least)) / Math.log(most / least);
    const y = (v) => top + ((hgt - bottom - top) * (high - Math.max(low, Math.log10(Math.max(v, 1e-12))))) / DECADES;
    g.font = `10px ${css("--mono")}`;
    g.fillStyle = `color-mix(in srgb, ${css("--accent")} 9%, transparent)`;
    g.fillRect(x(8), top, x(12) - x(8), hgt - bottom - top);
    g.strokeStyle = css("--grid");
    g.fillStyle = css("--faint");
    const edges = [...new Set(BANDS.flat())].filter((hz) => hz > least && hz < most);
    for (const hz of edges) {
      g.beginPath(); g.moveTo(x(hz), top); g.lineTo(x(hz), hgt - bottom); g.stroke();
      g.fillText(String(hz), x(hz) - 5, hgt - 6);
    }
    g.fillText(`${most} Hz`, w - 44, hgt - 6);
    for (let decade = low; decade <= high; decade++) {
      const at = y(10 ** decade);
      g.beginPath(); g.moveTo(left, at); g.lineTo(w - 6, at); g.stroke();
      if (decade > low) g.fillText(decade === high ? "µm" : String(Number((10 ** decade).toPrecision(1))), 2, at + (decade === high ? 9 : 3));
    }
    for (const { values, step, colour } of lines) {
      g.strokeStyle = colour;
      g.lineWidth = 1.2;
      g.beginPath();
      for (let i = Math.ceil(least / step); i < values.length && i * step <= most; i++) g.lineTo(x(i * step), y(values[i]));
      g.stroke();
    }
  }

  function powers(data, colour) {
    const parts = data.map((p) => spectrum(p, HZ));
    const values = Array.from(parts[0].amplitude, (_, i) => Math.hypot(...parts.map((p) => p.amplitude[i])) * UM);
    return { values, step: parts[0].step, colour };
  }

  function showBands() {
    const parts = tip.map((motion) => motion.map((p) => spectrum(p, HZ)));
    BANDS.forEach(([low, high], i) => {
      const [without, left] = parts.map((axes) => Math.hypot(...axes.map((s) => bandRms(s, low, high))) * UM);
      const change = without > 1e-3 ? 100 * (left / without - 1) : 0;
      bandCells[i][0].textContent = without.toFixed(2);
      bandCells[i][1].textContent = left.toFixed(2);
      bandCells[i][2].textContent = `${change > 0.5 ? "+" : change < -0.5 ? "−" : ""}${Math.abs(change).toFixed(0)} %`;
      bandCells[i][2].className = `num ${change < -0.5 ? "good-text" : change > 0.5 ? "warn-text" : ""}`;
    });
  }

  let frame = 0;
  let turn = 0;
  function draw() {
    frame = requestAnimationFrame(draw);
    if (++turn % 2) return; // 30 pictures a second are enough here
    split();
    path.redraw();
    const t = slow.buckets.times();
    if (t.length && turn % 8 === 0) {
      const x = times(slow.buckets, t[t.length - 1]);
      const spans = holdSpans(link.holds, t[t.length - 1], -60, 0);
      amplitude.show(x, [0, 1, 2].map((c) => interleave(slow.buckets, c, UM)), -60, 0, null, spans);
      frequency.show(x, [3, 4, 5].map((c) => interleave(slow.buckets, c)), -60, 0, null, spans);
    }
  }
  const timer = setInterval(() => {
    if (!before) return;
    lines = [powers(tip[0], css("--c2")), powers(tip[1], css("--accent"))];
    spectra.redraw();
    showBands();
    const [a, b] = [rms(before), rms(after)];
    const percent = a > 0 ? 100 * (1 - b / a) : 0;
    reduction.replaceChildren(percent > 0.5 ? percent.toFixed(0) : "0", h("span.unit", {}, "% less"));
    bar.style.width = `${Math.max(0, Math.min(100, percent))}%`;
    const s = link.state?.status || {};
    if (!rows.length) {
      rows.push(...AXES.map(() => [h("td.num"), h("td.num")]));
      table.replaceChildren(h("tr", {}, ...["rms", "before", "after"].map((n, i) => h(i ? "th.num" : "th", {}, figure(n)))),
        ...AXES.map((axis, c) => h("tr", {}, h("td", { style: `color:var(--c${c + 1})` }, axis), rows[c])));
    }
    AXES.forEach((_, c) => [before, after].forEach((part, i) => { rows[c][i].textContent = `${rms([part[c]]).toFixed(1)} µm`; }));
    if (link.replay) gainText.textContent = "gain 1 assumed";
    else if (s.gain !== undefined) {
      gainText.textContent = `gain ${s.gain.toFixed(2)}`;
      if (document.activeElement !== gain) gain.value = s.gain;
      onOff.show(s.gain === 0 ? "0" : s.gain === 1 ? "1" : "");
    }
    gain.disabled = !link.mayOrder || Boolean(link.replay);
    onOff.querySelectorAll("button").forEach((button) => { button.disabled = gain.disabled; });
  }, 250);
  const retheme = () => { amplitude.build(); frequency.build(); };
  window.addEventListener("themechange", retheme);
  draw();
  return () => {
    cancelAnimationFrame(frame);
    clearInterval(timer);
    window.removeEventListener("themechange", retheme);
    [fast, slow].forEach((s) => link.drop(s));
    [amplitude, frequency].forEach((s) => s.destroy());
  };
}
