// A strip of traces over time: smallest and largest value of every bucket are both drawn, so a spike always shows.
import uPlot from "./vendor/uPlot.esm.js";
import { colours, css, digits, h, unitText } from "./dom.js";
import { drawSpans, spanText } from "./holds.js";

/** Range of an axis that grows at once and shrinks slowly, so that a live trace does not make it jump. */
export class CalmRange {
  constructor(least = 0) {
    this.least = least;
    this.low = NaN;
    this.high = NaN;
  }

  reset() { this.low = this.high = NaN; }

  follow(low, high) {
    if (!Number.isFinite(low) || !Number.isFinite(high)) return [this.low || 0, this.high || 1];
    const pad = Math.max((high - low) * 0.08, this.least / 2, Math.abs(high) * 1e-6, 1e-12);
    const [a, b] = [low - pad, high + pad];
    if (Number.isNaN(this.low) || a < this.low || b > this.high) {
      this.low = Number.isNaN(this.low) ? a : Math.min(a, this.low);
      this.high = Number.isNaN(this.high) ? b : Math.max(b, this.high);
    } else if (b - a < 0.55 * (this.high - this.low)) {
      this.low += (a - this.low) * 0.05;
      this.high += (b - this.high) * 0.05;
    }
    return [this.low, this.high];
  }
}

/** x and y arrays for uPlot from buckets: low and high of each bucket one after the other; `t0` becomes zero. */
export function interleave(buckets, c, scale = 1) {
  const low = buckets.lows(c);
  if (buckets.perBucket === 1) return scale === 1 ? low : low.map((v) => v * scale);
  const high = buckets.highs(c);
  const y = new Float32Array(2 * low.length);
  for (let i = 0; i < low.length; i++) {
    y[2 * i] = low[i] * scale;
    y[2 * i + 1] = high[i] * scale;
  }
  return y;
}

export function times(buckets, t0) {
  const t = buckets.times();
  const twice = buckets.perBucket === 1 ? 1 : 2;
  const x = new Float64Array(twice * t.length);
  for (let i = 0; i < t.length; i++) for (let j = 0; j < twice; j++) x[twice * i + j] = t[i] - t0;
  return x;
}

export class Strip {
  /**
   * `traces`: [{label, unit, colour?}]; options: sync, onSelect(x0, x1), onClick(x, shift), onWheel(direction, x),
   * least (smallest span), axisPx (width of the vertical axis), xTitle, yTitle, ticks(heightPx): [{at, text}] of the vertical axis, more: series after the
   * traces, in the colour of a fault; over: series after those, in the colours of the traces, dashed.
   */
  constructor(traces, options = {}) {
    this.traces = traces;
    this.options = options;
    this.range = new CalmRange(options.least);
    this.fixed = null;
    this.marks = [];
    this.spans = [];
    this.spanWords = h("span.hold-words", { hidden: true });
    this.legend = h("div.legend");
    this.values = traces.map(() => h("b"));
    this.body = h("div.plot-body");
    this.element = h("div.plot", {}, this.legend, this.body);
    this.x = [-1, 0];
    this.observer = new ResizeObserver(() => this.resize());
    this.observer.observe(this.body);
    this.build();
  }

