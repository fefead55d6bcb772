// The oscilloscope: traces in lanes, live or paused, with zoom, cursors, a trigger, maths and spectra.
import { css, digits, h, persistent, segments } from "../dom.js";
import { holdSpans } from "../holds.js";
import { Strip, times } from "../plot.js";
import { withUnit } from "../signals.js";
import { TOPS, analysis } from "./scope_analysis.js";
import { channelPicker } from "./scope_channels.js";
import { tidy } from "./scope_settings.js";
import { divisionOf, laneTicks, listTraces, mathsPanel, placeIn, samplesOf, tracePanel } from "./scope_traces.js";
import { Trigger, triggerControls } from "./scope_trigger.js";

/** Windows in ms. */
const WINDOWS = [[500, "0.5 s"], [1000, "1 s"], [2000, "2 s"], [5000, "5 s"], [10000, "10 s"], [30000, "30 s"], [60000, "1 min"], [300000, "5 min"], [600000, "10 min"]];
const MODES = [["time", "Time"], ["xy", "XY"], ["fft", "FFT"], ["spectrogram", "Spectrogram"]];
const MOST_PIXELS = 8192; // the server gives no more
const ANALYSIS_MS = 200;
const [AXIS_PX, CHARACTER_PX] = [8, 6.1]; // of the vertical axis: its marks and gap, and a letter of 10 px
const SLACK = 0.3; // further part of the window in which a trigger may be found

