// The oscilloscope: channels in strips by unit, live or paused, with zoom, cursors and a trigger.
import { css, digits, h, persistent, segments, unitText } from "../dom.js";
import { Strip, interleave, times } from "../plot.js";
import { channelPicker } from "./scope_channels.js";
import { Trigger, triggerControls } from "./scope_trigger.js";

const WINDOWS = [[500, "0.5 s"], [1000, "1 s"], [2000, "2 s"], [5000, "5 s"], [10000, "10 s"], [30000, "30 s"], [60000, "1 min"], [300000, "5 min"], [600000, "10 min"]];
const HZ = 1000;

export function mount(root, { link, catalogue }) {
  const settings = persistent("scope", {
    channels: catalogue.filter((c) => ["volts", "accelerometer", "magnetometer", "command"].includes(c.group)).slice(0, 20).map((c) => c.name),
    rows: 5000, side: true, trigger: { on: false, channel: "volts_0", level: 2.5, slope: "up", mode: "auto" },
  });
  const known = new Map(catalogue.map((c) => [c.name, c]));
  let strips = [];
  let subscription = null;
  let paused = null; // {tEnd, head, view: [x0, x1], buckets}
  let cursors = [null, null];
  let dirty = true;
  let frame = 0;
  const trigger = new Trigger(settings.trigger);

  const plots = h("div.plots");
  const readout = h("div.row.num.readout");
  const rate = h("span.faint.num.rate");
  const pauseButton = h("button", { onclick: () => (paused ? resume() : pause()), title: "Pause or go on (Space)" }, "Pause");
  const windows = segments(WINDOWS, settings.rows, (rows) => setWindow(rows), "Window");
  const picker = channelPicker(catalogue, settings, () => { settings.save(); rebuild(); });
  const triggerBox = triggerControls(settings, catalogue, () => { settings.save(); trigger.configure(settings.trigger); dirty = true; });
  const toolbar = h("div.toolbar", {}, pauseButton, windows,
    h("button", { onclick: fit, title: "Fit the vertical axes to what is shown (F)" }, "Fit"),
    h("button", { onclick: () => { settings.side = !settings.side; settings.save(); side.hidden = !settings.side; } }, "Channels"), rate);
  const side = h("div.stack.side", { hidden: !settings.side }, picker, triggerBox);
  root.append(h("div.scope", {}, toolbar, h("div.body.stack", {}, h("div.stack.main", {}, plots, readout), side)));

  function groups() {
    const byUnit = new Map();
    settings.channels.forEach((name, index) => {
      const channel = known.get(name);
      if (!channel) return;
      const key = `${channel.unit}|${["V", "1"].includes(channel.unit) ? channel.group : ""}`;
      if (!byUnit.has(key)) byUnit.set(key, []);
      byUnit.get(key).push({ ...channel, index });
    });
    return [...byUnit.values()];
  }

  function rebuild() {
    strips.forEach(({ strip }) => strip.destroy());
    const parts = groups();
    strips = parts.map((channels, i) => {
      const strip = new Strip(channels.map((c) => ({ label: c.name, unit: unitText(c.unit) })), {
        sync: "scope", noTimeAxis: i < parts.length - 1, onSelect: zoomTo, onClick: setCursor, onDouble: zoomOut, onWheel: wheel,
      });
      plots.append(strip.element);
      return { strip, channels };
    });
    if (!strips.length) plots.replaceChildren(h("p.empty", {}, "No channel is chosen. Tick some on the right."));
    else plots.querySelectorAll(".empty").forEach((e) => e.remove());
    link.drop(subscription);
    subscription = settings.channels.length ? link.subscribe(settings.channels, settings.rows, plots.clientWidth || 1000) : null;
    if (paused) refetch();
    dirty = true;
  }

  function setWindow(rows) {
    settings.rows = Number(rows);
    settings.save();
    windows.show(rows);
    paused = null;
    pauseButton.textContent = "Pause";
    link.drop(subscription);
    subscription = link.subscribe(settings.channels, settings.rows, plots.clientWidth || 1000);
    cursors = [null, null];
    dirty = true;
  }

  function pause() {
    const t = subscription?.buckets.times();
    if (!t?.length) return;
    const tEnd = t[t.length - 1];
    const { first, n, perBucket } = subscription.buckets;
    paused = { tEnd, head: (first + n) * perBucket, view: [-settings.rows / HZ, 0], buckets: snapshot(subscription.buckets) };
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
    paused.view = [-settings.rows / HZ, 0];
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
    if (fetching || !paused) return;
    fetching = true;
    const [x0, x1] = paused.view;
    const asked = paused;
    const buckets = await link.range(settings.channels, asked.head + x0 * HZ - 4, asked.head + x1 * HZ + 4, plots.clientWidth || 1000);
    fetching = false;
    if (paused !== asked) return;
    if (buckets.n) asked.buckets = buckets;
    dirty = true;
    if (asked.view[0] !== x0 || asked.view[1] !== x1) refetch();
  }

  function setCursor(x, shift) {
    cursors[shift || (cursors[0] !== null && cursors[1] === null) ? 1 : 0] = x;
    dirty = true;
  }

  function fit() {
    strips.forEach(({ strip }) => strip.range.reset());
    dirty = true;
  }

  function draw() {
    frame = requestAnimationFrame(draw);
    if (!dirty || !strips.length) return;
    dirty = false;
    const live = subscription?.buckets;
    if (!paused && live?.n) {
      const found = trigger.update(live, settings);
      if (found === "single") pause();
    }
    const buckets = paused ? paused.buckets : trigger.held || live;
    if (!buckets?.n) return;
    const t = buckets.times();
    const tEnd = paused ? paused.tEnd : trigger.held ? trigger.heldAt : t[t.length - 1];
    const [x0, x1] = paused ? paused.view : trigger.held ? trigger.view(settings.rows / HZ) : [-settings.rows / HZ, 0];
    const x = times(buckets, tEnd);
    const marks = cursors.flatMap((c, i) => (c === null ? [] : [{ x: c, colour: css(i ? "--c2" : "--accent"), dash: [4, 3] }]));
    for (const { strip, channels } of strips) {
      strip.marks = [...marks];
      if (settings.trigger.on && settings.trigger.slope !== "event") {
        if (channels.some((c) => c.name === settings.trigger.channel)) strip.marks.push({ y: settings.trigger.level, colour: css("--warn"), dash: [2, 3] });
      }
      strip.show(x, channels.map((c) => interleave(buckets, c.index)), x0, x1);
    }
    showReadout(tEnd);
  }

  function showReadout(tEnd) {
    const [a, b] = cursors;
    if (a === null) {
      readout.replaceChildren(h("span.faint", {}, paused
        ? "Drag to zoom, double click to zoom out, wheel to zoom; click sets cursor A, click again cursor B"
        : trigger.text() || "Click sets a cursor, drag zooms and pauses, the wheel changes the window"));
      return;
    }
    const parts = [`A ${(tEnd + a).toFixed(4)} s`];
    if (b !== null) parts.push(`B ${(tEnd + b).toFixed(4)} s`, `Δ ${((b - a) * 1000).toFixed(2)} ms`, `1/Δ ${digits(1 / Math.abs(b - a), 4)} Hz`);
    for (const { strip, channels } of strips) {
      channels.slice(0, 3).forEach((c, i) => {
        const va = strip.at(i, a);
        parts.push(`${c.name} ${digits(va)}${b !== null ? ` Δ ${digits(strip.at(i, b) - va)}` : ""} ${unitText(c.unit)}`);
      });
    }
    readout.replaceChildren(...parts.slice(0, 9).map((text) => h("span", {}, text)),
      h("button.quiet", { onclick: () => { cursors = [null, null]; dirty = true; }, style: "padding:0 6px" }, "clear"));
  }

  const onKey = (event) => {
    if (/INPUT|SELECT|TEXTAREA|BUTTON/.test(event.target.tagName)) return;
    if (event.key === " ") { event.preventDefault(); pauseButton.click(); } else if (event.key === "f") fit();
  };
  document.addEventListener("keydown", onKey);
  const offData = link.on("data", (s) => { if (s === subscription && !paused) dirty = true; });
  const offRun = link.on("run", () => { if (paused) resume(); strips.forEach(({ strip }) => strip.range.reset()); });
  let frames = link.frames;
  let countedAt = performance.now();
  const timer = setInterval(() => {
    const now = performance.now();
    const got = (1000 * (link.frames - frames)) / (now - countedAt);
    [frames, countedAt] = [link.frames, now];
    rate.textContent = `${settings.channels.length} channels · ${got.toFixed(0)} frames/s`;
  }, 1000);
  const retheme = () => { strips.forEach(({ strip }) => strip.build()); dirty = true; };
  window.addEventListener("themechange", retheme);
  rebuild();
  draw();
  window.micron.scope = { get strips() { return strips; }, settings, setWindow, get subscription() { return subscription; } };
  return () => {
    cancelAnimationFrame(frame);
    clearInterval(timer);
    document.removeEventListener("keydown", onKey);
    window.removeEventListener("themechange", retheme);
    offData();
    offRun();
    link.drop(subscription);
    strips.forEach(({ strip }) => strip.destroy());
  };
}