  build() {
    this.plot?.destroy();
    this.words = "";
    const palette = colours();
    const title = (text) => (text ? { label: text, labelSize: 15, labelGap: 0, labelFont: "10px " + css("--sans") } : {});
    const axis = { stroke: css("--faint"), grid: { stroke: css("--grid"), width: 1 }, ticks: { stroke: css("--line"), size: 4 }, font: "10px " + css("--mono") };
    this.legend.replaceChildren(
      ...this.traces.map((trace, i) => h("span", { style: `--dot:${trace.colour || palette[i % palette.length]}` }, trace.label, " ", this.values[i])), this.spanWords,
    );
    const { width, height } = this.size();
    const strip = this;
    this.plot = new uPlot(
      {
        width, height,
        legend: { show: false },
        padding: [this.options.padTop ?? 6, 12, 0, 0],
        cursor: {
          sync: this.options.sync ? { key: this.options.sync } : undefined,
          drag: { x: Boolean(this.options.onSelect), y: false, setScale: false },
          points: { show: false },
        },
        scales: { x: { time: false, range: () => this.x }, y: { range: (u, low, high) => this.fixed || this.range.follow(low, high) } },
        axes: [
          { ...axis, size: this.options.noTimeAxis ? 6 : this.options.xTitle ? 22 : 30, values: this.options.noTimeAxis ? () => [] : undefined, gap: 2, ...title(this.options.noTimeAxis ? "" : this.options.xTitle) },
          { ...axis, size: this.options.axisPx || 56, gap: 4, ...title(this.options.yTitle),
            ...(this.options.ticks ? { splits: (u) => this.ticks(u).map((t) => t.at), values: (u) => this.ticks(u).map((t) => t.text) }
              : { values: (u, splits) => splits.map((v) => digits(v, 3)) }) },
        ],
        series: [
          {},
          ...this.traces.map((trace, i) => ({
            stroke: trace.colour || palette[i % palette.length], width: trace.width || 1.25, points: { show: false },
            dash: trace.dash,
          })),
          ...Array.from({ length: this.options.more || 0 }, () => ({ stroke: css("--bad"), width: 2.5, points: { show: false }, spanGaps: false })),
          ...this.traces.slice(0, this.options.over || 0).map((trace, i) => ({
            stroke: trace.colour || palette[i % palette.length], width: 1, dash: [5, 4], points: { show: false }, spanGaps: false,
          })),
        ],
        hooks: {
          setSelect: [(u) => {
            if (u.select.width > 4) strip.options.onSelect?.(u.posToVal(u.select.left, "x"), u.posToVal(u.select.left + u.select.width, "x"));
            u.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
          }],
          drawClear: [(u) => {
            const { left, top, width, height } = u.bbox;
            drawSpans(u.ctx, strip.spans, { left, right: left + width, top, bottom: top + height }, (x) => u.valToPos(x, "x", true), css("--warn"), devicePixelRatio);
          }],
          draw: [(u) => strip.drawMarks(u)],
          setCursor: [(u) => strip.options.onCursor?.(u.cursor.left >= 0 ? u.posToVal(u.cursor.left, "x") : null)],
        },
      },
      [[], ...this.traces.map(() => []), ...Array.from({ length: (this.options.more || 0) + (this.options.over || 0) }, () => [])],
      this.body,
    );
    let moved = 0;
    this.plot.over.addEventListener("mousedown", (event) => { moved = event.clientX; });
    this.plot.over.addEventListener("mouseup", (event) => {
      if (Math.abs(event.clientX - moved) < 3) this.options.onClick?.(this.plot.posToVal(event.offsetX, "x"), event.shiftKey);
    });
    this.plot.over.addEventListener("dblclick", () => this.options.onDouble?.());
    this.touch();
    this.plot.over.addEventListener("wheel", (event) => {
      if (!this.options.onWheel) return;
      event.preventDefault();
      this.options.onWheel(Math.sign(event.deltaY), this.plot.posToVal(event.offsetX, "x"));
    }, { passive: false });
  }

  ticks(u) { return this.options.ticks(u.bbox.height / devicePixelRatio); }

