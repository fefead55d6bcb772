// The trigger: hold the picture where a channel crosses a level, or where the status changes.
import { h, segments, unitText } from "../dom.js";

const PRE = 0.25; // share of the window before the trigger

export class Trigger {
  constructor(settings) { this.configure(settings); }

  configure(settings) {
    this.settings = settings;
    this.rearm();
  }

  rearm() {
    this.held = null;
    this.heldAt = 0;
    this.lastSeen = -1;
    this.lastHold = 0;
  }

  view(seconds) { return [-PRE * seconds, (1 - PRE) * seconds]; }

  text() {
    if (!this.settings.on) return "";
    return this.held ? `Triggered at ${this.heldAt.toFixed(3)} s` : "Waiting for the trigger";
  }

  /** Look for the newest trigger that has enough after it; says "single" when the picture shall stay. */
  update(buckets, scope) { // scope: {channels, rows, seen}; seen: the channel as it is drawn, {low, high, base}, or null
    const s = this.settings;
    if (!s.on) { this.held = null; return ""; }
    const c = scope.channels.indexOf(s.slope === "event" ? "status" : s.channel);
    if (c < 0) return "";
    const { low, high, base } = (s.slope !== "event" && scope.seen) || { low: buckets.lows(c), high: buckets.highs(c), base: 0 };
    const level = s.level + base;
    const after = Math.ceil(((1 - PRE) * scope.rows) / buckets.perBucket);
    const before = Math.ceil((PRE * scope.rows) / buckets.perBucket);
    for (let i = low.length - after; i >= Math.max(1, before); i--) {
      if (buckets.first + i <= this.lastSeen) break;
      const hit = s.slope === "event" ? high[i] !== high[i - 1]
        : s.slope === "up" ? low[i - 1] < level && high[i] >= level
          : high[i - 1] > level && low[i] <= level;
      if (hit) {
        this.lastSeen = buckets.first + i;
        this.held = Object.assign(Object.create(Object.getPrototypeOf(buckets)), buckets, {
          t: buckets.t.slice(), low: buckets.low.map((a) => a.slice()), high: buckets.high.map((a) => a.slice()),
        });
        this.heldAt = buckets.times()[i];
        this.lastHold = performance.now();
        return s.mode === "single" ? "single" : "held";
      }
    }
    if (s.mode === "auto" && performance.now() - this.lastHold > 1000) this.held = null;
    return "";
  }
}

/** The controls, in one row above the traces. The level is in the channel's unit (lengths in µm). */
export function triggerControls(settings, catalogue, changed) {
  const t = settings.trigger;
  const unitOf = (name) => catalogue.find((c) => c.name === name)?.unit;
  const scale = () => (unitOf(t.channel) === "m" ? 1e-6 : 1);
  const unit = h("span.soft");
  const set = (key) => (value) => { t[key] = value; show(); changed(); };
  const on = h("input", { type: "checkbox", checked: t.on, onchange: () => set("on")(on.checked) });
  const channel = h("select", { "aria-label": "Trigger channel", onchange: () => set("channel")(channel.value) },
    catalogue.map((c) => h("option", { value: c.name, selected: c.name === t.channel }, c.name)));
  const level = h("input", { type: "number", step: "any", "aria-label": "Trigger level", onchange: () => set("level")(Number(level.value) * scale()) });
  const slopes = segments([["up", "rising"], ["down", "falling"], ["event", "event"]], t.slope, set("slope"), "Slope");
  const modes = segments([["auto", "auto"], ["normal", "normal"], ["single", "single"]], t.mode, set("mode"), "Mode");
  const state = h("span.num.soft", { role: "status" });
  const warning = h("span.warn-text", { role: "status" });
  slopes.title = "Event: a change of the status bits";
  modes.title = "Auto: goes on without a trigger after 1 s. Normal: waits. Single: stays at the first";
  function show() {
    unit.textContent = scale() === 1 ? unitText(unitOf(t.channel) || "1") : "µm";
    if (document.activeElement !== level) level.value = String(Number((t.level / scale()).toPrecision(6)));
    for (const element of [channel, level]) element.disabled = !t.on || t.slope === "event";
  }
  show();
  const element = h("div.toolbar.trigger", {}, h("label", {}, on, h("b", {}, "Trigger")), channel, h("label.soft", {}, "at", level, unit), slopes, modes, state, warning);
  return { element, warn(text) { warning.textContent = text; }, say(text) { if (state.textContent !== text) state.textContent = text; } };
}