export function mount(root, { link, catalogue, bar }) {
  const defaults = {
    channels: catalogue.filter((c) => c.plotted).map((c) => c.name),
    // the tip also wanders, by more than it trembles: without that the tremor is seen
    traces: Object.fromEntries(["x", "y", "z"].map((axis) => [`tip_displacement_${axis}`, { filter: "high" }])),
    maths: [], rows: 2000, side: true, display: "lanes", mode: "time", top: 30, first: "", second: "",
    trigger: { on: true, channel: catalogue.find((c) => c.plotted).name, level: 0, slope: "up", mode: "auto" },
  };
  const known = new Map(catalogue.map((c) => [c.name, c]));
  const settings = persistent("scope.2", defaults);
  const rowsIn = (ms) => Math.ceil((ms * link.rateHz) / 1000);
  const unknown = tidy(settings, defaults, known, { windows: WINDOWS.map(([rows]) => rows), modes: MODES.map(([mode]) => mode), tops: TOPS });
  let traces = [];
  let columns = []; // what is subscribed to: channels shown, and what maths and trigger need
  let strips = [];
  let subscription = null;
  let over = null; // the second run of a replay
  let overName = "";
  let paused = null; // {tEnd, head, view: [x0, x1], buckets}
  let cursors = [null, null];
  let dirty = true;
  let frame = 0;
  let analysedAt = 0;
  const trigger = new Trigger(settings.trigger);

  const plots = h("div.plots");
  const readout = h("div.row.num.readout");
  const rate = h("span.faint.num.rate", { title: "Traces, and messages from the server a second" }, "\u00a0");
  const pauseButton = h("button", { onclick: () => (paused ? resume() : pause()), title: "Pause or go on (Space)" }, "Pause");
  const windows = segments(WINDOWS, settings.rows, (rows) => setWindow(rows), "Window");
  windows.classList.add("wide");
  const windowChoice = h("select.narrow", { "aria-label": "Window", onchange: () => setWindow(windowChoice.value) }, WINDOWS.map(([rows, text]) => h("option", { value: rows, selected: rows === settings.rows }, text)));
  const modes = segments(MODES, settings.mode, (mode) => { settings.mode = mode; changed(); }, "What is drawn");
  const displays = segments([["lanes", "lanes"], ["shared", "one axis"]], settings.display, (display) => { settings.display = display; changed(); }, "Traces");
  displays.title = "Lanes: every trace has its own scale. One axis: all traces of a unit share one";
  const picker = channelPicker(catalogue, settings, () => changed());
  const triggerBox = triggerControls(settings, catalogue, () => { trigger.configure(settings.trigger); changed(); });
  const analysed = analysis(settings, () => { settings.save(); dirty = true; analysedAt = 0; });
  const toolbar = h("div.toolbar", {}, pauseButton, windows, windowChoice, modes, displays,
    h("button", { onclick: fit, title: "Fit the scales to what is shown (F)" }, "Fit"),
    h("button", { onclick: () => { settings.side = !settings.side; settings.save(); side.hidden = !settings.side; } }, "Channels"));
  triggerBox.element.append(rate);
  const ownPanels = h("div.stack.own");
  const side = h("div.stack.side", { hidden: !settings.side }, ownPanels, picker);
  root.append(h("div.scope", {}, toolbar, triggerBox.element, h("div.body.stack", {}, h("div.stack.main", {}, plots, analysed.element, readout), side)));

  function changed() {
    settings.save();
    rebuild();
  }

  function groups() {
    const byGroup = new Map();
    for (const trace of traces) {
      if (!byGroup.has(trace.group)) byGroup.set(trace.group, []);
      byGroup.get(trace.group).push(trace);
    }
    return [...byGroup.values()];
  }

  /** Whether something is computed that needs samples rather than smallest and largest values. */
  const needsSamples = () => settings.mode !== "time" || traces.some((t) => t.op || t.set.filter !== "none");
  const pixels = (rows) => (needsSamples() ? Math.min(MOST_PIXELS, rows) : plots.clientWidth || 1000);

  function subscribe() {
    link.drop(subscription);
    const more = settings.trigger.on ? 1 + SLACK : 1;
    const ask = (source) => link.subscribe(columns, rowsIn(settings.rows * more), Math.min(MOST_PIXELS, pixels(rowsIn(settings.rows)) * more), source);
    link.drop(over);
    subscription = columns.length ? ask(0) : null;
    over = columns.length && link.replay?.second ? ask(1) : null;
    overName = link.replay?.second || "";
  }

  function rebuild() {
    const lanes = new Map(traces.map((t) => [t.name, t.lane]));
    traces = listTraces(settings, known);
    traces.forEach((t) => { if (lanes.has(t.name)) t.lane = lanes.get(t.name); });
    const { on, slope, channel } = settings.trigger;
    columns = [...new Set([...traces.flatMap((t) => t.sources), ...(on ? [slope === "event" ? "status" : channel] : [])])].filter((name) => known.has(name));
    const open = new Set([...ownPanels.querySelectorAll("details[open] > summary")].map((s) => s.textContent));
    ownPanels.replaceChildren(tracePanel(settings, traces, changed), mathsPanel(settings, catalogue, changed));
    ownPanels.querySelectorAll("details").forEach((d) => { d.open = open.has(d.firstChild.textContent); });
    strips.forEach(({ strip }) => strip.destroy());
    const parts = settings.mode === "time" ? groups() : [];
    plots.hidden = settings.mode !== "time";
    analysed.element.hidden = settings.mode === "time";
    displays.hidden = settings.mode !== "time";
    if (settings.mode !== "time") analysed.mode();
    plots.replaceChildren();
    // the same for all strips, so that their times lie under one another
    const axisPx = Math.min(100, Math.max(56, ...traces.map(({ unit: { length } }) => (length > 2 ? AXIS_PX + CHARACTER_PX * (length + 8) : 0))));
    strips = parts.map((members, i) => {
      const inLanes = settings.display === "lanes";
      const made = { members, inLanes, divs: members.map(() => 1) };
      const unit = members[0].unit === "m" ? "µm" : members[0].unit;
      made.strip = new Strip(members.map((t) => ({ label: t.name, unit: t.unit })), {
        sync: "scope", noTimeAxis: i < parts.length - 1, onSelect: zoomTo, onClick: setCursor, onDouble: zoomOut, onWheel: wheel,
        axisPx: inLanes ? axisPx : 56, xTitle: "time, s", yTitle: inLanes ? "" : unit || "no unit", more: members.length, over: link.replay?.second ? members.length : 0,
        ticks: inLanes ? (height) => laneTicks(members.length, made.divs, members.map((t) => t.unit), members.map((t) => t.set.offset), height / members.length, withUnit) : undefined,
      });
      if (inLanes) made.strip.fixed = [0, members.length];
      made.strip.element.style.setProperty("--lanes", inLanes ? Math.max(2, members.length) : 2);
      plots.append(made.strip.element);
      return made;
    });
    if (!traces.length) plots.replaceChildren(h("p.empty", {}, "No channel is chosen. Tick some in the list of channels."));
    subscribe();
    if (paused?.over && String(paused.columns) !== String(columns)) resume(); // nobody has the others any more
    if (paused) refetch();
    analysedAt = 0;
    dirty = true;
  }

  function setWindow(rows) {
    settings.rows = Number(rows);
    settings.save();
    windows.show(rows);
    windowChoice.value = rows;
    paused = null;
    pauseButton.textContent = "Pause";
    subscribe();
    trigger.rearm();
    cursors = [null, null];
    dirty = true;
  }

  function pause() {
    const t = subscription?.buckets.times();
    if (!t?.length) return;
    const tEnd = t[t.length - 1];
    const { first, n, perBucket } = subscription.buckets;
    paused = { tEnd, head: (first + n) * perBucket, view: [-settings.rows / 1000, 0], buckets: snapshot(subscription.buckets), columns };
    if (over?.buckets.n) Object.assign(paused, { second: snapshot(over.buckets), secondHead: (over.buckets.first + over.buckets.n) * over.buckets.perBucket });
    pauseButton.textContent = "Go on";
    pauseButton.setAttribute("aria-pressed", "true");
    dirty = true;
  }

  function resume() {
    paused = null;
    cursors = [null, null];
    trigger.rearm();
    pauseButton.textContent = "Pause";
    pauseButton.setAttribute("aria-pressed", "false");
    dirty = true;
  }

  function snapshot(buckets) {
    const copy = Object.create(Object.getPrototypeOf(buckets));
    return Object.assign(copy, buckets, {
      t: buckets.t.slice(), low: buckets.low.map((a) => a.slice()), high: buckets.high.map((a) => a.slice()),
    });
  }

  function zoomTo(x0, x1) {
    if (!paused) pause();
    if (!paused || x1 - x0 < 0.002) return;
    paused.view = [x0, x1];
    dirty = true;
    refetch();
  }

  function zoomOut() {
    if (!paused) return;
    paused.view = [-settings.rows / 1000, 0];
    refetch();
  }

  function wheel(direction, x) {
    if (!paused) {
      const now = WINDOWS.findIndex(([rows]) => rows === settings.rows);
      const next = WINDOWS[Math.max(0, Math.min(WINDOWS.length - 1, now + direction))];
      if (next[0] !== settings.rows) setWindow(next[0]);
      return;
    }
    const factor = direction > 0 ? 1.4 : 1 / 1.4;
    const [x0, x1] = paused.view;
    const view = [x + (x0 - x) * factor, Math.min(0, x + (x1 - x) * factor)];
    if (view[1] - view[0] < 0.005) return;
    paused.view = view;
    dirty = true;
    refetch();
  }

  let fetching = false;
  async function refetch() {
    if (fetching || !paused || paused.over) return;
    fetching = true;
    const [hz, [x0, x1]] = [link.rateHz, paused.view];
    const asked = paused;
    const wanted = columns;
    const buckets = await link.range(columns, asked.head + x0 * hz - 4, asked.head + x1 * hz + 4, pixels(Math.ceil((x1 - x0) * hz) + 8));
    const second = over && asked.secondHead ? await link.range(columns, asked.secondHead + x0 * hz - 4, asked.secondHead + x1 * hz + 4, pixels(Math.ceil((x1 - x0) * hz) + 8), 1) : null;
    fetching = false;
    if (paused !== asked) return;
    if (second?.n) asked.second = second;
    if (wanted !== columns) { refetch(); return; }
    if (buckets.n && !asked.over) asked.buckets = buckets;
    dirty = true;
    if (asked.view[0] !== x0 || asked.view[1] !== x1) refetch();
  }

  function setCursor(x, shift) {
    cursors[shift || (cursors[0] !== null && cursors[1] === null) ? 1 : 0] = x;
    dirty = true;
  }

  function fit() {
    strips.forEach(({ strip }) => strip.range.reset());
    traces.forEach((t) => { t.lane.div = 0; });
    dirty = true;
  }

  /** The channel of the trigger as it is drawn; null when it is not. */
  function triggerTrace(buckets) {
    const trace = traces.find((t) => !t.op && t.name === settings.trigger.channel);
    return trace ? samplesOf(trace, buckets, columns, link.rateHz / buckets.perBucket) : null;
  }

  function draw() {
    frame = requestAnimationFrame(draw);
    if (!dirty || !traces.length) return;
    if (settings.mode !== "time" && performance.now() - analysedAt < ANALYSIS_MS) return;
    dirty = false;
    analysedAt = performance.now();
    const live = subscription?.buckets;
    if (!paused && live?.n && settings.trigger.on) {
      const found = trigger.update(live, { channels: columns, rows: rowsIn(settings.rows), seen: triggerTrace(live) });
      if (found === "single") pause();
    }
    const held = settings.trigger.on && settings.mode === "time" ? trigger.held : null;
    const buckets = paused ? paused.buckets : held || live;
    if (!buckets?.n || buckets.channels !== columns.length) return;
    const t = buckets.times();
    const tEnd = paused ? paused.tEnd : held ? trigger.heldAt : t[t.length - 1];
    const [x0, x1] = paused ? paused.view : held ? trigger.view(settings.rows / 1000) : [-settings.rows / 1000, 0];
    const rateHz = link.rateHz / buckets.perBucket;
    const samples = new Map(traces.map((trace) => [trace, samplesOf(trace, buckets, columns, rateHz)]));
    const second = paused ? paused.second : over?.buckets;
    triggerBox.say(paused ? (paused.over ? "paused; this run is over, its picture stays" : "paused") : settings.mode === "time" ? trigger.text() : "");
    modes.show(settings.mode);
    displays.show(settings.display);
    if (settings.mode === "time") drawStrips(samples, times(buckets, tEnd), buckets.perBucket === 1 ? 1 : 2, x0, x1, held && !paused, tEnd, second?.n && second.channels === columns.length ? placed(second, t, rateHz) : null);
    else analysed.show({ spans: holdSpans(link.holds, t[t.length - 1], -t.length / rateHz, 0), traces, samples: traces.map((trace) => samples.get(trace)), rateHz, seconds: t.length / rateHz });
    showReadout(tEnd, samples, t);
  }

  /** The second run on the grid of the first: traces whose buckets are those at the same time since each run's start. */
  function placed(second, t, rateHz) {
    const { start_s: start, second_start_s: secondStart, shift_s: shift } = link.replay || {};
    const own = new Map(traces.map((trace) => [trace, samplesOf(trace, second, columns, link.rateHz / second.perBucket)]));
    const first = second.times()[0] - secondStart;
    const at = Array.from(t, (v) => Math.round((v - start + shift - first) * (link.rateHz / second.perBucket)));
    return new Map(traces.map((trace) => {
      const { low, high, base } = own.get(trace);
      const take = (values) => Float64Array.from(at, (i) => (i >= 0 && i < values.length ? values[i] - base : NaN));
      return [trace, { low: take(low), high: take(high) }];
    }));
  }

  function drawStrips(samples, x, twice, x0, x1, triggered, tEnd, second) {
    const spans = holdSpans(link.holds, tEnd, x0, x1);
    const marks = cursors.flatMap((c, i) => (c === null ? [] : [{ x: c, colour: css(i ? "--c2" : "--accent"), dash: [4, 3], label: "AB"[i] }]));
    if (triggered) marks.push({ x: 0, colour: css("--warn"), dash: [2, 3], label: "T" });
    for (const { strip, members, inLanes, divs } of strips) {
      strip.marks = [...marks];
      const texts = [];
      const beyond = [];
      const overs = [];
      const ys = members.map((trace, i) => {
        const s = samples.get(trace);
        const scale = trace.unit === "m" && !inLanes ? 1e6 : 1;
        divs[i] = inLanes ? divisionOf(trace, s) : 1;
        const place = inLanes ? placeIn(i, members.length, divs[i], Number(trace.set.offset)) : (v) => v * scale;
        const limits = [trace.set.low, trace.set.high].map((v) => (v === "" ? null : Number(v) * (trace.unit === "m" ? 1e-6 : 1)));
        const outside = (v) => (limits[0] !== null && v < limits[0]) || (limits[1] !== null && v > limits[1]);
        const limited = limits[0] !== null || limits[1] !== null;
        const y = new Float64Array(twice * s.low.length);
        const red = limited ? new Array(y.length).fill(null) : new Array(y.length);
        const zero = place(0);
        const slope = place(1) - zero;
        let out = 0;
        for (let k = 0; k < s.low.length; k++) {
          y[twice * k] = zero + slope * (s.low[k] - s.base);
          if (twice === 2) y[2 * k + 1] = zero + slope * (s.high[k] - s.base);
          if (limited && (outside(s.low[k]) || outside(s.high[k]))) {
            out += 1;
            for (let j = 0; j < twice; j++) red[twice * k + j] = y[twice * k + j];
          }
        }
        if (strip.options.over) {
          const s2 = second?.get(trace);
          overs.push(Array.from(y, (_, j) => {
            const v = s2 ? (j % twice ? s2.high : s2.low)[Math.floor(j / twice)] : NaN;
            return Number.isFinite(v) ? zero + slope * v : null;
          }));
        }
        beyond.push(limited ? red : new Array(y.length).fill(null));
        for (const limit of limits) if (limit !== null) strip.marks.push({ y: zero + slope * (limit - s.base), colour: css("--bad"), dash: [6, 3] });
        if (settings.trigger.on && settings.trigger.slope !== "event" && trace.name === settings.trigger.channel) {
          strip.marks.push({ y: zero + slope * settings.trigger.level, colour: css("--warn"), dash: [2, 3], label: "T" });
        }
        const last = s.high.length ? s.high[s.high.length - 1] : NaN;
        texts.push([withUnit(last, trace.unit, 4), inLanes ? `${withUnit(divs[i], trace.unit)}/div` : "", trace.set.coupling === "ac" ? "AC" : "DC",
          trace.set.filter === "none" ? "" : s.note || "filtered", limited ? `${((100 * out) / Math.max(1, s.low.length)).toFixed(1)} % outside` : ""].filter(Boolean).join(" · "));
        strip.values[i].classList.toggle("bad", out > 0);
        return y;
      });
      strip.show(x, [...ys, ...beyond, ...overs], x0, x1, texts, spans);
    }
  }

  /** Value of a trace at `x` seconds from `tEnd`: the bucket that holds it. */
  function valueAt({ low, high }, t, x) {
    let [a, b] = [0, t.length - 1];
    while (a < b) {
      const middle = (a + b + 1) >> 1;
      if (t[middle] <= x) a = middle;
      else b = middle - 1;
    }
    return t.length ? (low[a] + high[a]) / 2 : NaN;
  }

  function showReadout(tEnd, samples, t) {
    const [a, b] = cursors;
    if (a === null || settings.mode !== "time") {
      readout.replaceChildren(h("span.faint", {}, settings.mode !== "time" ? "Computed from the samples of the window; AC-coupled traces are less their mean."
        : paused ? "Drag to zoom, double click to zoom out, wheel to zoom; click sets cursor A, click again cursor B"
          : "Click sets a cursor, drag zooms and pauses, wheel or two fingers change the window"));
      return;
    }
    const parts = [`A ${(tEnd + a).toFixed(4)} s`];
    if (b !== null) parts.push(`B ${(tEnd + b).toFixed(4)} s`, `Δ ${((b - a) * 1000).toFixed(2)} ms`, `1/Δ ${digits(1 / Math.abs(b - a), 4)} Hz`);
    for (const trace of traces) {
      const s = samples.get(trace);
      const va = valueAt(s, t, tEnd + a);
      parts.push(`${trace.name} ${withUnit(va, trace.unit, 4)}${b !== null ? `, Δ ${withUnit(valueAt(s, t, tEnd + b) - va, trace.unit, 4)}` : ""}`);
    }
    const span = [tEnd + a, tEnd + b].sort((p, q) => p - q);
    readout.replaceChildren(...parts.map((text) => h("span", {}, text)),
      link.replay && b !== null ? h("button", { onclick: () => bar.setMark({ from: span[0], to: span[1] }) }, "Mark A to B") : "",
      h("button.quiet", { onclick: () => { cursors = [null, null]; dirty = true; } }, "clear cursors"));
  }

  const onKey = (event) => {
    if (/INPUT|SELECT|TEXTAREA|BUTTON/.test(event.target.tagName)) return;
    if (event.key === " ") { event.preventDefault(); pauseButton.click(); } else if (event.key === "f") fit();
  };
  document.addEventListener("keydown", onKey);
  const offData = link.on("data", (s) => { if ((s === subscription || s === over) && !paused) dirty = true; });
  let holdsDrawn = "";
  const offState = link.on("state", ({ holds }) => { // a hold is told with the status, perhaps after the last row
    const now = JSON.stringify(holds);
    if (now !== holdsDrawn) { holdsDrawn = now; dirty = true; }
  });
  const offRun = link.on("run", ({ same }) => { if (paused && !same) paused.over = true; trigger.rearm(); strips.forEach(({ strip }) => strip.range.reset()); });
  const offJump = link.on("jump", () => { if (paused) resume(); trigger.rearm(); dirty = true; });
  const offReplay = link.on("replay", (replay) => { if ((replay?.second || "") !== overName) rebuild(); });
  const offSource = link.on("source", () => { if (paused) resume(); trigger.rearm(); rebuild(); });
  let frames = link.frames;
  let countedAt = performance.now();
  const timer = setInterval(() => {
    const now = performance.now();
    const got = (1000 * (link.frames - frames)) / (now - countedAt);
    [frames, countedAt] = [link.frames, now];
    rate.textContent = `${traces.length} traces · ${got.toFixed(0)} /s`;
  }, 1000);
  const retheme = () => { strips.forEach(({ strip }) => strip.build()); dirty = true; };
  window.addEventListener("themechange", retheme);
  rebuild();
  if (unknown.length) triggerBox.warn(`This layout names channels that this bench does not have: ${unknown.slice(0, 4).join(", ")}${unknown.length > 4 ? ` and ${unknown.length - 4} more` : ""}.`);
  draw();
  window.micron.scope = { 
    get strips() { return strips; }, get traces() { return traces; }, settings, setWindow, changed, get subscription() { return subscription; }, get over() { return over; }, get cursors() { return cursors; }, trigger, setCursor, analysed,
  };
  return () => {
    cancelAnimationFrame(frame);
    clearInterval(timer);
    document.removeEventListener("keydown", onKey);
    window.removeEventListener("themechange", retheme);
    offData();
    offState();
    offRun();
    offJump();
    offReplay();
    offSource();
    link.drop(subscription);
    link.drop(over);
    strips.forEach(({ strip }) => strip.destroy());
  };
}
