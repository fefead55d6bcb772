// The trigger: hold the picture where a channel crosses a level, or where the status changes.
import { h, segments } from "../dom.js";

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
  update(buckets, scope) {
    const s = this.settings;
    if (!s.on) { this.held = null; return ""; }
    const c = scope.channels.indexOf(s.slope === "event" ? "status" : s.channel);
    if (c < 0) return "";
    const low = buckets.lows(c);
    const high = buckets.highs(c);
    const after = Math.ceil(((1 - PRE) * scope.rows) / buckets.perBucket);
    const before = Math.ceil((PRE * scope.rows) / buckets.perBucket);
    for (let i = low.length - after; i > Math.min(before, low.length - after - 1) && i > 0; i--) {
      if (buckets.first + i <= this.lastSeen) break;
      const hit = s.slope === "event" ? high[i] !== high[i - 1]
        : s.slope === "up" ? low[i - 1] < s.level && high[i] >= s.level
          : high[i - 1] > s.level && low[i] <= s.level;
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

export function triggerControls(settings, catalogue, changed) {
  const t = settings.trigger;
  const set = (key) => (value) => { t[key] = value; changed(); };
  const on = h("input", { type: "checkbox", checked: t.on, onchange: () => set("on")(on.checked) });
  const channel = h("select", { "aria-label": "Trigger channel", style: "width:100%", onchange: () => set("channel")(channel.value) },
    catalogue.map((c) => h("option", { value: c.name, selected: c.name === t.channel }, c.name)));
  const level = h("input", { type: "number", step: "any", value: t.level, "aria-label": "Trigger level", style: "width:90px", onchange: () => set("level")(Number(level.value)) });
  return h("div.panel", {}, h("h2", {}, h("label", {}, on, "Trigger")),
    h("div.stack", { style: "gap:8px" }, channel,
      h("div.row", {}, h("span.soft", {}, "level"), level),
      segments([["up", "rising"], ["down", "falling"], ["event", "event"]], t.slope, set("slope"), "Slope"),
      segments([["auto", "auto"], ["normal", "normal"], ["single", "single"]], t.mode, set("mode"), "Mode"),
      h("p.note", {}, "Event: a change of the status bits. The channel must be one that is shown (status for events).")));
}