  /** Two fingers zoom in steps, as the wheel does; one finger taps (a cursor) or scrolls the page. */
  touch() {
    const fingers = new Map();
    let apart = 0;
    const { over } = this.plot;
    const end = (event) => fingers.delete(event.pointerId);
    over.addEventListener("pointerdown", (event) => {
      if (event.pointerType === "touch") fingers.set(event.pointerId, event.clientX);
      const [a, b] = fingers.values();
      apart = b === undefined ? 0 : Math.abs(a - b);
    });
    over.addEventListener("pointermove", (event) => {
      if (!fingers.has(event.pointerId)) return;
      fingers.set(event.pointerId, event.clientX);
      const [a, b] = fingers.values();
      if (b === undefined || !apart) return;
      const now = Math.max(1, Math.abs(a - b));
      if (Math.abs(Math.log(now / apart)) < 0.3) return;
      this.options.onWheel?.(now < apart ? 1 : -1, this.plot.posToVal((a + b) / 2 - over.getBoundingClientRect().left, "x"));
      apart = now;
    });
    for (const name of ["pointerup", "pointercancel", "pointerleave"]) over.addEventListener(name, end);
  }

  size() { return { width: Math.max(80, this.body.clientWidth), height: Math.max(40, this.body.clientHeight) }; }
  resize() { if (this.element.isConnected) this.plot.setSize(this.size()); }

  /** New data: `x` seconds and one y array per series, shown from x0 to x1; `texts` instead of the newest values;
   * `spans` of time behind them. */
  show(x, ys, x0, x1, texts = null, spans = []) {
    this.x = [x0, x1];
    this.spans = spans;
    const words = spanText(spans);
    this.spanWords.hidden = !words;
    if (this.spanWords.textContent !== words) this.spanWords.textContent = words;
    this.data = [x, ...ys];
    this.plot.setData(this.data);
    this.label();
    if (texts) texts.forEach((text, i) => { this.values[i].textContent = text; });
    else ys.slice(0, this.traces.length).forEach((y, i) => this.value(i, y.length ? y[y.length - 1] : NaN));
  }

  /** uPlot writes the labels of an axis anew when its scale changes; those of lanes also change when a lane's division does. */
  label() {
    if (!this.options.ticks) return;
    const words = this.ticks(this.plot).map((t) => `${t.at} ${t.text}`).join();
    if (words === this.words) return;
    this.words = words;
    this.plot.redraw(false, true);
  }

  value(i, number) { this.values[i].textContent = digits(number) + (this.traces[i].unit ? ` ${unitText(this.traces[i].unit)}` : ""); }

  /** Value of a trace at `x`, by the nearest point before it. */
  at(i, x) {
    if (!this.data) return NaN;
    const xs = this.data[0];
    let low = 0;
    let high = xs.length - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (xs[middle] <= x) low = middle;
      else high = middle - 1;
    }
    return this.data[i + 1][low];
  }

  drawMarks(u) {
    const { ctx, bbox } = u;
    for (const { x, y, colour, dash, label } of this.marks) {
      ctx.save();
      ctx.strokeStyle = colour;
      ctx.lineWidth = 1.2 * devicePixelRatio;
      ctx.setLineDash((dash || []).map((v) => v * devicePixelRatio));
      ctx.beginPath();
      if (x !== undefined) {
        const at = u.valToPos(x, "x", true);
        if (at >= bbox.left && at <= bbox.left + bbox.width) { ctx.moveTo(at, bbox.top); ctx.lineTo(at, bbox.top + bbox.height); }
      } else {
        const at = u.valToPos(y, "y", true);
        if (at >= bbox.top && at <= bbox.top + bbox.height) { ctx.moveTo(bbox.left, at); ctx.lineTo(bbox.left + bbox.width, at); }
      }
      ctx.stroke();
      if (label) {
        ctx.fillStyle = colour;
        ctx.font = `600 ${11 * devicePixelRatio}px ${css("--mono")}`;
        if (x !== undefined) ctx.fillText(label, u.valToPos(x, "x", true) + 3 * devicePixelRatio, bbox.top + 11 * devicePixelRatio);
        else ctx.fillText(label, bbox.left + 4 * devicePixelRatio, u.valToPos(y, "y", true) - 3 * devicePixelRatio);
      }
      ctx.restore();
    }
  }

  destroy() {
    this.observer.disconnect();
    this.plot.destroy();
    this.element.remove();
  }
}
